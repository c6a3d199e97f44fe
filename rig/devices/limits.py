"""What the devices may do: every limit and time-out of head and arm, in this one place.

Drivers check each set-point against these figures before anything is sent, and a whole path before
the first motion. Distances in m, angles in rad, times in s unless a name says ticks (0.5 ms).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from vibrissa.control.kinematics import WHISKERS, Float32s, paper_head, whisker_name
from vibrissa.rig.devices import ur10
from vibrissa.rig.devices.errors import DeviceLimit

Pose = tuple[float, float, float, float]
"""Head (x, y, z, yaw): m and rad, maze frame, z of the nose plane."""

DEGREE = math.pi / 180.0
STOP_MARGIN = 0.087
"""rad, the drives' mechanical stops lie this far outside the swing."""


@dataclass(frozen=True, eq=False)
class HeadLimits:
    """Of the whisker drives.

    low, high      rad, float32[18], range of a command: the swing and the margin of the stops
    watchdog_ticks without a command after which the firmware itself retracts the whiskers
    silence_ticks  without a sample after which a run stops: whiskers retract, the arm brakes; half
                   as long again as a drop-out of 100 ms, and longer than a head that was reset
                   needs to be asked (after 100 ms) and to answer
    overrun_ticks  without a command that answers a sample after which a run stops
    patience       s without a sample after which the head counts as lost
    """

    low: Float32s = field(default_factory=lambda: np.full(WHISKERS, -STOP_MARGIN, np.float32))
    high: Float32s = field(
        default_factory=lambda: (paper_head().swing + STOP_MARGIN).astype(np.float32)
    )
    watchdog_ticks: int = 40
    silence_ticks: int = 300
    overrun_ticks: int = 300
    patience: float = 5.0

    def check(self, tick: int, command: Float32s) -> None:
        """Raises DeviceLimit for a command (float32[18]) the drives must not get."""
        if command.shape != (WHISKERS,) or command.dtype != np.float32:
            raise DeviceLimit(
                f"head command, tick {tick}: expected float32[{WHISKERS}], "
                f"found {command.dtype}{list(command.shape)}"
            )
        # quick; bytes differ of NaN, which becomes a bound here, and of -0 at a bound of 0
        if np.fmin(np.fmax(command, self.low), self.high).tobytes() == command.tobytes():
            return
        inside = (command >= self.low) & (command <= self.high)
        if not inside.all():
            i = int(inside.argmin())
            raise DeviceLimit(
                f"head command, tick {tick}: {whisker_name(i)}: expected {self.low[i]:.4g} to "
                f"{self.high[i]:.4g} rad, found {command[i]:.6g}"
            )


