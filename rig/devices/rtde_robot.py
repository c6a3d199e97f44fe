"""The arm inside the emulated controller: joints that follow, a program that may run, safety.

The servo is a lag of the look-ahead time with the joints' speed and acceleration limits: what a
test needs to see motion, not a model of a UR10's dynamics.
"""

from __future__ import annotations

import math
from typing import Final

from vibrissa.rig.devices import ur10
from vibrissa.rig.devices.rtde_wire import (
    ESTOP_BIT,
    NORMAL_BIT,
    PROTECTIVE_BIT,
    ROBOT_ESTOP_BIT,
    RUNNING_MODE,
    SAFETY_STOP_BIT,
)

STOPPED, PLAYING, PAUSED = 1, 2, 4
JOINT_SPEED: Final = 2.09
JOINT_ACCELERATION: Final = 10.0
JOINT_RANGE: Final = 2 * math.pi
HOME: Final[ur10.Joints] = (1.2, -1.9, -1.8, -1.0, 1.57, 0.0)
"""Elbow up, wrist down: near every pose over the maze."""

SERVO_J, SERVO_L = 11, 24
SPEED_STOP, SERVO_STOP, STOP_L, STOP_J = 15, 16, 33, 34
TRIGGER_PROTECTIVE_STOP, SET_WATCHDOG, SET_TCP, STOP_SCRIPT = 31, 35, 29, 255
STREAMING: Final = frozenset({6, 9, 10, SERVO_J, SERVO_L, 25, 26, 27, 38, 58, *range(66, 72)})


