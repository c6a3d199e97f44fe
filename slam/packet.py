"""The box of the pose-cell torus that holds the activity, and how it lies in memory, compiled.

`box`, int64[3, 4], has for each of heading, row and column the place on the torus where the box
starts, its length, where that start lies in memory, and the extent of the room around it.

A volume is one long array of layers, layer b at heading start + b. A layer has a margin, the rows
of the extent, and a margin; a row likewise. An axis on which the packet can reach round the torus
is closed: its extent is the whole ring, in order, and its margins repeat the other end. On another
axis what surrounds the box is zero. So every stage is a flat loop, and what such a loop leaves in
margins is overwritten by `close` before it is read.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.slam.blur import LANES, arc, wrapped

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

HEADING: Final = 0
ROW: Final = 1
COLUMN: Final = 2
"""Rows of a box."""
START: Final = 0
LENGTH: Final = 1
FIRST: Final = 2
EXTENT: Final = 3
"""Columns of a box."""
STATE: Final = 0
SPARE: Final = 1
BLURRED: Final = 2
EXCITED: Final = 3
LINES: Final = 4
"""Volumes of `work`: activity, room to move it or its result, two stages, single layers."""
LINE_COUNT: Final = 4
ALIGNED: Final = 8
"""Cells of a cache line: loads within one are twice as fast as loads across two."""
LEAST_MARGIN: Final = 3
"""Room for a step of one cell beyond the extent, and to look one row and a cell beyond that."""


@compiled
def margin_of(excite: Floats, inhibit: Floats) -> int:
    """Cells around the extent of a layer."""
    return int(max(excite.shape[0] - 1, inhibit.shape[0] - 1, LEAST_MARGIN))


@compiled
def packet_reach(excite: Floats, inhibit: Floats, faithful: bool) -> int:
    """Cells that one iteration can spread activity before it moves.

    In faithful mode some is negative, and what inhibition makes of that is activity.
    """
    reach = int(excite.shape[0] - 1)
    return reach + int(inhibit.shape[0] - 1) if faithful else reach


@compiled
def _size(height: int, width: int) -> int:
    # in whole cache lines, and flat loops may run over the end
    return int((height * width + ALIGNED - 1) // ALIGNED * ALIGNED + LANES)


@compiled
def layer_size(box: Ints, margin: int) -> int:
    """Cells of a layer in memory."""
    height, width = box[ROW, EXTENT] + 2 * margin, box[COLUMN, EXTENT] + 2 * margin
    size: int = _size(height, width)
    return size


def empty_box(layers: int) -> Ints:
    """The box of a network of `layers` headings without activity."""
    box = np.zeros((3, 4), dtype=np.int64)
    box[HEADING, EXTENT] = layers
    return box


def working_room(n: int, layers: int, excite: Floats, inhibit: Floats) -> Floats:
    """float64[5, cells] of zeros; behind the `layers` layers of a volume one always stays zero."""
    largest = int(largest_layer(n, int(margin_of(excite, inhibit))))
    cells = (max(layers, LINE_COUNT) + 2) * largest
    room = np.zeros((LINES + 1) * cells + ALIGNED, dtype=np.float64)
    start = -(room.ctypes.data // room.itemsize) % ALIGNED
    return room[start : start + (LINES + 1) * cells].reshape(LINES + 1, cells)


@compiled
def largest_layer(n: int, margin: int) -> int:
    """Cells of a layer that holds the whole torus, in memory."""
    size: int = _size(n + 2 * margin, n + 2 * margin)
    return size


@compiled
def zero_layer(n: int, margin: int, layers: int) -> int:
    """Where in a volume the layer that stays zero begins."""
    return int(max(layers, LINE_COUNT) * largest_layer(n, margin))


@compiled
def close(layer: Floats, height: int, width: int, margin: int, radius: int, n: int) -> None:
    """Write `radius` cells around the extent of a layer: a closed axis' other end, or zero."""
    close_columns(layer, height, width, margin, radius, n)
    close_rows(layer, height, width + 2 * margin, margin, radius, n)


