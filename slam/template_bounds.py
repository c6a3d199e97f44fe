"""Differences between a view and templates, exact and bounded from below, compiled."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.compilation import inlined
from vibrissa.numerics import compiled

UNROLLED: Final = 6
"""Cells compared per pass over a block."""
TOGETHER: Final = 3
"""Differences added up as bytes before they go into a sum of 16 bits: half the instructions."""
MOST: Final = 32767
"""No sum of differences is larger."""

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Sums = NDArray[np.uint16]
Places = NDArray[np.uint64]


@compiled
def quantise(template: Floats, rows_per_cell: int, levels: int, out: Bytes) -> float:
    """The cells of a template as whole levels; the largest rounding error of one, in levels."""
    rows, columns = template.shape
    worst = 0.0
    for y in range(0, rows, rows_per_cell):
        for x in range(columns):
            total = 0.0
            for r in range(rows_per_cell):
                total += template[y + r, x]
            exact = total * levels / rows_per_cell
            level = int(exact + 0.5)
            out[y // rows_per_cell * columns + x] = level
            worst = max(worst, abs(level - exact))
    return worst


@compiled
def _cost(
    view: Floats, template: Floats, margin: int, offset: int, panoramic: bool, limit: float
) -> float:
    """Sum of absolute differences at one shift, in row order; given up when above `limit`."""
    rows, columns = view.shape
    cost = 0.0
    for y in range(rows):
        if panoramic:
            for x in range(columns):
                cost += abs(view[y, x] - template[y, (x + offset) % columns])
        else:
            for x in range(columns - 2 * margin):
                cost += abs(view[y, margin + x] - template[y, offset + x])
        if cost > limit:
            break
    return cost


@compiled
def best_shift(
    view: Floats, template: Floats, margin: int, step: int, panoramic: bool, limit: float
) -> tuple[float, int]:
    """Least cost over all shifts (the first among equals), or something above `limit`."""
    shifts = view.shape[1] if panoramic else 2 * margin + 1
    least = np.inf
    at = 0
    for offset in range(0, shifts, step):
        cost = _cost(view, template, margin, offset, panoramic, min(limit, least))
        if cost < least:
            least = cost
            at = offset
    return least, at


@inlined
def _apart(a: int, b: int) -> int:
    return max(a, b) - min(a, b)


@compiled
def cell_bounds(
    mine: Bytes, under: Places, cells: Bytes, limit: int, partial: Sums, bound: Sums
) -> int:
    """Sum of the cells' differences at the best shift, for every lane; the least of them.

    Sums above `limit` may be incomplete. Loops over all lanes have no branch, so that they become
    vector instructions on bytes.
    """
    lanes = partial.shape[0]
    best = np.uint16(65535)
    for shift in range(under.shape[0]):
        least = np.uint16(0)
        for p in range(0, mine.shape[0], UNROLLED):
            m0, m1, m2 = mine[p], mine[p + 1], mine[p + 2]
            m3, m4, m5 = mine[p + 3], mine[p + 4], mine[p + 5]
            c0, c1, c2 = under[shift, p], under[shift, p + 1], under[shift, p + 2]
            c3, c4, c5 = under[shift, p + 3], under[shift, p + 4], under[shift, p + 5]
            least = np.uint16(65535)
            for lane in range(lanes):
                three = np.uint8(
                    _apart(m0, cells[c0, lane])
                    + _apart(m1, cells[c1, lane])
                    + _apart(m2, cells[c2, lane])
                )
                others = np.uint8(
                    _apart(m3, cells[c3, lane])
                    + _apart(m4, cells[c4, lane])
                    + _apart(m5, cells[c5, lane])
                )
                so_far = partial[lane] if p > 0 else np.uint16(0)
                total = np.uint16(so_far + np.uint16(three) + np.uint16(others))
                partial[lane] = total
                least = min(least, total)
            if least > limit:
                break
        for lane in range(lanes):
            bound[lane] = min(bound[lane], partial[lane]) if shift > 0 else partial[lane]
        best = min(best, least)
    return int(best)


@compiled
def pixel_bounds(
    view: Floats32,
    pixels: Floats32,
    used: int,
    margin: int,
    step: int,
    panoramic: bool,
    limit: float,
    partial: Floats32,
    bound: Floats32,
) -> None:
    """Cost in single precision at the best shift, for every lane; given up above `limit`."""
    rows, columns = view.shape
    compared = columns if panoramic else columns - 2 * margin
    shifts = columns if panoramic else 2 * margin + 1
    bound[:used] = np.float32(np.inf)
    for offset in range(0, shifts, step):
        partial[:used] = np.float32(0.0)
        for y in range(rows):
            for x in range(compared):
                mine = view[y, margin + x]
                theirs = pixels[y, (x + offset) % columns]
                for lane in range(used):
                    partial[lane] += abs(mine - theirs[lane])
            least = np.float32(np.inf)
            for lane in range(used):
                least = min(least, partial[lane])
            if least > limit:
                break
        for lane in range(used):
            bound[lane] = min(bound[lane], partial[lane])
