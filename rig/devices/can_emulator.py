"""An emulated head on a CAN FD bus: `python -m vibrissa.rig.devices.can_emulator --bus loopback:P`.

A stand-in for tests. A frame with a bit error is lost here; on a real bus the controllers send it
again until they fall silent. The bus is INTERFACE:CHANNEL as in a device's URL.

Orders: errors RATE, drop S, reset, unplug S, impostor (another head answers on the bus), noise N
(frames of other devices), normal.
"""

from __future__ import annotations

import argparse
import random
import time
from collections.abc import Callable
from dataclasses import replace

import can

from vibrissa.rig.devices.can_bus import close_bus, open_bus, receive_frame, send_frame
from vibrissa.rig.devices.can_layout import (
    FROM_HEAD,
    Frame,
    pack_hello,
    pack_sample,
    unpack_from_host,
)
from vibrissa.rig.devices.emulation import head_arguments
from vibrissa.rig.devices.head_emulator import HeadEmulator
from vibrissa.rig.devices.protocol import Hello, RawSample


class CanEmulator(HeadEmulator):
    """The head on a bus."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._interface, _, self._channel = arguments.bus.partition(":")
        super().__init__(arguments)
        self._bus: can.BusABC | None = self._open()
        self._random = random.Random(arguments.seed)
        self._replug_at: float | None = None

    def _open(self) -> can.BusABC:
        return open_bus("can emulator", self._interface, self._channel, FROM_HEAD)

    def more_orders(self) -> dict[str, Callable[..., object]]:
        return {"unplug": self.unplug, "impostor": self.impostor, "noise": self.noise}

    def unplug(self, seconds: float) -> None:
        """Leave the bus without power for so long."""
        self.close()
        self.firmware.reset()
        self._replug_at = time.monotonic() + seconds

    def close(self) -> None:
        """Leave the bus."""
        bus, self._bus = self._bus, None
        close_bus(bus)

    def impostor(self) -> None:
        """Another head on the same bus says hello."""
        self._put(pack_hello(replace(self.firmware.hello, serial="VIB-OTHER", boot=4242)))

    def noise(self, count: float) -> None:
        """Frames of any identifier and content."""
        for _ in range(int(count)):
            identifier = self._random.choice((0x080, 0x100, 0x101, 0x123, 0x601))
            size = self._random.choice((0, 3, 8, 48, 64))
            self._put([(identifier, self._random.randbytes(size))])

    def take(self) -> None:
        while self._bus is not None:
            frame = receive_frame(self._bus, 0.0)
            if frame is None:
                return
            if not self.line.open() or self.line.hit(8 * len(frame[1])):
                continue
            item = unpack_from_host(frame)
            answer = self.firmware.hear(item) if item is not None else None
            if answer is not None:
                self.greet(answer)

    def say(self, samples: list[RawSample]) -> None:
        for sample in samples:
            self._put(pack_sample(sample, self.version))

    def greet(self, hello: Hello) -> None:
        self._put(pack_hello(hello, self.version))

    def idle(self, now: float) -> None:
        if self._replug_at is not None and now >= self._replug_at:
            self._replug_at = None
            self._bus = self._open()
            self.greet(self.firmware.hello)

    def _put(self, frames: list[Frame]) -> None:
        if self._bus is None or not self.line.open():
            return
        for identifier, data in frames:
            if not self.line.hit(8 * len(data)):
                send_frame(self._bus, identifier, data)


def main() -> None:
    """Entry point."""
    parser = head_arguments("An emulated whisker head on a CAN FD bus, for tests.")
    parser.add_argument("--bus", required=True, help="INTERFACE:CHANNEL, e.g. loopback:45900")
    arguments = parser.parse_args()
    emulator = CanEmulator(arguments)
    try:
        emulator.run(f"can:{arguments.bus}")
    finally:
        emulator.close()


if __name__ == "__main__":
    main()
