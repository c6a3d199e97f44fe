"""Devices on time that a test turns by hand: as slow as the machine is, and always the same."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

from vibrissa.rig.devices import (
    arm,
    can_emulator,
    emulation,
    head,
    head_emulator,
    virtual_arm,
)
from vibrissa.rig.devices.arm import ArmReport
from vibrissa.rig.devices.can_emulator import CanEmulator
from vibrissa.rig.devices.can_head import CanHead
from vibrissa.rig.devices.emulation import head_arguments
from vibrissa.rig.devices.virtual_arm import VirtualArm

TICK_NS = 500_000
MODULES = (arm, can_emulator, emulation, head, head_emulator, virtual_arm)


class HandClock:
    """What modules take for `time`; in every tick that passes all in `lives` have their turn."""

    def __init__(self) -> None:
        self.ns = 10**9
        self.lives: list[Callable[[], object]] = []

    def put_into(self, patch: pytest.MonkeyPatch, *modules: ModuleType) -> None:
        """Be the time of the devices' modules, and of these."""
        for module in (*MODULES, *modules):
            patch.setattr(module, "time", self)

    def monotonic_ns(self) -> int:
        return self.ns

    def monotonic(self) -> float:
        return self.ns * 1e-9

    def process_time(self) -> float:
        return 0.0

    def sleep(self, seconds: float) -> None:
        end = self.ns + math.ceil(max(seconds, 0.0) * 1e9)
        while self.ns < end:
            self.ns = min(self.ns + TICK_NS, end)
            for live in self.lives:
                live()


def stepped_head(
    clock: HandClock, channel: str, *arguments: str, patience: float = 5.0
) -> tuple[CanHead, CanEmulator]:
    """A head that is not open yet, and what plays it: frames go over a bus inside this process.

    The emulator lives in every tick that the head waits for something.
    """
    parser = head_arguments("")
    parser.add_argument("--bus")
    emulator = CanEmulator(parser.parse_args(["--bus", f"virtual:{channel}", *arguments]))
    clock.lives.append(emulator.turn)
    found = CanHead("virtual", channel, patience=patience)
    receive = found._receive

    def waiting(timeout: float) -> Any:
        clock.sleep(min(timeout, TICK_NS * 1e-9))
        return receive(0.0)

    found._receive = waiting  # type: ignore[method-assign]
    return found, emulator


class MutableArm(VirtualArm):
    """A virtual arm whose states can be kept from us, while it goes on, and its clock set back."""

    mute = False
    epoch = 0.0

    def _next(self, timeout: float) -> ArmReport | None:
        report = super()._next(timeout)
        if self.mute or report is None:
            return None
        return report._replace(stamp=report.stamp - self.epoch)

    def reboot(self) -> None:
        """Begin a silence after which its clock has started afresh."""
        self.mute, self.epoch = True, self.report.stamp
