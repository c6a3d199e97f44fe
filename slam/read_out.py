"""Where the packet is: the population vector around its largest cell, compiled.

Source: OpenRatSLAM's PosecellNetwork.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled, cos, sin
from vibrissa.slam.angles import TAU
from vibrissa.slam.blur import whole, wrapped
from vibrissa.slam.packet import (
    ALIGNED,
    COLUMN,
    EXTENT,
    HEADING,
    LENGTH,
    ROW,
    START,
    layer_size,
    memory_of,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

HALF_WIDTH: Final = 3
WIDTH: Final = 2 * HALF_WIDTH + 1


def unit_circle(length: int) -> Floats:
    """float64[2, length]: sine and cosine of (n + 1) 2 pi / length, for the population vector."""
    angles = [(n + 1) * TAU / length for n in range(length)]
    return np.array([[sin(a) for a in angles], [cos(a) for a in angles]], dtype=np.float64)


@compiled
def read_out(
    state: Floats,
    highest: Floats,
    box: Ints,
    faithful: bool,
    circle_xy: Floats,
    circle_th: Floats,
    best: Floats,
    margin: int,
) -> bool:
    """Population vector of the 7 x 7 x 7 cells around the largest one, into best (x, y, th).

    Among equal cells the one of the lowest heading, row and column. False when none is positive.
    highest: room for a layer.
    """
    n, layers = circle_xy.shape[1], circle_th.shape[1]
    size = layer_size(box, margin)
    k, j, i = _largest(state, highest, box, margin, n, layers)
    if k < 0:
        return False
    stride = box[COLUMN, EXTENT] + 2 * margin
    # the sums along the three axes of the window
    along = highest[: 3 * WIDTH]
    along[:] = 0.0
    rows = np.empty(WIDTH, dtype=np.int64)
    columns = np.empty(WIDTH, dtype=np.int64)
    for d in range(WIDTH):
        rows[d] = memory_of(box, ROW, wrapped(j + d - HALF_WIDTH, n), margin, n)
        columns[d] = memory_of(box, COLUMN, wrapped(i + d - HALF_WIDTH, n), margin, n)
    for dk in range(WIDTH):
        b = wrapped(k + dk - HALF_WIDTH - box[HEADING, START], layers)
        if b >= box[HEADING, LENGTH]:
            continue
        layer_sum = 0.0
        for dj in range(WIDTH):
            if rows[dj] < 0:
                continue
            row = b * size + rows[dj] * stride
            row_sum = 0.0
            for di in range(WIDTH):
                if columns[di] >= 0:
                    value = state[row + columns[di]]
                    along[2 * WIDTH + di] += value
                    row_sum += value
            along[WIDTH + dj] += row_sum
            layer_sum += row_sum
        along[dk] += layer_sum
    best[0] = _population_vector(along[2 * WIDTH :], i - HALF_WIDTH, circle_xy, faithful)
    best[1] = _population_vector(along[WIDTH:], j - HALF_WIDTH, circle_xy, faithful)
    best[2] = _population_vector(along, k - HALF_WIDTH, circle_th, faithful)
    return True


@compiled
def _largest(
    state: Floats, highest: Floats, box: Ints, margin: int, n: int, layers: int
) -> tuple[int, int, int]:
    """Heading, row and column of the largest cell; (-1, -1, -1) when none is positive."""
    size = layer_size(box, margin)
    stride = box[COLUMN, EXTENT] + 2 * margin
    # without the margins of closed rows, which are not kept
    around = 0 if box[ROW, EXTENT] == n else 1
    begin = (margin - around) * stride
    end = begin + (box[ROW, EXTENT] + 2 * around) * stride
    first = begin // ALIGNED * ALIGNED
    count = whole(end - first)
    most = highest[:count]
    most[:] = 0.0
    for b in range(box[HEADING, LENGTH]):
        layer = state[b * size + first :]
        for x in range(count):
            most[x] = layer[x] if layer[x] > most[x] else most[x]
    largest = 0.0
    for x in range(begin - first, end - first):
        largest = most[x] if most[x] > largest else largest
    if not largest > 0.0:
        return -1, -1, -1
    for k in range(layers):
        b = wrapped(k - box[HEADING, START], layers)
        if b >= box[HEADING, LENGTH]:
            continue
        layer = state[b * size + first : b * size + first + count]
        hits = 0
        for x in range(count):
            hits += layer[x] == largest
        if hits:
            for j in range(n):
                row = memory_of(box, ROW, j, margin, n)
                if row < 0:
                    continue
                for i in range(n):
                    column = memory_of(box, COLUMN, i, margin, n)
                    if column >= 0 and state[b * size + row * stride + column] == largest:
                        return k, j, i
    return -1, -1, -1


@compiled
def _population_vector(sums: Floats, start: int, circle: Floats, faithful: bool) -> float:
    """Circular mean of the 7 cells from `start` on, weighted by `sums`, in [0, length)."""
    cells = circle.shape[1]
    length = float(cells)
    y = 0.0
    x = 0.0
    for d in range(WIDTH):
        cell = wrapped(start + d, cells)
        y += circle[0, cell] * sums[d]
        x += circle[1, cell] * sums[d]
    value = atan2(y, x) * length / TAU - 1.0
    while value < 0.0:
        value += length
    while value > length:
        value -= length
    if value == length and not faithful:
        value = 0.0
    return value
