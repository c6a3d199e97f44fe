"""The head on a CAN FD bus."""

from __future__ import annotations

from collections.abc import Iterator

import can

from vibrissa.rig.devices.can_bus import (
    BITRATE,
    DATA_BITRATE,
    ERROR_ID,
    close_bus,
    open_bus,
    receive_frame,
    send_frame,
)
from vibrissa.rig.devices.can_layout import FROM_HOST, Assembler, check_bus_load, pack_from_host
from vibrissa.rig.devices.head import HeadDevice
from vibrissa.rig.devices.limits import HEAD
from vibrissa.rig.devices.protocol import FromHead, FromHost

MANY = 128
"""Frames taken at once."""
PARTNER_S = 0.0003
"""How long to wait for a sample's other frame, which takes 0.15 ms on the wire: less than another
wake-up costs."""


class CanHead(HeadDevice):
    """A head on `channel` of a python-can interface; `load` is the (least, most) bus load."""

    def __init__(
        self,
        interface: str,
        channel: str,
        *,
        bitrate: float = BITRATE,
        data_bitrate: float = DATA_BITRATE,
        batch: int = 1,
        patience: float = HEAD.patience,
    ) -> None:
        """bitrate, data_bitrate: bit/s of the two phases. Raises DeviceRefused for an overload."""
        super().__init__(f"can:{interface}:{channel}", batch=batch, patience=patience)
        self.load = check_bus_load(self.name, bitrate, data_bitrate)
        self._interface = interface
        self._channel = channel
        self._bus: can.BusABC | None = None
        self._assembler = Assembler()

    def fileno(self) -> int:
        try:
            return self._bus.fileno() if self._bus is not None else -1
        except NotImplementedError:
            return -1

    def _open_link(self) -> None:
        self._bus = open_bus(self.name, self._interface, self._channel, FROM_HOST)
        self._assembler.restart()

    def _close_link(self) -> None:
        bus, self._bus = self._bus, None
        close_bus(bus)

    def _receive(self, timeout: float) -> Iterator[FromHead]:
        bus, assembler, counters = self._bus, self._assembler, self.counters
        assert bus is not None
        items: list[FromHead] = []
        for _ in range(MANY):
            frame = receive_frame(bus, timeout)
            if frame is None:
                break
            timeout = 0.0
            if frame[0] == ERROR_ID:
                counters.crc_errors += 1
                continue
            counters.bytes += len(frame[1])
            item = assembler.take(frame)
            if item is not None:
                items.append(item)
            elif assembler.halfway:
                timeout = PARTNER_S
        counters.frames, counters.resyncs = assembler.frames, assembler.incomplete
        return iter(items)

    def _send(self, item: FromHost) -> None:
        assert self._bus is not None
        send_frame(self._bus, *pack_from_host(item))
