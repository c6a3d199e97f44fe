"""The exact beam, precomputed: tables of the elastica and their interpolation.

A table is float64[SIZE, SIZE, 4] over two coordinates from 0 to 1, read with cubic Lagrange
interpolation. Two kinds:

- peg: rows q, the diameter at the peg's distance over the base's, from LEAST_Q to 1; columns
  s = 1 - sqrt(1 - (turned / most)^2), with turned nearly gamma (`turned_by`) and most that of the
  impingement beyond which no equilibrium exists and the shaft slides off. There the moment falls
  like a square root; in s it is smooth. Entries: moment over 3 q turned, the small-angle one; (arc
  length - 1) over turned^2; angle of the shaft at the contact over turned; most. Valid for every
  shaft: only q tells them apart.
- tip on a plane, one for each tip over base diameter: rows `first`, the angle to the plane's normal
  at which the straight shaft touches, from LEAST_FIRST to MOST_FIRST (a plane a length or a
  twentieth of it away); columns the angle turned since, up to a push straight at the plane. Where
  the tip comes to lie along the plane the answer has a kink. It runs along the middle column of the
  second half of the rows; in the first half it isn't reached, and only the first half of the
  columns is in use. Entries: moment over the small-angle one, times height; offset of the contact
  along the plane over offset + height; arc length to it over the length; angle turned at the middle
  column over first. The border between the halves, rad, is in the last column of the first row.

Built with the project's own arithmetic only, so the bits are the same on every machine.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vibrissa.compilation import kept
from vibrissa.numerics import atan2, compiled, cos, sin
from vibrissa.rig.elastica import (
    LYING,
    PEG,
    TIP,
    follow_tip,
    last_peg,
    lying_force,
    peg_between,
    shoot,
    solve,
    straight_push,
    tip_lying,
    tip_result,
)

Float64s = NDArray[np.float64]

SIZE = 73
STEPS = 64  # of the shooting, far finer than the interpolation
LEAST_Q = 0.1
FLATTENING = 0.28125  # atan(x) is nearly x / (1 + FLATTENING x^2)
LEAST_FIRST, MOST_FIRST = 1e-3, 1.5207754699891267  # rad
LEAST_HEIGHT, MOST_HEIGHT = 0.05, 0.9999995000000417  # their cosines
MOMENT, ARC, ANGLE, MOST = range(4)  # of the peg table
OFFSET, ARC_LENGTH, MIDDLE = 1, 2, 3  # of a tip table, besides MOMENT


@compiled
def turned_by(half: float) -> float:
    """An angle, nearly, from the tangent of its half: within 3 % up to 1.75 rad, by a division."""
    return 2.0 * half / (1.0 + FLATTENING * half * half)


@compiled
def _peg_row(q: float, row: NDArray[np.float64], steps: int) -> None:
    """Fill one row float64[SIZE, 4] of the peg table."""
    size = row.shape[0]
    last = last_peg(q, steps)
    most_excess, most_force, most_gamma = last
    most = turned_by(sin(0.5 * most_gamma) / cos(0.5 * most_gamma))
    force, arc = 0.0, 1.0
    for n in range(size):
        # gamma = 0 itself has no ratios; they hardly change up to a hundredth of the range.
        left = 1.0 - n / (size - 1)
        turned = most * math.sqrt(1.0 - left * left) if n > 0 else 0.01 * most
        # turned_by(half) = turned
        half = turned / (1.0 + math.sqrt(1.0 - FLATTENING * turned * turned))
        wanted = 2.0 * atan2(half, 1.0)
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
        row[n, MOMENT] = force * x / (3.0 * q * turned)
        row[n, ARC] = (arc - 1.0) / (turned * turned)
        row[n, ANGLE] = theta / turned
        row[n, MOST] = most
    row[0, MOMENT] = 1.0


@compiled
def _tip_row(r: float, first: float, most_force: float, row: Float64s, steps: int) -> None:
    """Fill one row float64[SIZE, 4] of a tip table.

    most_force: that of a tip which lies down as the push is straight; 0 where it never does.
    """
    half = row.shape[0] // 2
    height, middle, lying = cos(first), first, 0.0
    if most_force > 0.0:
        lying = lying_force(r, height, most_force, steps)
        middle = first - tip_lying(r, lying, steps)[1]
    kind, force, rest, turned = TIP, 0.0, first - 0.5 * math.pi, 0.0
    for n in range(row.shape[0] if most_force > 0.0 else half + 1):
        if n <= half:
            to = middle * (n / half if n > 0 else 1e-3)
        else:
            to = middle + (first - middle) * ((n - half) / half)
        if n == half and most_force > 0.0:
            kind, force, rest = LYING, lying, 1.0
        elif to > turned:
            kind, force, rest, _found = follow_tip(
                r, height, first, turned, to, kind, force, rest, steps
            )
        turned = to
        moment, offset, arc = tip_result(r, kind, force, rest, steps)
        row[n, MOMENT] = moment * height / (3.0 * r * to)
        row[n, OFFSET] = offset / (offset + height)
        row[n, ARC_LENGTH] = arc
    row[0, MOMENT], row[0, ARC_LENGTH] = height, 1.0
    row[0, OFFSET] = sin(first) / (sin(first) + height)
    row[:, MIDDLE] = middle / first


@compiled
def _tip_rows(r: float, table: Float64s, steps: int) -> None:
    size = table.shape[0]
    half = size // 2
    most_force = straight_push(r, steps)
    straight = tip_lying(r, most_force, steps)[0]
    border = atan2(math.sqrt(1.0 - straight * straight), straight)
    for n in range(half + 1):
        first = LEAST_FIRST + (border - LEAST_FIRST) * (n / half)
        _tip_row(r, first, 0.0, table[n], steps)
    for n in range(1, half + 1):
        first = border + (MOST_FIRST - border) * (n / half)
        _tip_row(r, first, most_force, table[half + n], steps)
    for n in range(half + 1, size):
        table[half, n] = table[half, half]
    table[0, size - 1, MIDDLE] = border


@lru_cache(maxsize=8)
def peg_table(size: int = SIZE) -> NDArray[np.float64]:
    """The peg table, float64[size, size, 4], read-only; size: odd and at least 7."""
    table = _empty(size)

    def make() -> NDArray[np.float64]:
        for n in range(size):
            _peg_row(LEAST_Q + (1.0 - LEAST_Q) * n / (size - 1), table[n], STEPS)
        return table

    return kept(_peg_row, None, table.shape, make)


@lru_cache(maxsize=64)
def tip_table(r: float, size: int = SIZE) -> NDArray[np.float64]:
    """The table of a tip on a plane, float64[size, size, 4], read-only; r: tip over base."""
    table = _empty(size)

    def make() -> NDArray[np.float64]:
        _tip_rows(r, table, STEPS)
        return table

    return kept(_tip_rows, r, table.shape, make)


def _empty(size: int) -> NDArray[np.float64]:
    if size < 7 or size % 2 == 0:
        raise ValueError(f"beam table: expected an odd size of at least 7, found {size}")
    return np.zeros((size, size, 4), dtype=np.float64)


@compiled
def interpolate(
    table: Float64s, rows: tuple[int, int], row: float, columns: tuple[int, int], column: float
) -> tuple[float, float, float]:
    """The first three entries, in the part of a table between nodes ``rows`` and ``columns``.

    rows, columns: (first, last), at least 3 apart; row, column: where between them, from 0 to 1 and
    clipped to that.
    """
    i, y = _stencil(rows, row)
    j, x = _stencil(columns, column)
    a, b = _weights(y), _weights(x)
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
def interpolate_peg(table: Float64s, row: float, column: float) -> tuple[float, float, float]:
    """The first three entries of the peg table, row and column from 0 to 1 and clipped to that."""
    whole = (0, table.shape[0] - 1)
    return interpolate(table, whole, row, whole, column)


@compiled
def interpolate_tip(
    table: Float64s, height: float, first: float, turned: float
) -> tuple[float, float, float]:
    """(moment over the small-angle one, times height; offset; arc length) from a tip table.

    height: of the base over the length, cos(first); first, turned: rad, 0 <= turned <= first.
    """
    last = table.shape[0] - 1
    half = last // 2
    border = table[0, last, MIDDLE]
    left, right = (0, half), (half, last)
    rows, columns = left, left
    row, column = (first - LEAST_FIRST) / (border - LEAST_FIRST), turned / first
    if first >= border:
        rows, row = right, (first - border) / (MOST_FIRST - border)
        middle = first * interpolate_row(table, right, row)
        column = turned / middle
        if turned >= middle:
            columns, column = right, (turned - middle) / max(first - middle, 1e-9)
    moment, share, arc = interpolate(table, rows, row, columns, column)
    return moment, height * share / (1.0 - share), arc


@compiled
def interpolate_row(table: Float64s, rows: tuple[int, int], row: float) -> float:
    """The fourth entry, which is the same in all columns but for those out of use."""
    i, y = _stencil(rows, row)
    a = _weights(y)
    total: float = a[0] * table[i, 0, 3] + a[1] * table[i + 1, 0, 3]
    total += a[2] * table[i + 2, 0, 3] + a[3] * table[i + 3, 0, 3]
    return total


@compiled
def most_turned(table: Float64s, row: float) -> float:
    """Entry MOST of the peg table at a row from 0 to 1, clipped to that."""
    return interpolate_row(table, (0, table.shape[0] - 1), row)


@compiled
def _stencil(nodes: tuple[int, int], at: float) -> tuple[int, float]:
    """First of the four nodes around a place between two nodes, and the place counted from it."""
    first, last = nodes
    x = min(max(at, 0.0), 1.0) * (last - first)
    i = min(max(int(x) - 1, 0), last - first - 3)
    return first + i, x - i


@compiled
def _weights(x: float) -> tuple[float, float, float, float]:
    """Of the cubic through values at 0, 1, 2 and 3."""
    x1, x2, x3 = x - 1.0, x - 2.0, x - 3.0
    low, high = x2 * x3, x * x1
    return x1 * low * (-1.0 / 6.0), x * low * 0.5, high * x3 * -0.5, high * x2 * (1.0 / 6.0)