@compiled
def close_columns(layer: Floats, height: int, width: int, margin: int, radius: int, n: int) -> None:
    """As `close`, the columns alone."""
    stride = width + 2 * margin
    for j in range(margin, margin + height):
        start = j * stride + margin
        if width == n and n >= radius:
            for t in range(1, radius + 1):
                layer[start - t] = layer[start + n - t]
                layer[start + n - 1 + t] = layer[start + t - 1]
        elif width == n:
            for t in range(1, radius + 1):
                layer[start - t] = layer[start + wrapped(-t, n)]
                layer[start + n - 1 + t] = layer[start + wrapped(t - 1, n)]
        else:
            for t in range(1, radius + 1):
                layer[start - t] = 0.0
                layer[start + width - 1 + t] = 0.0


@compiled
def close_rows(layer: Floats, height: int, stride: int, margin: int, radius: int, n: int) -> None:
    """As `close`, the rows alone."""
    for t in range(1, radius + 1):
        above = layer[(margin - t) * stride : (margin - t + 1) * stride]
        below = layer[(margin + height - 1 + t) * stride : (margin + height + t) * stride]
        if height == n:
            last = layer[(margin + wrapped(-t, n)) * stride :]
            first = layer[(margin + wrapped(t - 1, n)) * stride :]
            for x in range(stride):
                above[x] = last[x]
                below[x] = first[x]
        else:
            for x in range(stride):
                above[x] = 0.0
                below[x] = 0.0


@compiled
def place_in(box: Ints, axis: int, offset: int, margin: int, n: int) -> int:
    """Row or column in memory of the cell `offset` behind the start of the box."""
    place = box[axis, FIRST] + offset
    return int(place - n if box[axis, EXTENT] == n and place >= margin + n else place)


@compiled
def memory_of(box: Ints, axis: int, place: int, margin: int, n: int) -> int:
    """Row or column in memory of a place on the torus; -1 when over a cell beyond the extent."""
    extent = box[axis, EXTENT]
    found = box[axis, FIRST] + wrapped(place - box[axis, START], n)
    if found >= margin + (n if extent == n else extent + 1):
        found -= n
    return int(found if found >= margin - 1 else -1)


@compiled
def settle(work: Floats, box: Ints, wanted: Ints, reach: int, margin: int, n: int) -> int:
    """Give the box that starts and ends as `wanted` says room for its activity to spread by
    `reach` and one; return the volume it is in.

    `wanted` may be larger than the box, and becomes it.
    """
    same = True
    for axis in (ROW, COLUMN):
        length = wanted[axis, LENGTH]
        # no kernel and no step may see the box from behind
        closed = length + 2 * reach + margin > n
        wanted[axis, EXTENT] = n if closed else length + 2 * reach
        wanted[axis, FIRST] = margin + (wanted[axis, START] if closed else reach)
        same = same and box[axis, EXTENT] == wanted[axis, EXTENT]
        same = same and (closed or (box[axis] == wanted[axis]).all())
    if same and (box[HEADING] == wanted[HEADING]).all():
        box[:] = wanted
        return STATE
    _move(work[STATE], box, work[SPARE], wanted, margin, n)
    box[:] = wanted
    return SPARE


@compiled
def _move(source: Floats, box: Ints, out: Floats, wanted: Ints, margin: int, n: int) -> None:
    """Copy the box to where `wanted` has it, all else zero."""
    size, new_size = layer_size(box, margin), layer_size(wanted, margin)
    stride = box[COLUMN, EXTENT] + 2 * margin
    new_stride = wanted[COLUMN, EXTENT] + 2 * margin
    down = wrapped(box[ROW, START] - wanted[ROW, START], n)
    aside = wrapped(box[COLUMN, START] - wanted[COLUMN, START], n)
    ahead = box[HEADING, START] - wanted[HEADING, START]
    if ahead < 0:
        ahead += box[HEADING, EXTENT]
    out[: wanted[HEADING, LENGTH] * new_size] = 0.0
    width = box[COLUMN, LENGTH]
    left = place_in(box, COLUMN, 0, margin, n)
    new_left = place_in(wanted, COLUMN, aside, margin, n)
    straight = (
        place_in(box, COLUMN, width - 1, margin, n) == left + width - 1
        and place_in(wanted, COLUMN, aside + width - 1, margin, n) == new_left + width - 1
    )
    for b in range(box[HEADING, LENGTH]):
        for p in range(box[ROW, LENGTH]):
            row = b * size + place_in(box, ROW, p, margin, n) * stride
            new_row = (b + ahead) * new_size
            new_row += place_in(wanted, ROW, wrapped(p + down, n), margin, n) * new_stride
            if straight:
                here = source[row + left : row + left + width]
                there = out[new_row + new_left : new_row + new_left + width]
                for x in range(width):
                    there[x] = here[x]
            else:
                for x in range(width):
                    there_x = place_in(wanted, COLUMN, wrapped(x + aside, n), margin, n)
                    out[new_row + there_x] = source[row + place_in(box, COLUMN, x, margin, n)]
    if wanted[COLUMN, EXTENT] == n:
        for b in range(wanted[HEADING, LENGTH]):
            layer = out[b * new_size : (b + 1) * new_size]
            close_columns(layer, wanted[ROW, EXTENT], n, margin, margin, n)


