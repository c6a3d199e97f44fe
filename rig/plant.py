"""The simulated devices: the whisker head and the arm that carries it.

Both are plain objects stepped by whoever holds the clock. They read no time of their own: tick
numbers come in, samples and poses go out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.kinematics import WHISKERS
from vibrissa.rig import head as h
from vibrissa.rig.head_params import (
    HeadPlantParams,
    PlantError,
    check_range,
    fresh_memo,
    head_model,
    rest_state,
)

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Pose = tuple[float, float, float, float]

__all__ = [
    "ARM_PERIOD",
    "ARM_SECONDS",
    "WATCHDOG_TICKS",
    "ArmPlant",
    "ArmPlantParams",
    "HeadPlant",
    "HeadPlantParams",
    "PlantError",
    "fresh_memo",
    "head_model",
    "rest_state",
]

WATCHDOG_SECONDS = 0.02
WATCHDOG_TICKS = 40  # at 2 kHz
ARM_PERIOD = 16  # ticks, 125 Hz
ARM_SECONDS = ARM_PERIOD * h.TICK


class HeadPlant:
    """The head over a maze: eighteen servos, whiskers and sensors at 2 kHz.

    ``boxes`` float64[n, 5] as made by ``wall_boxes``, m; ``seed`` of the noise, 0 to 2^63 - 1.
    With ``skip`` off every whisker looks at every box; the samples are the same to the bit.
    As in the firmware, when no command has come for 20 ms (40 ticks at 2 kHz) the drives go back
    to theta = 0 by themselves, at ``retract_speed``.
    """

    def __init__(
        self, boxes: Float64s, seed: int, params: HeadPlantParams | None = None, skip: bool = True
    ) -> None:
        if not 0 <= seed < 2**63:
            raise PlantError(f"head plant seed: expected 0 to 2^63 - 1, found {seed}")
        self.params = params or HeadPlantParams()
        self.model = head_model(boxes, self.params)
        self.seed = seed
        self.skip = skip
        self.state = rest_state(self.params)
        self._memo = fresh_memo()
        self._state_row, self._memo_row = self.state.reshape(-1), self._memo.reshape(-1)
        self._watchdog = max(1, round(WATCHDOG_SECONDS * self.params.rate))
        self._pose = np.zeros(4, dtype=np.float64)
        self._command = np.zeros(WHISKERS, dtype=np.float32)
        self._last_command_tick: int | None = None
        self._last_tick: int | None = None

    def step(
        self, tick: int, pose: Pose, command: Float32s | None
    ) -> tuple[Float32s, Float32s, Float32s]:
        """Advance by one tick and sample: (theta rad, x N m, y N m), new arrays float32[18].

        pose: head (x, y, z, yaw), m and rad; command: theta set-points float32[18], rad, or None
        when none came in this tick (the drives follow the last one until the watchdog fires).
        Raises PlantError when ticks don't follow one another, or for a command or pose that is
        not finite, of the wrong shape or out of range.
        """
        if self._last_tick is not None and tick != self._last_tick + 1:
            raise PlantError(f"head plant tick: expected {self._last_tick + 1}, found {tick}")
        last_command_tick = self._last_command_tick
        if command is not None:
            if command.shape != (WHISKERS,) or command.dtype != np.float32:
                raise PlantError(
                    f"head plant command: expected float32[{WHISKERS}], "
                    f"found {command.dtype}{list(command.shape)}"
                )
            last_command_tick = tick
        silent = last_command_tick is None or tick - last_command_tick >= self._watchdog
        self._pose[:] = pose
        theta = np.empty(WHISKERS, dtype=np.float32)
        x = np.empty(WHISKERS, dtype=np.float32)
        y = np.empty(WHISKERS, dtype=np.float32)
        status = h.head_step(
            self._state_row,
            self._memo_row,
            self.model,
            self.skip,
            self.seed,
            tick,
            self._pose,
            self._command if command is None else command,
            silent,
            theta,
            x,
            y,
        )
        if status == h.COMMAND_NOT_FINITE:
            assert command is not None
            i = int(np.flatnonzero(~np.isfinite(command))[0])
            raise PlantError(
                f"head plant command, tick {tick}, whisker {i}: expected a finite angle, "
                f"found {command[i]}"
            )
        if status == h.POSE_OUT_OF_RANGE:
            raise PlantError(
                f"head plant pose, tick {tick}: expected 4 numbers within "
                f"+-{h.POSE_LIMIT:g}, found {tuple(float(v) for v in pose)}"
            )
        if command is not None:
            self._command[:] = command
        self._last_command_tick, self._last_tick = last_command_tick, tick
        return theta, x, y


@dataclass(frozen=True)
class ArmPlantParams:
    """Limits of the simulated arm. Raises PlantError for a value outside its range.

    speed              m/s, 0.001 to 5, of the head
    acceleration       m/s^2, 0.01 to 100
    turn_speed         rad/s, 0.01 to 20
    turn_acceleration  rad/s^2, 0.01 to 500
    """

    speed: float = 0.5
    acceleration: float = 2.0
    turn_speed: float = 1.5
    turn_acceleration: float = 6.0

    def __post_init__(self) -> None:
        tops = {"speed": 5.0, "acceleration": 100.0, "turn_speed": 20.0, "turn_acceleration": 500.0}
        for entry in fields(self):
            low = 0.001 if entry.name == "speed" else 0.01
            check_range(
                "arm plant", entry.name, getattr(self, entry.name), low, tops[entry.name], "(SI)"
            )


class ArmPlant:
    """The arm: carries the head to set-points that come at 125 Hz, one period (8 ms) later.

    A set-point that speed and acceleration allow is reached exactly; otherwise the arm catches up
    within its limits and without overshoot of a resting set-point. Without a set-point it brakes
    and holds. Yaw is continuous: it turns the short way and is not wrapped.
    """

    def __init__(self, start: Pose, params: ArmPlantParams | None = None, tick: int = 0) -> None:
        _check_pose("arm plant start", start)
        self.params = params or ArmPlantParams()
        self._from = self._to = tuple(float(v) for v in start)
        self._velocity = [0.0] * 4
        self._setpoint: list[float] | None = None
        self._tick = tick

    @property
    def velocity(self) -> Pose:
        """Velocity in the present period: m/s and rad/s."""
        x, y, z, yaw = self._velocity
        return x, y, z, yaw

    def step(self, tick: int, setpoint: Pose | None) -> Pose:
        """Begin the period of 16 ticks that starts at ``tick``; returns the pose at its end.

        setpoint: (x, y, z, yaw), m and rad, or None when none came. Periods follow one another
        without a gap from the constructor's tick. Raises PlantError otherwise, or for a set-point
        that is not finite.
        """
        if tick != self._tick:
            raise PlantError(f"arm plant tick: expected {self._tick}, found {tick}")
        if setpoint is not None:
            _check_pose(f"arm plant set-point, tick {tick}", setpoint)
        p, now = self.params, self._to
        if setpoint is None:
            error = drift = None
            self._setpoint = None
        else:
            goal = [float(v) for v in setpoint]
            goal[3] += 2 * math.pi * math.floor((now[3] - goal[3]) / (2 * math.pi) + 0.5)
            before = self._setpoint or goal
            drift = [(a - b) / ARM_SECONDS for a, b in zip(goal, before, strict=True)]
            error = [a - b for a, b in zip(goal, now, strict=True)]
            self._setpoint = goal
        for axes, speed, acceleration in (
            (slice(0, 3), p.speed, p.acceleration),
            (slice(3, 4), p.turn_speed, p.turn_acceleration),
        ):
            self._velocity[axes] = _follow(
                self._velocity[axes],
                None if error is None else error[axes],
                None if drift is None else drift[axes],
                speed,
                acceleration,
            )
        self._from = now
        self._to = tuple(a + v * ARM_SECONDS for a, v in zip(now, self._velocity, strict=True))
        if error is not None:
            # Land on the set-point itself where it is reached, free of rounding.
            self._to = tuple(
                g if abs(g - t) < 1e-12 else t for g, t in zip(goal, self._to, strict=True)
            )
        self._tick = tick + ARM_PERIOD
        x, y, z, yaw = self._to
        return x, y, z, yaw

    def pose_at(self, tick: int) -> Pose:
        """The pose at a tick of the present period, linear between its ends."""
        begin = self._tick - ARM_PERIOD
        if not begin <= tick <= self._tick:
            raise PlantError(f"arm plant pose: expected tick {begin} to {self._tick}, found {tick}")
        if tick == self._tick:
            x, y, z, yaw = self._to
        else:
            part = (tick - begin) / ARM_PERIOD
            x, y, z, yaw = (a + (b - a) * part for a, b in zip(self._from, self._to, strict=True))
        return x, y, z, yaw


def _check_pose(where: str, pose: Pose) -> None:
    if len(pose) != 4 or not all(math.isfinite(v) and abs(v) <= h.POSE_LIMIT for v in pose):
        raise PlantError(f"{where}: expected x, y, z, yaw within +-{h.POSE_LIMIT:g}, found {pose}")


def _norm(values: list[float]) -> float:
    return math.sqrt(sum(v * v for v in values))


def _stopping_speed(reach: float, step: float) -> float:
    """Fastest speed now that, losing ``step`` per period, ends at rest where ``reach`` leads.

    ``reach``: the speed (m/s) that would cover the distance in one period, > 0.
    """
    periods = max(math.ceil((math.sqrt(1 + 8 * reach / step) - 3) / 2), 0)
    return reach / (periods + 1) + periods * step / 2


def _follow(
    velocity: list[float],
    error: list[float] | None,
    drift: list[float] | None,
    speed: float,
    acceleration: float,
) -> list[float]:
    """Velocity of the next period towards a set-point ``error`` away that moves with ``drift``."""
    step = acceleration * ARM_SECONDS
    wanted = [0.0] * len(velocity)
    if error is not None and drift is not None:
        exact = [e / ARM_SECONDS for e in error]
        change = _norm([a - b for a, b in zip(exact, velocity, strict=True)])
        # Where the set-point moves on, the lag behind it and the speed of catching up count.
        catch_up = [a - b for a, b in zip(exact, drift, strict=True)]
        closing = _norm(catch_up)
        slack = 1 + 1e-9
        if _norm(exact) <= speed * slack and max(change, closing) <= step * slack:
            return exact
        share = _stopping_speed(closing, step) / closing if closing > 0.0 else 0.0
        wanted = [d + c * share for d, c in zip(drift, catch_up, strict=True)]
        total = _norm(wanted)
        if total > speed:
            wanted = [w * speed / total for w in wanted]
    change_of = [w - v for w, v in zip(wanted, velocity, strict=True)]
    change = _norm(change_of)
    if change > step:
        return [v + c * step / change for v, c in zip(velocity, change_of, strict=True)]
    return wanted
