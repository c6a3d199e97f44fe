"""The simulated arm as a device: `rig.plant.ArmPlant` against the clock."""

from __future__ import annotations

import math
import time

from vibrissa.rig.devices.arm import ArmDevice, ArmReport, Controller, Safety
from vibrissa.rig.devices.limits import ARM, ArmLimits, Pose
from vibrissa.rig.plant import ARM_PERIOD, ARM_SECONDS, ArmPlant, ArmPlantParams

BACKLOG_S = 0.1
"""How late it may be before it lets cycles go instead of making them up."""


class VirtualArm(ArmDevice):
    """An arm that holds the head at `start`; its plant's limits are `limits`."""

    def __init__(self, start: Pose, *, limits: ArmLimits = ARM) -> None:
        super().__init__("virtual arm", limits=limits)
        params = ArmPlantParams(
            limits.speed, limits.acceleration, limits.turn_speed, limits.turn_acceleration
        )
        self._plant = ArmPlant(start, params)
        self._tick = 0
        self._setpoint: Pose | None = None
        self._due = 0.0
        self.safety = Safety.NORMAL
        """What a person, or a test, makes the arm say."""

    def _connect(self) -> Controller:
        self._due = time.monotonic()
        return Controller("virtual", "1.0", ARM_SECONDS)

    def _disconnect(self) -> None:
        """There is nothing to let go of."""

    def _next(self, timeout: float) -> ArmReport | None:
        left = self._due - time.monotonic()
        if left > timeout:
            time.sleep(timeout)
            return None
        if left > 0.0:
            time.sleep(left)
        self._due = max(self._due + ARM_SECONDS, time.monotonic() - BACKLOG_S)
        setpoint = self._setpoint if self.safety is Safety.NORMAL else None
        pose = self._plant.step(self._tick, setpoint)
        self._setpoint = None
        self._tick += ARM_PERIOD
        speed = math.hypot(*self._plant.velocity[:3])
        stamp = self._tick / ARM_PERIOD * ARM_SECONDS
        return ArmReport(stamp, time.monotonic_ns(), pose, speed, self.safety)

    def _start_motion(self) -> None:
        """It is always ready."""

    def _send(self, setpoint: Pose) -> bool:
        self._setpoint = setpoint
        return True

    def _halt(self) -> None:
        self._setpoint = None