class Robot:
    """A UR10 that holds the head with a tool of `mount.tool`."""

    def __init__(self, mount: ur10.Mount, head: ur10.Pose, period: float) -> None:
        """head: where it holds the head at first. Raises ValueError when that is out of reach."""
        q = ur10.nearest(mount.flange(head), HOME)
        if q is None:
            raise ValueError(f"pose: expected one in reach, found {head}")
        self.mount = mount
        self.period = period
        self.q = q
        self.qd: tuple[float, ...] = (0.0,) * 6
        self.travelled = 0.0
        self.stamp = 0.0
        self.runtime = STOPPED
        self.safety = NORMAL_BIT
        self.robot_mode = RUNNING_MODE
        self.command_register = 0
        self._target: ur10.Joints | None = None
        self._lookahead = 0.1
        self._done: int | None = None
        self._watchdog = math.inf
        self._kicked = 0.0
        self._measured: tuple[ur10.Joints, ur10.Matrix] | None = None

    def play(self) -> None:
        """The control script was uploaded and begins."""
        if self.safety == NORMAL_BIT:
            self.runtime = PLAYING
            self.command_register = 1
            self._target, self._done, self._watchdog = None, None, math.inf

    def halt(self) -> None:
        """The script ends; the joints brake."""
        self.runtime = STOPPED
        self.command_register = 0
        self._target = None

    def protective_stop(self) -> None:
        """As after a collision."""
        self.safety = PROTECTIVE_BIT | SAFETY_STOP_BIT
        self.runtime = PAUSED if self.runtime == PLAYING else self.runtime
        self._target = None

    def emergency_stop(self) -> None:
        """The red button: power off."""
        self.safety = ROBOT_ESTOP_BIT | ESTOP_BIT | SAFETY_STOP_BIT
        self.robot_mode = 3
        self.qd = (0.0,) * 6
        self.halt()

    def unlock(self) -> None:
        """A person released the stop at the pendant, and the program with it."""
        self.safety, self.robot_mode = NORMAL_BIT, RUNNING_MODE
        self.halt()

    def reboot(self) -> None:
        """The controller starts afresh, clock and all; the arm stays where it is."""
        self.unlock()
        self.stamp, self.qd = 0.0, (0.0,) * 6

    def command(self, number: int, d: tuple[float, ...]) -> None:
        """input_int_register_0 and the double registers, as the control script reads them."""
        self._kicked = self.stamp
        if self.runtime != PLAYING:
            return
        if number == 0:
            self._done = None
            self.command_register = 1
        elif number == STOP_SCRIPT:
            self.halt()
        elif number in STREAMING:
            self._stream(number, d)
        elif self._done != number:
            self._done = number
            self.command_register = 2
            self._once(number, d)

    def _stream(self, number: int, d: tuple[float, ...]) -> None:
        if number == SERVO_L:
            pose = ur10.multiply(ur10.from_vector(d[:6]), _shift(-self.mount.tool))
            target = ur10.nearest(pose, self.q)
        elif number == SERVO_J:
            a, b, c, e, f, g = d[:6]
            target = (a, b, c, e, f, g)
        else:
            return
        if target is None or not all(abs(angle) <= JOINT_RANGE for angle in target):
            self.protective_stop()
        else:
            self._target = target
            self._lookahead = min(max(d[9], 0.03), 0.2)

    def _once(self, number: int, d: tuple[float, ...]) -> None:
        if number in (SPEED_STOP, SERVO_STOP, STOP_L, STOP_J):
            self._target = None
        elif number == TRIGGER_PROTECTIVE_STOP:
            self.protective_stop()
        elif number == SET_WATCHDOG:
            self._watchdog = 1.0 / d[0] if d[0] > 0 else math.inf

    def step(self) -> None:
        """Live through one cycle of the controller."""
        self.stamp += self.period
        if self.runtime == PLAYING and self.stamp - self._kicked > self._watchdog:
            self.halt()
        most = JOINT_ACCELERATION * self.period
        q, qd = [], []
        for k, (angle, speed) in enumerate(zip(self.q, self.qd, strict=True)):
            wanted = 0.0
            if self._target is not None and self.robot_mode == RUNNING_MODE:
                wanted = (self._target[k] - angle) / self._lookahead
                wanted = min(max(wanted, -JOINT_SPEED), JOINT_SPEED)
            change = min(max(wanted - speed, -most), most)
            qd.append(speed + change)
            q.append(angle + (speed + change) * self.period)
        self.travelled += max(abs(a - b) for a, b in zip(q, self.q, strict=True))
        a, b, c, d, e, f = q
        self.q, self.qd = (a, b, c, d, e, f), tuple(qd)

    def tcp(self) -> ur10.Matrix:
        """The nose in the base frame."""
        if self._measured is None or self._measured[0] is not self.q:
            self._measured = self.q, ur10.multiply(ur10.forward(self.q), _shift(self.mount.tool))
        return self._measured[1]

    def head(self) -> ur10.Pose:
        """The head in the maze frame."""
        return self.mount.head(ur10.to_vector(self.tcp()))[0]

    def value(self, name: str) -> tuple[float, ...] | None:
        """An output variable by its name, None where this robot has nothing to say."""
        match name:
            case "timestamp":
                return (self.stamp,)
            case "actual_q" | "target_q":
                return self.q
            case "actual_qd" | "target_qd":
                return self.qd
            case "actual_TCP_pose" | "target_TCP_pose":
                return ur10.to_vector(self.tcp())
            case "actual_TCP_speed" | "target_TCP_speed":
                return self._tcp_speed()
            case "robot_mode":
                return (self.robot_mode,)
            case "safety_mode":
                return (1 if self.safety == NORMAL_BIT else 3,)
            case "safety_status_bits":
                return (self.safety,)
            case "robot_status_bits":
                return (1 | 2 * (self.runtime == PLAYING),)
            case "runtime_state":
                return (self.runtime,)
            case "output_int_register_0":
                return (self.command_register,)
            case "speed_scaling" | "target_speed_fraction":
                return (1.0,)
        return None

    def _tcp_speed(self) -> tuple[float, ...]:
        a, b, c, d, e, f = (q + v * 1e-4 for q, v in zip(self.q, self.qd, strict=True))
        ahead = ur10.multiply(ur10.forward((a, b, c, d, e, f)), _shift(self.mount.tool))
        here = self.tcp()
        linear = tuple((p[3] - q[3]) / 1e-4 for p, q in zip(ahead, here, strict=True))
        turn = ur10.to_vector(ur10.multiply(ahead, ur10.inverse(here)))[3:]
        return (*linear, *(t / 1e-4 for t in turn))


def _shift(z: float) -> ur10.Matrix:
    return ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, z))
