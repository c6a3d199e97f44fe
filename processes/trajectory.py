"""Where the head is while the arm follows a path: the arm's reports, without its messages."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vibrissa.messages.types import TICK_NS
from vibrissa.numerics import compiled
from vibrissa.rig.plant import ARM_PERIOD, ARM_SECONDS, ArmPlantParams, PlantError

Float64s = NDArray[np.float64]
Int64s = NDArray[np.int64]


class Path(Protocol):
    """Where the arm carries the head: an `ArmPath`, or something made of one."""

    def poses(self, t_ns: Int64s) -> Float64s:
        """Poses float64[n, 4] (x, y, z m, yaw rad) at times int64[n] since departure, ns."""


class Trajectory:
    """The head's pose at the ends of the arm's periods: set-points reached one period late.

    The arm hears of a set-point when a period ends and reaches it at the end of the next.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._departure: int | None = None
        self._start = path.poses(np.zeros(1, dtype=np.int64))[0]
        self._limits = ArmPlantParams()

    def depart(self, tick: int) -> None:
        """The path's time 0 is this tick; the arm moves at the first set-point made from then."""
        self._departure = tick

    def poses(self, first: int, ticks: int) -> Float64s:
        """Poses float64[n, 4] from the period that holds `first` to the end of the last one."""
        low, high = first // ARM_PERIOD, (first + ticks - 1) // ARM_PERIOD + 1
        ends = np.arange(low - 2, high + 1, dtype=np.int64)  # two more tell the velocities
        poses = np.empty((len(ends), 4), dtype=np.float64)
        poses[:] = self._start
        if self._departure is not None:
            on_the_way = (ends - 2) * ARM_PERIOD >= self._departure
            at = ((ends[on_the_way] - 1) * ARM_PERIOD - self._departure) * TICK_NS
            if len(at):
                poses[on_the_way] = self._path.poses(at)
        self._check(poses, low)
        return poses[2:]

    def _check(self, poses: Float64s, period: int) -> None:
        limits = self._limits
        for first, last, speed, acceleration in (
            (0, 3, limits.speed, limits.acceleration),
            (3, 4, limits.turn_speed, limits.turn_acceleration),
        ):
            fastest, sharpest = _rates(poses, first, last)
            if fastest > speed or sharpest > acceleration:
                raise PlantError(
                    f"arm path near tick {period * ARM_PERIOD}: asks for speed {fastest:.3g} and "
                    f"acceleration {sharpest:.3g}, the arm can do {speed} and {acceleration} (SI)"
                )


@compiled
def _rates(poses: Float64s, first: int, last: int) -> tuple[float, float]:
    """Largest speed and acceleration over the axes first .. last - 1 of successive arm periods."""
    fastest, sharpest = 0.0, 0.0
    for k in range(2, poses.shape[0]):
        speed, change = 0.0, 0.0
        for a in range(first, last):
            now = (poses[k, a] - poses[k - 1, a]) / ARM_SECONDS
            before = (poses[k - 1, a] - poses[k - 2, a]) / ARM_SECONDS
            speed += now * now
            change += (now - before) * (now - before)
        fastest, sharpest = max(fastest, speed), max(sharpest, change)
    return math.sqrt(fastest), math.sqrt(sharpest) / ARM_SECONDS
