"""What the emulated heads have in common: firmware, clock, faults and orders, but no wire."""

from __future__ import annotations

import argparse
import select
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable

from vibrissa.rig.devices.emulation import (
    DeviceClock,
    Line,
    Orders,
    PoseEar,
    maze_text,
    read_pose,
)
from vibrissa.rig.devices.firmware import Firmware
from vibrissa.rig.devices.protocol import Hello, RawSample, standard_map
from vibrissa.rig.maze import parse_maze
from vibrissa.rig.plant import HeadPlant, HeadPlantParams
from vibrissa.rig.scene import wall_boxes


def make_firmware(arguments: argparse.Namespace, ear: PoseEar) -> Firmware:
    """A head over the maze of the command line."""
    maze = parse_maze(maze_text(arguments.maze), arguments.maze or "the shipped board")
    plant = HeadPlant(wall_boxes(maze), arguments.seed, HeadPlantParams(**arguments.plant))
    hello = Hello(0, 0, (1, 0, 0), arguments.serial, channels=standard_map()[: arguments.channels])
    return Firmware(plant, ear.listen, hello, arguments.seed)


class HeadEmulator(ABC):
    """Runs a firmware against a clock of its own; a wire is put underneath."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.version: int = arguments.protocol
        self.ear = PoseEar(read_pose(arguments.pose), arguments.hear)
        self.firmware = make_firmware(arguments, self.ear)
        self._waiting: list[RawSample] = []
        self.line = Line(arguments.seed)
        self.clock = DeviceClock(arguments.drift * 1e-6, arguments.jitter * 1e-6, arguments.seed)
        self.orders = Orders(
            {
                "errors": self.line.errors,
                "drop": self.line.drop,
                "reset": self.reset,
                "normal": self.normal,
                **self.more_orders(),
            }
        )

    def run(self, url: str) -> None:
        """Until the standard input ends.

        What comes down the wire waits for the next tick, when the drives would take it anyhow.
        """
        self.orders.ready(url, self.ear.port)
        stdin = [sys.stdin]
        while True:
            if select.select(stdin, (), (), self.clock.wait())[0] and not self.orders.take():
                return
            self.turn()

    def turn(self) -> None:
        """Hear what came down, live through the ticks that are due."""
        self.take()
        for _ in range(self.clock.due()):
            sample = self.firmware.sample()
            if sample is not None:
                self._waiting.append(sample)
                if len(self._waiting) >= self.firmware.batch:
                    self.say(self._waiting)
                    self._waiting = []
        self.idle(time.monotonic())

    def reset(self) -> None:
        """The firmware starts afresh and says so."""
        self.greet(self.firmware.reset())

    def normal(self) -> None:
        """No more faults."""
        self.line.errors(0.0)
        self.line.drop(0.0)

    @abstractmethod
    def more_orders(self) -> dict[str, Callable[..., object]]:
        """Orders that this wire understands too."""

    @abstractmethod
    def take(self) -> None:
        """Hear what has come down and answer."""

    @abstractmethod
    def say(self, samples: list[RawSample]) -> None:
        """Send samples up."""

    @abstractmethod
    def greet(self, hello: Hello) -> None:
        """Send an introduction up."""

    def idle(self, now: float) -> None:  # noqa: B027
        """Once per turn: whatever the wire wants done."""
