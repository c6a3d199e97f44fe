"""The head on a serial port: USB or a UART of at least 3 Mbaud."""

from __future__ import annotations

import contextlib
import os
import select
import time
from collections.abc import Iterator
from typing import Any

import serial

from vibrissa.rig.devices.errors import DeviceUnavailable
from vibrissa.rig.devices.framing import FrameParser, frame
from vibrissa.rig.devices.head import HeadDevice
from vibrissa.rig.devices.limits import HEAD
from vibrissa.rig.devices.protocol import FromHead, FromHost, pack_from_host, unpack_from_head

PIECE = 1 << 16
WRITE_S = 0.02


class SerialHead(HeadDevice):
    """A head behind `port`, a device file; a symbolic link to one survives replugging best."""

    def __init__(
        self, port: str, *, baud: int = 3_000_000, batch: int = 1, patience: float = HEAD.patience
    ) -> None:
        super().__init__(f"serial:{port}", batch=batch, patience=patience)
        self._port = port
        self._baud = baud
        self._serial: Any = None
        self._parser = FrameParser()

    def fileno(self) -> int:
        return self._serial.fileno() if self._serial is not None else -1

    def _open_link(self) -> None:
        try:
            self._serial = serial.Serial(
                self._port, self._baud, timeout=0, write_timeout=WRITE_S, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as error:
            text = str(error)
            busy = "lock" in text or getattr(error, "errno", None) == 16
            reason = "in use by another process" if busy else text.splitlines()[0]
            raise DeviceUnavailable(f"{self.name}: can't be opened: {reason}") from None
        self._parser.restart()

    def _close_link(self) -> None:
        link, self._serial = self._serial, None
        if link is not None:
            with contextlib.suppress(OSError):  # its device file may be gone already
                link.close()

    def _receive(self, timeout: float) -> Iterator[FromHead]:
        fd = self._serial.fileno()
        if not select.select([fd], [], [], timeout)[0]:
            return iter(())
        try:
            data = os.read(fd, PIECE)
        except BlockingIOError:
            return iter(())
        if not data:
            raise OSError("the port was unplugged")
        parser, counters = self._parser, self.counters
        messages = parser.feed(data)
        counters.bytes, counters.frames = parser.taken, parser.frames
        counters.crc_errors, counters.resyncs = parser.crc_errors, parser.resyncs
        items = [unpack_from_head(message) for message in messages]
        counters.strays += items.count(None)
        return (item for item in items if item is not None)

    def _send(self, item: FromHost) -> None:
        data = frame(pack_from_host(item))
        until = time.monotonic() + WRITE_S
        fd = self._serial.fileno()
        while data:
            try:
                data = data[os.write(fd, data) :]
            except BlockingIOError:
                left = until - time.monotonic()
                if left <= 0 or not select.select([], [fd], [], left)[1]:
                    raise OSError("the port takes nothing any more") from None
