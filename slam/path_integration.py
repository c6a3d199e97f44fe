"""Path integration of the pose cells, compiled.

Source: OpenRatSLAM's PosecellNetwork. Layer k moves along (sin, cos) of 2 pi k / layers, turned
into the first quadrant: `up` and `right` are the ways along that quadrant's two sides.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled, cos, sin
from vibrissa.slam.angles import TAU
from vibrissa.slam.blur import whole, wrapped
from vibrissa.slam.packet import (
    ALIGNED,
    BLURRED,
    COLUMN,
    EXTENT,
    HEADING,
    LENGTH,
    ROW,
    SPARE,
    START,
    STATE,
    close_columns,
    close_rows,
    grow,
    layer_size,
    memory_of,
    zero_layer,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

UP_J: Final = (1, 0, -1, 0)
UP_I: Final = (0, 1, 0, -1)
RIGHT_J: Final = (0, -1, 0, 1)
RIGHT_I: Final = (1, 0, -1, 0)
"""`up` and `right` of each quadrant, rows and columns."""


def motion_table(layers: int) -> Floats:
    """float64[2, layers, 3]: forwards and backwards, (cos, sin) within the quadrant, quadrant."""
    table = np.empty((2, layers, 3), dtype=np.float64)
    for backwards in range(2):
        for k in range(layers):
            direction = k * TAU / layers + backwards * math.pi
            quarter = math.floor(direction * 2.0 / math.pi)
            angle = direction - quarter * (math.pi / 2.0)
            table[backwards, k] = cos(angle), sin(angle), quarter % 4
    return table


@compiled
def _move_layer(
    moved: Floats,
    layer: Floats,
    box: Ints,
    motion: Floats,
    speed: float,
    margin: int,
    n: int,
    faithful: bool,
) -> None:
    """One layer moved by `speed` cells, over its extent and one row more; junk in the margins.

    layer: one cell around the extent must be valid, two rows above and below it.
    """
    height, width = box[ROW, EXTENT], box[COLUMN, EXTENT]
    stride = width + 2 * margin
    up, right = speed * motion[0], speed * motion[1]
    quarter = int(motion[2])
    both = up * right
    to_right = right * (1.0 - up)
    to_up = up * (1.0 - right)
    stay = 1.0 - both - to_right - to_up
    up_step = UP_J[quarter] * stride + UP_I[quarter]
    right_step = RIGHT_J[quarter] * stride + RIGHT_I[quarter]
    first = (margin - 1) * stride
    here = layer[first:]
    below = layer[first - up_step :]
    aside = layer[first - right_step :]
    corner = layer[first - up_step - right_step :]
    out = moved[first : first + whole((height + 2) * stride)]
    for x in range(out.shape[0]):
        out[x] = stay * here[x] + to_up * below[x] + to_right * aside[x] + both * corner[x]
    if not faithful:
        return
    # what leaves one corner of the torus upwards and the opposite one to the right is lost
    j = n - 1 if UP_J[quarter] > RIGHT_J[quarter] else 0
    i = n - 1 if UP_I[quarter] > RIGHT_I[quarter] else 0
    row = memory_of(box, ROW, j + UP_J[quarter], margin, n)
    column = memory_of(box, COLUMN, i + UP_I[quarter], margin, n)
    if row >= 0 and column >= 0:
        to = row * stride + column
        moved[to] = stay * layer[to] + both * layer[to - up_step - right_step]


@compiled
def integrate(
    work: Floats,
    box: Ints,
    kept: Bytes,
    offset: int,
    scale: float,
    motion: Floats,
    speed: float,
    spin: float,
    margin: int,
    n: int,
    faithful: bool,
) -> None:
    """Move the activity by `speed` cells and `spin` heading cells, times `scale`.

    Layer b of the box is layer b + offset, on the ring of headings, of the volume SPARE; what is
    moved is in STATE, and the box follows. kept: the headings that hold activity; motion: half of
    motion_table.
    """
    layers, length = box[HEADING, EXTENT], box[HEADING, LENGTH]
    height, width = box[ROW, EXTENT], box[COLUMN, EXTENT]
    size = layer_size(box, margin)
    moved = work[BLURRED]
    back_j, on_j, back_i, on_i = 0, 0, 0, 0
    for b in range(length):
        k = wrapped(box[HEADING, START] + b, layers)
        if not kept[k]:
            continue
        layer = work[SPARE, wrapped(offset + b, layers) * size :]
        if width == n:
            close_columns(layer, height, width, margin, 1, n)
        close_rows(layer, height, width + 2 * margin, margin, 2, n)
        _move_layer(moved[b * size :], layer, box, motion[k], speed, margin, n, faithful)
        quarter = int(motion[k, 2])
        back_j = max(back_j, -UP_J[quarter], -RIGHT_J[quarter])
        on_j = max(on_j, UP_J[quarter], RIGHT_J[quarter])
        back_i = max(back_i, -UP_I[quarter], -RIGHT_I[quarter])
        on_i = max(on_i, UP_I[quarter], RIGHT_I[quarter])
    if speed > 0.0:
        grow(box, ROW, back_j, on_j, margin, n)
        grow(box, COLUMN, back_i, on_i, margin, n)
    nothing = zero_layer(n, margin, layers)
    _turn(work[STATE], moved, box, kept, scale, spin, nothing, margin, n)


@compiled
def _turn(
    out: Floats,
    moved: Floats,
    box: Ints,
    kept: Bytes,
    scale: float,
    spin: float,
    nothing: int,
    margin: int,
    n: int,
) -> None:
    """Write the layers of `moved` times `scale`, turned by `spin` heading cells, to `out`.

    nothing: where in `moved` a layer of zeros begins.
    """
    layers, length = box[HEADING, EXTENT], box[HEADING, LENGTH]
    sign = 1 if spin > 0.0 else -1
    turns = abs(spin)
    high = math.ceil(turns)
    far = turns - (high - 1) if spin != 0.0 else 0.0
    straight = far in (0.0, 1.0)
    start = box[HEADING, START] + sign * (high if straight or sign < 0 else high - 1)
    near = 1.0 if straight else (1.0 - far if sign > 0 else far)
    here_weight, behind_weight = scale * near, scale * (1.0 - near)
    size = layer_size(box, margin)
    stride = box[COLUMN, EXTENT] + 2 * margin
    end = (margin + box[ROW, EXTENT] + 1) * stride
    first = (margin - 1) * stride // ALIGNED * ALIGNED
    count = whole(end - first)
    new_length = length if straight else min(length + 1, layers)
    origin = box[HEADING, START]
    for b in range(new_length):
        before = wrapped(b - 1, layers)
        alive = kept[wrapped(origin + b, layers)]
        alive_before = kept[wrapped(origin + before, layers)]
        here = moved[(b * size if alive else nothing) + first :]
        behind = moved[(before * size if alive_before else nothing) + first :]
        to = out[b * size + first : b * size + first + count]
        for x in range(count):
            to[x] = here_weight * here[x] + behind_weight * behind[x]
        if box[COLUMN, EXTENT] == n:
            close_columns(out[b * size :], box[ROW, EXTENT], n, margin, margin, n)
    box[HEADING, START] = start % layers
    box[HEADING, LENGTH] = new_length