@compiled
def shrink(box: Ints, axis: int, marks: Bytes, margin: int, n: int) -> None:
    """Let an axis of the box hold the marked places of its extent."""
    if box[axis, EXTENT] == n:
        box[axis, START], box[axis, LENGTH] = arc(marks, n)
        box[axis, FIRST] = margin + box[axis, START]
        return
    first, last = -1, -1
    for place in range(marks.shape[0]):
        if marks[place]:
            first = place if first < 0 else first
            last = place
    moved = margin + first - box[axis, FIRST]
    box[axis, START] = wrapped(box[axis, START] + moved, n)
    box[axis, FIRST] += moved
    box[axis, LENGTH] = last - first + 1


@compiled
def grow(box: Ints, axis: int, back: int, on: int, margin: int, n: int) -> None:
    """Let an axis of the box begin `back` cells earlier and end `on` later, at most one."""
    box[axis, LENGTH] = min(box[axis, LENGTH] + back + on, n)
    box[axis, START] = wrapped(box[axis, START] - back, n)
    if box[axis, EXTENT] == n:
        box[axis, FIRST] = margin + box[axis, START]
    else:
        box[axis, FIRST] -= back


@compiled
def add(
    work: Floats,
    box: Ints,
    at: tuple[int, int, int],
    energy: float,
    margin: int,
    n: int,
    reach: int,
) -> None:
    """Add activity to the cell at (heading, row, column); the box grows until it holds it."""
    wanted = box.copy()
    for axis in range(3):
        around = box[HEADING, EXTENT] if axis == HEADING else n
        start, length = box[axis, START], box[axis, LENGTH]
        if length == 0:
            wanted[axis, START], wanted[axis, LENGTH] = at[axis], 1
            continue
        ahead = wrapped(at[axis] - start, around)
        if ahead >= length:
            if around - ahead < ahead - length + 1:
                wanted[axis, START] = at[axis]
                wanted[axis, LENGTH] += around - ahead
            else:
                wanted[axis, LENGTH] = ahead + 1
    if settle(work, box, wanted, reach, margin, n) == SPARE:
        used = box[HEADING, LENGTH] * layer_size(box, margin)
        work[STATE, :used] = work[SPARE, :used]
    size = layer_size(box, margin)
    b = wrapped(at[0] - box[HEADING, START], box[HEADING, EXTENT])
    row = place_in(box, ROW, wrapped(at[1] - box[ROW, START], n), margin, n)
    column = place_in(box, COLUMN, wrapped(at[2] - box[COLUMN, START], n), margin, n)
    layer = work[STATE, b * size : (b + 1) * size]
    layer[row * (box[COLUMN, EXTENT] + 2 * margin) + column] += energy
    close_columns(layer, box[ROW, EXTENT], box[COLUMN, EXTENT], margin, margin, n)


@compiled
def write_cells(cells: Floats, work: Floats, box: Ints, margin: int) -> None:
    """Write the activity of the box into the empty cells[heading, row, column]."""
    layers, n = cells.shape[0], cells.shape[1]
    size, stride = layer_size(box, margin), box[COLUMN, EXTENT] + 2 * margin
    for b in range(box[HEADING, LENGTH]):
        layer = work[STATE, b * size : (b + 1) * size]
        k = wrapped(box[HEADING, START] + b, layers)
        for p in range(box[ROW, LENGTH]):
            j = wrapped(box[ROW, START] + p, n)
            row = place_in(box, ROW, p, margin, n) * stride
            for x in range(box[COLUMN, LENGTH]):
                i = wrapped(box[COLUMN, START] + x, n)
                cells[k, j, i] = layer[row + place_in(box, COLUMN, x, margin, n)]
