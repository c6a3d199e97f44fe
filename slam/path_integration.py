"""Path integration and read-out of the pose cells, compiled.

Source: OpenRatSLAM's PosecellNetwork. Activity is float64[heading, y, x] on a torus; `occupied`,
uint8[3, longest axis], marks the headings, rows and columns that hold any.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled, cos, sin
from vibrissa.slam.angles import TAU
from vibrissa.slam.blur import wrapped

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

READOUT_HALF_WIDTH: Final = 3
HEADING: Final = 0
ROW: Final = 1
COLUMN: Final = 2
"""Rows of `occupied`."""


def unit_circle(length: int) -> Floats:
    """float64[2, length]: sine and cosine of (n + 1) 2 pi / length, for the population vector."""
    angles = [(n + 1) * TAU / length for n in range(length)]
    return np.array([[sin(a) for a in angles], [cos(a) for a in angles]], dtype=np.float64)


@compiled
def integrate(
    cells: Floats,
    occupied: Bytes,
    source: Floats,
    kept: Bytes,
    rows: Ints,
    columns: Ints,
    scale: float,
    step: float,
    spin: float,
    faithful: bool,
    directions: Floats,
) -> None:
    """Add `source` times `scale`, moved by step and spin, to the empty `cells`; mark `occupied`.

    source[k, y * len(columns) + x] is the activity of the cell in rows[y], columns[x].
    """
    layers = cells.shape[0]
    n = cells.shape[1]
    speed = abs(step)
    sign = 1 if spin > 0.0 else -1
    turns = abs(spin)
    low = math.floor(turns)
    high = math.ceil(turns)
    far = turns - (high - 1) if spin != 0.0 else 0.0
    reached = np.zeros(columns.shape[0], dtype=np.uint8)
    for k in range(layers):
        if not kept[k]:
            continue
        direction = directions[k]
        if step < 0.0:
            direction += math.pi
        quarter = math.floor(direction * 2.0 / math.pi)
        angle = direction - quarter * (math.pi / 2.0)
        quarter &= 3
        up = speed * cos(angle)
        right = speed * sin(angle)
        both = up * right
        to_right = right * (1.0 - up)
        to_up = up * (1.0 - right)
        stay = 1.0 - both - to_right - to_up
        # `up` and `right` in the frame turned by `quarter` quarter turns
        if quarter == 0:
            up_j, up_i, right_j, right_i = 1, 0, 0, 1
        elif quarter == 1:
            up_j, up_i, right_j, right_i = 0, 1, -1, 0
        elif quarter == 2:
            up_j, up_i, right_j, right_i = -1, 0, 0, -1
        else:
            up_j, up_i, right_j, right_i = 0, -1, 1, 0
        corner_j = n - 1 if up_j > right_j else 0
        corner_i = n - 1 if up_i > right_i else 0
        first = (k + sign * low) % layers
        second = (k + sign * high) % layers
        for y in range(rows.shape[0]):
            any_here = False
            j = rows[y]
            j_up = wrapped(j + up_j, n)
            j_right = wrapped(j + right_j, n)
            j_both = wrapped(j_up + right_j, n)
            for x in range(columns.shape[0]):
                value = source[k, y * columns.shape[0] + x]
                if value == 0.0:
                    continue
                value *= scale
                i = columns[x]
                i_up = wrapped(i + up_i, n)
                i_right = wrapped(i + right_i, n)
                i_both = wrapped(i_up + right_i, n)
                kept_up, kept_right = 1.0, 1.0
                if faithful:
                    # what leaves one corner upwards and the opposite one to the right is lost
                    if j == corner_j and i == corner_i:
                        kept_up = 0.0
                    if j == n - 1 - corner_j and i == n - 1 - corner_i:
                        kept_right = 0.0
                any_here = True
                reached[x] = 1
                for part in range(2):
                    weight = (1.0 - far if part == 0 else far) * value
                    if weight == 0.0:
                        continue
                    layer = first if part == 0 else second
                    occupied[HEADING, layer] = 1
                    cells[layer, j, i] += weight * stay
                    cells[layer, j_up, i_up] += weight * to_up * kept_up
                    cells[layer, j_right, i_right] += weight * to_right * kept_right
                    cells[layer, j_both, i_both] += weight * both
            if any_here:
                for j_reached in (j, j_up, j_right, j_both):
                    occupied[ROW, j_reached] = 1
    for x in range(columns.shape[0]):
        if reached[x]:
            for aside in range(-1, 2):
                occupied[COLUMN, wrapped(columns[x] + aside, n)] = 1


@compiled
def read_out(
    cells: Floats,
    occupied: Bytes,
    faithful: bool,
    circle_xy: Floats,
    circle_th: Floats,
    best: Floats,
) -> bool:
    """Population vector of the 7 x 7 x 7 cells around the largest one, into best (x, y, th)."""
    layers = cells.shape[0]
    n = cells.shape[1]
    largest = 0.0
    at_k, at_j, at_i = -1, -1, -1
    for k in range(layers):
        if not occupied[HEADING, k]:
            continue
        for j in range(n):
            if not occupied[ROW, j]:
                continue
            for i in range(n):
                if cells[k, j, i] > largest:
                    largest = cells[k, j, i]
                    at_k, at_j, at_i = k, j, i
    if at_k < 0:
        return False
    half = READOUT_HALF_WIDTH
    sum_x = np.zeros(n)
    sum_y = np.zeros(n)
    sum_th = np.zeros(layers)
    for dk in range(-half, half + 1):
        k = wrapped(at_k + dk, layers)
        if not occupied[HEADING, k]:
            continue
        layer_sum = 0.0
        for dj in range(-half, half + 1):
            j = wrapped(at_j + dj, n)
            row_sum = 0.0
            for di in range(-half, half + 1):
                i = wrapped(at_i + di, n)
                value = cells[k, j, i]
                sum_x[i] += value
                row_sum += value
            sum_y[j] += row_sum
            layer_sum += row_sum
        sum_th[k] += layer_sum
    best[0] = _population_vector(sum_x, circle_xy, faithful)
    best[1] = _population_vector(sum_y, circle_xy, faithful)
    best[2] = _population_vector(sum_th, circle_th, faithful)
    return True


@compiled
def _population_vector(sums: Floats, circle: Floats, faithful: bool) -> float:
    """Circular mean of the cell numbers 0 .. n-1 weighted by `sums`, in [0, n)."""
    length = float(sums.shape[0])
    y = 0.0
    x = 0.0
    for i in range(sums.shape[0]):
        y += circle[0, i] * sums[i]
        x += circle[1, i] * sums[i]
    value = atan2(y, x) * length / TAU - 1.0
    while value < 0.0:
        value += length
    while value > length:
        value -= length
    if value == length and not faithful:
        value = 0.0
    return value
