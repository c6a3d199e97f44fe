"""Whether odometry alone lets two whisks be at one place: the gate that every loop has to pass.

Corridors whose walls repeat feel the same at every period, and no mask tells them apart. Odometry
does, as long as it is not too far off itself. What it says of the way between two whisks errs by
every step's length and turn; an error of turn v (rad^2) at p_k moves what comes after by
v J (p - p_k) (p - p_k)^T J^T, J a quarter turn. Sums over all steps so far of v, v p_k and
v p_k p_k^T give that covariance between any two whisks at once. To second order, 1 - cos e of a
heading error e of variance s scatters by s / sqrt(2), so that half of s times the trace is added.

Odometry alone and not the estimate, which is surer of itself than it should be.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from vibrissa.numerics import compiled
from vibrissa.slam.angles import wrap_pi
from vibrissa.slam.graph_start import reckon
from vibrissa.slam.growing import grown
from vibrissa.slam.sequence_table import Floats

COLUMNS: Final = 11
"""Way, turn, their variances; v x, v y, v x x, v x y, v y y: sums over all steps; and x, y, m."""


class Reckoning:
    """Dead reckoning of every whisk from the beginning, and how far it may be off."""

    def __init__(self) -> None:
        self._rows = np.zeros((256, COLUMNS))
        self._pose = np.zeros(3)

    def add(self, whisk: int, step: Floats) -> None:
        """Take step float64[4] (distance m, turn rad, standard deviations) that ends at a whisk,
        the next one."""
        distance, turn, distance_sigma, turn_sigma = step.tolist()
        x, y, _ = self._pose.tolist()
        v = turn_sigma * turn_sigma
        self._rows = grown(self._rows, whisk + 1)
        row = self._rows[whisk]
        row[:4] = distance, turn, distance_sigma * distance_sigma, v
        row[4:9] = v * x, v * y, v * x * x, v * x * y, v * y * y
        if whisk:
            row[:9] += self._rows[whisk - 1, :9]
        reckon(self._pose, distance, turn)
        row[9:] = self._pose[:2]

    @property
    def travelled(self) -> Floats:
        """float64[>= n, 4]: way and turn from the beginning to every whisk, and their variances."""
        return self._rows[:, :4]

    @property
    def places(self) -> Floats:
        """float64[>= n, 2]: where odometry alone says every whisk is, m."""
        return self._rows[:, 9:]

    def heading_apart(self, later: int, earlier: int, facing: int) -> tuple[float, float]:
        """How far the headings of two whisks are from what a loop says (facing 1: the other way),
        rad, and the variance of that, rad^2."""
        _, turn, _, variance = (self._rows[later, :4] - self._rows[earlier, :4]).tolist()
        return wrap_pi(turn - math.pi * facing), variance

    def place_chi2(self, later: int, earlier: int, place: float, lateral: float) -> float:
        """chi^2 (2 degrees of freedom) of two whisks being at one place; place (m): standard
        deviation of a loop, lateral (m): of sideways motion per step."""
        still = place * place + (later - earlier) * lateral * lateral
        return _place_chi2(self._rows, later, earlier, still)


@compiled
def _place_chi2(rows: Floats, later: int, earlier: int, still: float) -> float:
    a, b = rows[later], rows[earlier]
    x, y = a[9], a[10]
    v, vx, vy = a[3] - b[3], a[4] - b[4], a[5] - b[5]
    own = still + a[2] - b[2]
    along = (a[6] - b[6]) - 2.0 * x * vx + x * x * v  # of v (x - x_k)^2
    across = (a[7] - b[7]) - x * vy - y * vx + x * y * v
    up = (a[8] - b[8]) - 2.0 * y * vy + y * y * v
    own += 0.5 * v * (up + along)
    xx, yy, xy = up + own, along + own, -across
    dx, dy = x - b[9], y - b[10]
    chi2: float = (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    return chi2