@dataclass(frozen=True)
class ArmLimits:
    """Of the arm and of the head it carries.

    lower, upper      corners of the workspace of the nose, maze frame
    speed, acceleration          of the nose, m/s, m/s^2
    turn_speed, turn_acceleration  of the yaw, rad/s, rad/s^2
    joint             rad, every joint within +- this; joint_speed rad/s
    tilt              rad, the head's axis may be off vertical by this
    deceleration      m/s^2 of a stop
    start_jump        m and rad, the first set-point may be this far from where the arm is
    stale_ticks       without a new state after which the arm is stopped; set-points answer states,
                      so that it holds already
    stale_setpoint_ticks  without a new set-point after which the arm, which holds, is stopped
    blind_ticks       without news of the head, said every 100 ticks, after which the arm is stopped
    watchdog          Hz, slower than this and the controller itself stops the program; a little
                      slower than stale_setpoint_ticks, so that the driver is first
    patience          s without a state after which the arm counts as lost
    """

    lower: tuple[float, float, float] = (-0.05, -0.05, 0.060)
    upper: tuple[float, float, float] = (1.31, 0.96, 0.400)
    speed: float = 0.5
    acceleration: float = 2.0
    turn_speed: float = 1.5
    turn_acceleration: float = 6.0
    joint: float = 2.0 * math.pi
    joint_speed: float = 2.0
    tilt: float = 2.0 * DEGREE
    deceleration: float = 2.0
    start_jump: float = 0.02
    stale_ticks: int = 200
    stale_setpoint_ticks: int = 160
    blind_ticks: int = 400
    watchdog: float = 10.0
    patience: float = 5.0

    def within(self, *, stale: int, setpoint: int) -> ArmLimits:
        """These limits with other time-outs, ticks; the controller's watchdog follows."""
        watchdog = self.watchdog * self.stale_setpoint_ticks / setpoint
        return replace(self, stale_ticks=stale, stale_setpoint_ticks=setpoint, watchdog=watchdog)

    def check_pose(self, where: str, pose: Pose) -> None:
        """Raises DeviceLimit when a head pose is not finite or outside the workspace."""
        if len(pose) != 4 or not all(math.isfinite(v) for v in pose):
            raise DeviceLimit(f"{where}: expected finite x, y, z, yaw, found {pose}")
        for axis, value, low, high in zip("xyz", pose, self.lower, self.upper, strict=False):
            if not low <= value <= high:
                raise DeviceLimit(
                    f"{where}: {axis}: expected {low} to {high} m (workspace), found {value:.6g}"
                )

    def check_rates(self, where: str, velocity: Pose, before: Pose, seconds: float) -> None:
        """Raises DeviceLimit when speed, or its change since `before`, is too large.

        Both are means over the time between set-points; seconds: from the middle of one to that of
        the other.
        """
        change = [(v - b) / seconds for v, b in zip(velocity, before, strict=True)]
        rates = (
            ("speed", math.hypot(*velocity[:3]), self.speed, "m/s"),
            ("turn speed", abs(velocity[3]), self.turn_speed, "rad/s"),
            ("acceleration", math.hypot(*change[:3]), self.acceleration, "m/s^2"),
            ("turn acceleration", abs(change[3]), self.turn_acceleration, "rad/s^2"),
        )
        for name, value, limit, unit in rates:
            if value > limit * (1 + 1e-6) + 1e-9:
                raise DeviceLimit(
                    f"{where}: {name}: expected at most {limit} {unit}, found {value:.6g}"
                )

    def check_joints(self, where: str, q: ur10.Joints, last: ur10.Joints, seconds: float) -> None:
        """Raises DeviceLimit when a joint leaves its range or is too fast."""
        for name, angle, before in zip(ur10.JOINTS, q, last, strict=True):
            if abs(angle) > self.joint:
                raise DeviceLimit(
                    f"{where}: {name} joint: expected within +-{self.joint:.4g} rad, "
                    f"found {angle:.6g}"
                )
            speed = abs(angle - before) / seconds
            if speed > self.joint_speed:
                raise DeviceLimit(
                    f"{where}: {name} joint: expected at most {self.joint_speed} rad/s, "
                    f"found {speed:.6g}"
                )


HEAD = HeadLimits()
ARM = ArmLimits()


class Follower:
    """Checks set-points one after the other, as they will be sent.

    period: s between set-points; mount: where the arm stands, None for an arm without joints;
    pose and q: where head and joints are now, at rest.
    """

    def __init__(
        self,
        limits: ArmLimits,
        period: float,
        pose: Pose,
        mount: ur10.Mount | None = None,
        q: ur10.Joints | None = None,
    ) -> None:
        self.limits = limits
        self.period = period
        self.mount = mount
        self.pose = pose
        self.velocity: Pose = (0.0, 0.0, 0.0, 0.0)
        self.q = q
        self._first = True
        self._took = period

    def follow(self, where: str, pose: Pose, seconds: float | None = None) -> None:
        """Take one set-point, `seconds` of the path (default: a period) after the one before.

        Raises DeviceLimit, and then nothing has changed. The same set-point again is always fine:
        it asks the servo to brake and hold.
        """
        limits, period = self.limits, seconds or self.period
        limits.check_pose(where, pose)
        turned = math.remainder(pose[3] - self.pose[3], 2 * math.pi)
        steps = [b - a for a, b in zip(self.pose[:3], pose, strict=False)] + [turned]
        jump = max(math.hypot(*steps[:3]), abs(turned))
        if self._first and jump > limits.start_jump:
            raise DeviceLimit(
                f"{where}: expected a first set-point within {limits.start_jump} m and rad of the "
                f"arm, found it {jump:.4g} away"
            )
        vx, vy, vz, turn = (s / period for s in steps)
        velocity = (vx, vy, vz, turn)
        if not self._first and pose != self.pose:
            limits.check_rates(where, velocity, self.velocity, 0.5 * (self._took + period))
        q = self.q
        if self.mount is not None and q is not None:
            q = ur10.nearest(self.mount.flange(pose), q)
            if q is None:
                raise DeviceLimit(f"{where}: expected a pose in reach, found {_text(pose)}")
            limits.check_joints(where, q, self.q or q, math.inf if self._first else period)
        self.pose, self.q, self._took = pose, q, period
        self.velocity = (0.0, 0.0, 0.0, 0.0) if self._first else velocity
        self._first = False

    def check_path(self, poses: Iterable[Pose]) -> None:
        """A whole path from here, one pose per period. Raises DeviceLimit; changes nothing."""
        ahead = Follower(self.limits, self.period, self.pose, self.mount, self.q)
        for k, pose in enumerate(poses):
            ahead.follow(f"arm path, {k * self.period:.3f} s", pose)


def _text(pose: Pose) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in pose) + ")"
