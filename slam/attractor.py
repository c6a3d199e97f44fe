"""The pose cells' attractor: excitation, inhibition, path integration and read-out, compiled.

Source: OpenRatSLAM's PosecellNetwork. Activity is float64[heading, y, x] on a torus. `occupied`,
uint8[3, longest axis], marks the headings, rows and columns that hold any; all work is confined to
the marked layers and to the box of rows and columns around the marked ones, so that its cost
follows the packet and not the grid. The Gaussian kernels are applied one axis after the other,
which equals the three-dimensional convolution.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.slam.blur import (
    arc,
    blur_heading,
    blur_layer,
    box_window,
    dilate,
    torus_places,
    torus_window,
)
from vibrissa.slam.path_integration import COLUMN, HEADING, ROW, integrate, read_out

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Places = NDArray[np.uint64]


@compiled
def iterate(
    cells: Floats,
    occupied: Bytes,
    work: Floats,
    padded: Floats,
    excite: Floats,
    inhibit: Floats,
    global_inhibition: float,
    step: float,
    spin: float,
    iterations: int,
    faithful: bool,
    directions: Floats,
    circle_xy: Floats,
    circle_th: Floats,
    best: Floats,
) -> bool:
    """Iterations of the network with motion `step` (cells) and `spin` (heading cells) each.

    False when no activity is left. work: float64[2, headings + 1, room for a layer], the last
    layer zero; padded: float64[2, room for a layer]. A layer takes n + 2 radii rows of as many
    columns.
    """
    layers = cells.shape[0]
    n = cells.shape[1]
    flat = cells.reshape(layers, n * n)
    blurred, excited = work[0], work[1]
    alive = occupied[HEADING]
    out_radius, in_radius = excite.shape[0] - 1, inhibit.shape[0] - 1
    for _ in range(iterations):
        top, height = arc(occupied[ROW], n)
        left, width = arc(occupied[COLUMN], n)
        grown_height = min(n, height + 2 * out_radius)
        grown_width = min(n, width + 2 * out_radius)
        top -= (grown_height - height) // 2
        left -= (grown_width - width) // 2
        height, width = grown_height, grown_width
        rows = torus_places(top - out_radius, height + 2 * out_radius, n)
        columns = torus_places(left - out_radius, width + 2 * out_radius, n)
        window = torus_window(rows, columns, n)
        size = height * width
        for k in range(layers):
            if alive[k]:
                blur_layer(blurred[k], flat[k], window, columns.shape[0], excite, padded)
        raised = dilate(alive, layers, out_radius)
        for k in range(layers):
            if raised[k]:
                blur_heading(excited[k, :size], blurred, alive, k, excite)
        for k in range(layers):
            if alive[k]:
                for p in range(out_radius, rows.shape[0] - out_radius):
                    flat[k, rows[p] * n : rows[p] * n + n] = 0.0

        kept = dilate(raised, layers, in_radius)
        low_row, high_row, low_column, high_column = 0, height, 0, width
        if not faithful:
            # without negative activity inhibition only lowers: little is already nothing
            low_row, high_row, low_column, high_column = _enough(
                excited, raised, kept, height, width, global_inhibition
            )
        if high_row <= low_row:
            return False
        for k in range(layers):
            if kept[k] and not raised[k]:
                excited[k, :size] = 0.0
        low_row -= in_radius
        low_column -= in_radius
        inner_height = high_row - low_row + in_radius
        inner_width = high_column - low_column + in_radius
        total = _inhibit(
            excited,
            blurred,
            raised,
            kept,
            size,
            box_window(low_row, inner_height, low_column, inner_width, height, width, n),
            inner_width,
            inhibit,
            global_inhibition,
            padded,
        )
        if not total > 0.0:
            return False
        occupied[:] = 0
        integrate(
            cells,
            occupied,
            blurred,
            kept,
            torus_places(top + low_row + in_radius, inner_height - 2 * in_radius, n),
            torus_places(left + low_column + in_radius, inner_width - 2 * in_radius, n),
            1.0 / total,
            step,
            spin,
            faithful,
            directions,
        )
    return read_out(cells, occupied, faithful, circle_xy, circle_th, best)


@compiled
def _enough(
    excited: Floats,
    raised: Bytes,
    kept: Bytes,
    height: int,
    width: int,
    least: float,
) -> tuple[int, int, int, int]:
    """Mark the layers and bound the rows and columns where some activity reaches `least`."""
    size = height * width
    highest = np.zeros(size)
    for k in range(raised.shape[0]):
        kept[k] = 0
        if raised[k]:
            layer = excited[k, :size]
            enough = 0
            for x in range(size):
                enough += layer[x] >= least
                highest[x] = layer[x] if layer[x] > highest[x] else highest[x]
            kept[k] = enough > 0
    low_row, high_row, low_column, high_column = height, 0, width, 0
    for j in range(height):
        for i in range(width):
            if highest[j * width + i] >= least:
                low_row, high_row = min(low_row, j), j + 1
                low_column, high_column = min(low_column, i), max(high_column, i + 1)
    return low_row, high_row, low_column, high_column


@compiled
def _inhibit(
    excited: Floats,
    result: Floats,
    raised: Bytes,
    kept: Bytes,
    size: int,
    window: Places,
    window_width: int,
    weights: Floats,
    global_inhibition: float,
    padded: Floats,
) -> float:
    """What inhibition leaves of the kept layers within a box, and its sum.

    window: the box and a radius around it, `window_width` wide, as places in `excited`.
    """
    radius = weights.shape[0] - 1
    height = window.shape[0] // window_width - 2 * radius
    width = window_width - 2 * radius
    sums = np.zeros(width)
    line = np.zeros(size + 1)
    for k in range(kept.shape[0]):
        if not kept[k]:
            continue
        blur_heading(line[:size], excited, raised, k, weights)
        blur_layer(result[k], line, window, window_width, weights, padded)
        for j in range(height):
            start = int(window[(j + radius) * window_width + radius])
            here = excited[k, start : start + width]
            lost = result[k, j * width : j * width + width]
            for x in range(width):
                value = here[x] - lost[x]
                value = value - global_inhibition if value >= global_inhibition else 0.0
                lost[x] = value
                sums[x] += value
    total = 0.0
    for x in range(width):
        total += sums[x]
    return total
