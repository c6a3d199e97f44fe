"""The exact beam, precomputed: tables of the elastica and their interpolation.

A table is float64[SIZE, SIZE, 4] over two coordinates from 0 to 1, read with cubic Lagrange
interpolation. Two kinds:

- peg: rows q, the diameter at the peg's distance over the base's, from LEAST_Q to 1; columns
  s = 1 - sqrt(1 - (gamma / gamma_most)^2), with gamma_most(q) the impingement beyond which no
  equilibrium exists and the shaft slides off. There the moment falls like a square root; in s it
  is smooth. Entries: moment over the small-angle one; (arc length - 1) / gamma^2; angle of the
  shaft at the contact over gamma; gamma_most. Valid for every shaft: only q tells them apart.
- tip on a plane, one for each tip over base diameter: rows height, the distance of the base from
  the plane over the length, from LEAST_HEIGHT to 1; columns (first - turn) / first, with first the
  angle to the plane's normal at which the straight shaft touches. Entries: moment over the
  small-angle one, times height; angle of the line from base to contact to the normal, rad; arc
  length to the contact over the length.

Built with the project's own arithmetic only, so the bits are the same on every machine.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled
from vibrissa.rig.elastica import (
    PEG,
    TIP,
    follow_tip,
    last_peg,
    peg_between,
    shoot,
    solve,
    tip_result,
)

SIZE = 57
STEPS = 64  # of the shooting, far finer than the interpolation
LEAST_Q = 0.1
LEAST_HEIGHT = 0.05
MOMENT, ARC, ANGLE, MOST = range(4)  # of the peg table
BEARING, ARC_LENGTH = 1, 2  # of a tip table, besides MOMENT


@compiled
def _peg_row(q: float, row: NDArray[np.float64], steps: int) -> None:
    """Fill one row float64[SIZE, 4] of the peg table."""
    size = row.shape[0]
    last = last_peg(q, steps)
    most_excess, most_force, most = last
    force, arc = 0.0, 1.0
    for n in range(size):
        # gamma = 0 itself has no ratios; they hardly change up to a hundredth of the range.
        left = 1.0 - n / (size - 1)
        wanted = most * math.sqrt(1.0 - left * left) if n > 0 else 0.01 * most
        if n == size - 1:
            force, arc = most_force, 1.0 + most_excess * most_excess
        elif 2 * n < size:
            guess = 3.0 * q * wanted if n < 2 else force
            force, arc, _found = solve(PEG, 1.0 - q, guess, arc, 1.0, wanted, steps)
        else:
            low = math.sqrt(arc - 1.0)
            excess, force = peg_between(q, wanted, low, force, last, steps)
            arc = 1.0 + excess * excess
        x, _y, theta = shoot(1.0 - q, arc, force, 0.0, steps)
        row[n, MOMENT] = force * x / (3.0 * q * wanted)
        row[n, ARC] = (arc - 1.0) / (wanted * wanted)
        row[n, ANGLE] = theta / wanted
        row[n, MOST] = most
    row[0, MOMENT] = 1.0


@compiled
def _tip_row(r: float, height: float, row: NDArray[np.float64], steps: int) -> None:
    """Fill one row float64[SIZE, 4] of a tip table."""
    size = row.shape[0]
    first = atan2(math.sqrt(1.0 - height * height), height)
    kind, force, rest, turned = TIP, 0.0, first - 0.5 * math.pi, 0.0
    for n in range(size):
        to = first * (n / (size - 1) if n > 0 else 1e-3)
        kind, force, rest, _found = follow_tip(
            r, height, first, turned, to, kind, force, rest, steps
        )
        turned = to
        moment, offset, arc = tip_result(r, kind, force, rest, steps)
        row[n, MOMENT] = moment * height / (3.0 * r * to)
        row[n, BEARING] = atan2(offset, height)
        row[n, ARC_LENGTH] = arc
    row[0, MOMENT], row[0, BEARING], row[0, ARC_LENGTH] = height, first, 1.0


@lru_cache(maxsize=8)
def peg_table(size: int = SIZE) -> NDArray[np.float64]:
    """The peg table, float64[size, size, 4], read-only."""
    table = np.empty((size, size, 4), dtype=np.float64)
    for n in range(size):
        _peg_row(LEAST_Q + (1.0 - LEAST_Q) * n / (size - 1), table[n], STEPS)
    table.setflags(write=False)
    return table


@lru_cache(maxsize=64)
def tip_table(r: float, size: int = SIZE) -> NDArray[np.float64]:
    """The table of a tip on a plane, float64[size, size, 4], read-only; r: tip over base."""
    table = np.zeros((size, size, 4), dtype=np.float64)
    for n in range(size):
        height = LEAST_HEIGHT + (1.0 - LEAST_HEIGHT) * n / (size - 1)
        _tip_row(r, min(height, 1.0 - 1e-7), table[n], STEPS)
    table.setflags(write=False)
    return table


@compiled
def interpolate(
    table: NDArray[np.float64], row: float, column: float
) -> tuple[float, float, float]:
    """The first three entries at (row, column), each from 0 to 1 and clipped to that."""
    size = table.shape[0]
    y = min(max(row, 0.0), 1.0) * (size - 1)
    x = min(max(column, 0.0), 1.0) * (size - 1)
    i, j = min(max(int(y) - 1, 0), size - 4), min(max(int(x) - 1, 0), size - 4)
    a, b = _weights(y - i), _weights(x - j)
    p = q = r = 0.0
    for k in range(4):
        u = v = w = 0.0
        for n in range(4):
            u += b[n] * table[i + k, j + n, 0]
            v += b[n] * table[i + k, j + n, 1]
            w += b[n] * table[i + k, j + n, 2]
        p += a[k] * u
        q += a[k] * v
        r += a[k] * w
    return p, q, r


@compiled
def most_gamma(table: NDArray[np.float64], row: float) -> float:
    """Entry MOST of the peg table at a row from 0 to 1, clipped to that."""
    size = table.shape[0]
    y = min(max(row, 0.0), 1.0) * (size - 1)
    i = min(max(int(y) - 1, 0), size - 4)
    a = _weights(y - i)
    total: float = a[0] * table[i, 0, MOST] + a[1] * table[i + 1, 0, MOST]
    total += a[2] * table[i + 2, 0, MOST] + a[3] * table[i + 3, 0, MOST]
    return total


@compiled
def _weights(x: float) -> tuple[float, float, float, float]:
    """Of the cubic through values at 0, 1, 2 and 3."""
    x1, x2, x3 = x - 1.0, x - 2.0, x - 3.0
    low, high = x2 * x3, x * x1
    return x1 * low * (-1.0 / 6.0), x * low * 0.5, high * x3 * -0.5, high * x2 * (1.0 / 6.0)
