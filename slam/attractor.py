"""The pose cells' attractor: excitation, inhibition, path integration and read-out, compiled.

Source: OpenRatSLAM's PosecellNetwork. All work is confined to the box of `packet.py` around the
activity, so that its cost follows the packet and not the grid. The Gaussian kernels are applied one
axis after the other, which equals the three-dimensional convolution.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.slam.blur import arc, blur_line, whole, wrapped
from vibrissa.slam.packet import (
    ALIGNED,
    BLURRED,
    COLUMN,
    EXCITED,
    EXTENT,
    HEADING,
    LENGTH,
    LINES,
    ROW,
    SPARE,
    START,
    STATE,
    close,
    close_rows,
    largest_layer,
    layer_size,
    margin_of,
    packet_reach,
    settle,
    shrink,
    zero_layer,
)
from vibrissa.slam.path_integration import integrate
from vibrissa.slam.read_out import read_out

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]


@compiled
def iterate(
    work: Floats,
    box: Ints,
    excite: Floats,
    inhibit: Floats,
    motion: Floats,
    circle_xy: Floats,
    circle_th: Floats,
    best: Floats,
    global_inhibition: float,
    step: float,
    spin: float,
    iterations: int,
    faithful: bool,
) -> bool:
    """Iterations of the network with motion `step` (cells) and `spin` (heading cells) each.

    work, box: as packet.py has them; motion: from motion_table; circles: from unit_circle.
    best: receives the packet's place. False when no activity is left.
    """
    for _ in range(iterations):
        if not _once(
            work,
            box,
            excite,
            inhibit,
            motion[1 if step < 0.0 else 0],
            circle_xy.shape[1],
            global_inhibition,
            abs(step),
            spin,
            faithful,
        ):
            return False
    margin = margin_of(excite, inhibit)
    return read_out(work[STATE], work[LINES], box, faithful, circle_xy, circle_th, best, margin)


@compiled
def _once(
    work: Floats,
    box: Ints,
    excite: Floats,
    inhibit: Floats,
    motion: Floats,
    n: int,
    global_inhibition: float,
    speed: float,
    spin: float,
    faithful: bool,
) -> bool:
    layers = box[HEADING, EXTENT]
    margin = margin_of(excite, inhibit)
    reach = packet_reach(excite, inhibit, faithful)
    source = work[settle(work, box, box.copy(), reach, margin, n)]
    height, width = box[ROW, EXTENT], box[COLUMN, EXTENT]
    size, stride = layer_size(box, margin), width + 2 * margin
    nothing = zero_layer(n, margin, layers)
    first = margin * stride
    count = whole(height * stride)
    end = first + count
    blurred, excited, result = work[BLURRED], work[EXCITED], work[SPARE]
    # the infinite `least` is where no `line` or `other` of another size ever was or will be
    lines, most = work[LINES], largest_layer(n, margin)
    line, other = lines[:size], lines[most : most + size]
    least, sums = lines[2 * most : 2 * most + size], lines[3 * most : 3 * most + size]

    places = np.empty(7, dtype=np.int64)
    length = box[HEADING, LENGTH]
    alive = np.zeros(layers, dtype=np.uint8)
    for b in range(length):
        layer = source[b * size :]
        used = 0
        for x in range(first, first + height * stride):
            used += layer[x] != 0.0
        if used == 0:
            continue
        alive[b] = 1
        close_rows(layer, height, stride, margin, excite.shape[0] - 1, n)
        blur_line(other[first:end], layer, first, stride, excite)
        blur_line(blurred[b * size + first : b * size + end], other, first, 1, excite)
    # what goes along headings or cell by cell starts with a cache line
    even = first // ALIGNED * ALIGNED
    last = even + whole(first + height * stride - even)
    raised = np.zeros(layers, dtype=np.uint8)
    for e in range(min(layers, length + 2 * reach)):
        out = excited[e * size + even : e * size + last]
        at = wrapped(e - reach, layers)
        raised[e] = _blur_heading(out, blurred, even, size, at, alive, nothing, excite, places)

    # a cell keeps what exceeds the global inhibition; in margins nothing does
    sums[:] = 0.0
    least[:] = np.inf
    for j in range(margin, margin + height):
        least[j * stride + margin : j * stride + margin + width] = global_inhibition
    floor, total = least[even:last], sums[even:last]
    kept = np.zeros(layers, dtype=np.uint8)
    start = box[HEADING, START] - reach
    for e in range(min(layers, length + 2 * reach)):
        if not (raised[e] or faithful):
            continue
        here = excited[e * size + even : e * size + last]
        left = result[e * size + even : e * size + last]
        enough = 0
        for x in range(here.shape[0]):
            enough += here[x] >= floor[x]
        # without negative activity inhibition only lowers: little is already nothing
        if enough == 0 and not faithful:
            continue
        _blur_heading(line[even:last], excited, even, size, e, raised, nothing, inhibit, places)
        close(line, height, width, margin, inhibit.shape[0] - 1, n)
        blur_line(other[first:end], line, first, stride, inhibit)
        blur_line(result[e * size + first : e * size + end], other, first, 1, inhibit)
        remaining = 0
        for x in range(here.shape[0]):
            value = here[x] - left[x]
            value = value - global_inhibition if value >= floor[x] else 0.0
            left[x] = value
            total[x] += value
            remaining += value > 0.0
        kept[wrapped(start + e, layers)] = remaining > 0
    if not kept.any():
        return False
    sum_of_all = _tighten(box, sums, kept, margin, n)
    offset = wrapped(box[HEADING, START] - start, layers)
    integrate(work, box, kept, offset, 1.0 / sum_of_all, motion, speed, spin, margin, n, faithful)
    return True


@compiled
def _blur_heading(
    out: Floats,
    volume: Floats,
    first: int,
    size: int,
    at: int,
    alive: Bytes,
    nothing: int,
    weights: Floats,
    places: Ints,
) -> bool:
    """The layer `at` of the circular convolution of the alive layers along heading, if any.

    places: room for seven numbers.
    """
    layers = alive.shape[0]
    radius = weights.shape[0] - 1
    reached = False
    for t in range(-radius, radius + 1):
        reached = reached or alive[wrapped(at + t, layers)] > 0
    if not reached:
        out[:] = 0.0
        return False
    if radius in (2, 3):
        for t in range(-radius, radius + 1):
            b = wrapped(at + t, layers)
            places[3 + t] = (b * size if alive[b] else nothing) + first
        here = volume[places[3] :]
        l1, r1 = volume[places[2] :], volume[places[4] :]
        l2, r2 = volume[places[1] :], volume[places[5] :]
        w0, w1, w2 = weights[0], weights[1], weights[2]
        if radius == 2:
            for x in range(out.shape[0]):
                out[x] = w0 * here[x] + w1 * (l1[x] + r1[x]) + w2 * (l2[x] + r2[x])
        else:
            w3 = weights[3]
            l3, r3 = volume[places[0] :], volume[places[6] :]
            for x in range(out.shape[0]):
                out[x] = (
                    w0 * here[x]
                    + w1 * (l1[x] + r1[x])
                    + w2 * (l2[x] + r2[x])
                    + w3 * (l3[x] + r3[x])
                )
        return True
    out[:] = 0.0
    for t in range(-radius, radius + 1):
        b = wrapped(at + t, layers)
        if alive[b]:
            w = weights[abs(t)]
            layer = volume[b * size + first :]
            for x in range(out.shape[0]):
                out[x] += w * layer[x]
    return True


@compiled
def _tighten(box: Ints, sums: Floats, kept: Bytes, margin: int, n: int) -> float:
    """Shrink the box to what holds activity; return the sum of all.

    kept: the headings that do; sums: of all headings, a layer.
    """
    height, width = box[ROW, EXTENT], box[COLUMN, EXTENT]
    stride = width + 2 * margin
    rows = np.zeros(height, dtype=np.uint8)
    columns = np.zeros(width, dtype=np.uint8)
    across = np.zeros(width)
    for j in range(height):
        row = sums[(margin + j) * stride + margin :]
        for x in range(width):
            across[x] += row[x]
        for x in range(width):
            if row[x] > 0.0:
                rows[j] = 1
                break
    total = 0.0
    for x in range(width):
        columns[x] = across[x] > 0.0
        total += across[x]
    box[HEADING, START], box[HEADING, LENGTH] = arc(kept, kept.shape[0])
    shrink(box, ROW, rows, margin, n)
    shrink(box, COLUMN, columns, margin, n)
    return total
