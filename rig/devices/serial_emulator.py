"""An emulated head on a pseudo-terminal: `python -m vibrissa.rig.devices.serial_emulator`.

A stand-in for tests. A pseudo-terminal has neither a baud rate nor parity; `throttle` limits the
bytes per second instead, and what the firmware's queue can't hold is lost, as on a real line.

Orders: errors RATE, drop S, reset, unplug S, throttle BYTES_PER_S (0: none), noise BYTES, impostor
(another head speaks up on the same line), normal.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import tempfile
import time
import tty
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from vibrissa.rig.devices.emulation import head_arguments
from vibrissa.rig.devices.framing import FrameParser, frame
from vibrissa.rig.devices.head_emulator import HeadEmulator
from vibrissa.rig.devices.protocol import (
    Hello,
    RawSample,
    pack_from_head,
    unpack_from_host,
)

QUEUE: Final = 1 << 16
"""Bytes the firmware keeps for a host that does not read; a quarter of a second of samples."""


class SerialEmulator(HeadEmulator):
    """The head behind the symbolic link `path`."""

    def __init__(self, arguments: argparse.Namespace, path: Path) -> None:
        super().__init__(arguments)
        self.path = path
        self._parser = FrameParser()
        self._queue = bytearray()
        self._rate = 0.0
        self._credit = 0.0
        self._counted = time.monotonic()
        self._replug_at: float | None = None
        self._random = random.Random(arguments.seed)
        self._master = self._keep = -1
        self.plug()

    def more_orders(self) -> dict[str, Callable[..., object]]:
        return {
            "unplug": self.unplug,
            "throttle": self.throttle,
            "noise": self.noise,
            "impostor": self.impostor,
        }

    def plug(self) -> None:
        """Come up under the link's name, as a device file does."""
        self._master, self._keep = os.openpty()
        tty.setraw(self._keep)
        os.set_blocking(self._master, False)
        link = self.path.with_name(self.path.name + ".new")
        with contextlib.suppress(FileNotFoundError):
            link.unlink()
        link.symlink_to(os.ttyname(self._keep))
        link.replace(self.path)
        self._replug_at = None

    def unplug(self, seconds: float) -> None:
        """The port disappears; the head loses its power, and comes back after so long."""
        os.close(self._keep)
        os.close(self._master)
        self._master = self._keep = -1
        self.path.unlink()
        self._queue.clear()
        self._parser.restart()
        self.firmware.reset()
        self._replug_at = time.monotonic() + seconds

    def throttle(self, rate: float) -> None:
        """Let so many bytes per second through, 0 for no limit."""
        self._rate, self._credit = rate, 0.0

    def noise(self, count: float) -> None:
        """Put garbage on the line."""
        self._queue += self._random.randbytes(int(count))

    def impostor(self) -> None:
        """Another head on the same line says hello."""
        other = replace(self.firmware.hello, serial="VIB-OTHER", boot=4242)
        self._put(frame(pack_from_head(other, self.version)))

    def normal(self) -> None:
        super().normal()
        self.throttle(0.0)

    def take(self) -> None:
        if self._master < 0:
            return
        try:
            data = os.read(self._master, 1 << 16)
        except OSError:
            return
        if not self.line.open():
            return
        errors = self._parser.crc_errors
        for message in self._parser.feed(self.line.carry(data)):
            answer = self.firmware.hear(unpack_from_host(message))
            if answer is not None:
                self.greet(answer)
        if self._parser.crc_errors > errors:
            self.firmware.hear(None)

    def say(self, samples: list[RawSample]) -> None:
        self._put(b"".join(frame(pack_from_head(s, self.version)) for s in samples))

    def greet(self, hello: Hello) -> None:
        self._put(frame(pack_from_head(hello, self.version)))

    def idle(self, now: float) -> None:
        if self._replug_at is not None and now >= self._replug_at:
            self.plug()
            self.greet(self.firmware.hello)
        if self._rate:
            self._credit = min(self._credit + (now - self._counted) * self._rate, 4096.0)
        self._counted = now
        if self._queue and self._master >= 0:
            self._write(int(self._credit) if self._rate else len(self._queue))

    def _put(self, data: bytes) -> None:
        if self.line.open() and self._master >= 0 and len(self._queue) + len(data) <= QUEUE:
            self._queue += self.line.carry(data)

    def _write(self, most: int) -> None:
        try:
            sent = os.write(self._master, self._queue[: min(most, 1 << 15)])
        except BlockingIOError:
            return
        self._credit -= sent
        del self._queue[:sent]


def main() -> None:
    """Entry point."""
    parser = head_arguments("An emulated whisker head on a pseudo-terminal, for tests.")
    parser.add_argument("--link", type=Path, help="name of the port (default: a new one)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="vibrissa-head-") as folder:
        path = arguments.link or Path(folder) / "head"
        emulator = SerialEmulator(arguments, path)
        try:
            emulator.run(f"serial:{path}")
        finally:
            with contextlib.suppress(FileNotFoundError):
                path.unlink()


if __name__ == "__main__":
    main()
