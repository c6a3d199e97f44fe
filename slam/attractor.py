"""The pose cells' attractor: excitation, inhibition, path integration and read-out, compiled.

Source: OpenRatSLAM's PosecellNetwork. Activity is float64[heading, y, x] on a torus. `occupied`,
uint8[3, longest axis], marks the headings, rows and columns that hold any; all work is confined to
the marked layers and to the box of rows and columns around the marked ones, so that its cost
follows the packet and not the grid. The Gaussian kernels are applied one axis after the other,
which equals the three-dimensional convolution.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled, cos, exp, sin
from vibrissa.slam.angles import TAU

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Places = NDArray[np.uint64]

READOUT_HALF_WIDTH: Final = 3
HEADING, ROW, COLUMN = 0, 1, 2


def half_gaussian(width: int, sigma: float) -> Floats:
    """One side of the normalised Gaussian, centre first: the 3-D kernel is its outer product."""
    radius = width // 2
    half = [float(exp(-(a * a) / (2.0 * sigma * sigma))) for a in range(radius + 1)]
    total = half[0] + 2.0 * sum(half[1:])
    return np.array([h / total for h in half], dtype=np.float64)


def unit_circle(length: int) -> Floats:
    """float64[2, length]: sine and cosine of (n + 1) 2 pi / length, for the population vector."""
    angles = [(n + 1) * TAU / length for n in range(length)]
    return np.array([[sin(a) for a in angles], [cos(a) for a in angles]], dtype=np.float64)


@compiled
def _wrapped(index: int, length: int) -> int:
    """index modulo length, without a division when it is less than one length outside."""
    if index < 0:
        index += length
    elif index >= length:
        index -= length
    if index < 0 or index >= length:
        index %= length
    return index


@compiled
def _arc(marks: Bytes, length: int) -> tuple[int, int]:
    """Start and size of the shortest arc of a ring of `length` that holds all marked places."""
    first, last = -1, -1
    start, gap = 0, 0
    for place in range(length):
        if marks[place]:
            if first < 0:
                first = place
            elif place - last > gap:
                start, gap = place, place - last
            last = place
    if first < 0:
        return 0, 0
    if first + length - last > gap:
        start, gap = first, first + length - last
    return start, length - gap + 1


@compiled
def _blur_line(out: Floats, source: Floats, first: int, stride: int, weights: Floats) -> None:
    """out[x] = sum over taps t of weight |t| times source[first + x + t stride].

    Works on shifted slices: loops over plain indices are what the compiler vectorises.
    """
    m = out.shape[0]
    centre = source[first : first + m]
    w0 = weights[0]
    if weights.shape[0] == 4:
        w1, w2, w3 = weights[1], weights[2], weights[3]
        l1, r1 = source[first - stride :], source[first + stride :]
        l2, r2 = source[first - 2 * stride :], source[first + 2 * stride :]
        l3, r3 = source[first - 3 * stride :], source[first + 3 * stride :]
        for x in range(m):
            out[x] = (
                w0 * centre[x] + w1 * (l1[x] + r1[x]) + w2 * (l2[x] + r2[x]) + w3 * (l3[x] + r3[x])
            )
    elif weights.shape[0] == 3:
        w1, w2 = weights[1], weights[2]
        l1, r1 = source[first - stride :], source[first + stride :]
        l2, r2 = source[first - 2 * stride :], source[first + 2 * stride :]
        for x in range(m):
            out[x] = w0 * centre[x] + w1 * (l1[x] + r1[x]) + w2 * (l2[x] + r2[x])
    else:
        for x in range(m):
            out[x] = w0 * centre[x]
        for t in range(1, weights.shape[0]):
            w = weights[t]
            left, right = source[first - t * stride :], source[first + t * stride :]
            for x in range(m):
                out[x] += w * (left[x] + right[x])


@compiled
def _blur_layer(
    out: Floats,
    source: Floats,
    window: Places,
    width: int,
    weights: Floats,
    padded: Floats,
) -> None:
    """Convolve a window of a layer along y and x, less a margin of one radius all round.

    source[window[q]] is what lies at row q // width, column q % width of the window. Row j of the
    result starts at out[j * width]; it is 2 radii shorter, what follows is not used.
    """
    gathered, blurred = padded[0], padded[1]
    for q in range(window.shape[0]):
        gathered[q] = source[window[q]]
    r = weights.shape[0] - 1
    count = window.shape[0] - 2 * r * width
    _blur_line(blurred[:count], gathered, r * width, width, weights)
    _blur_line(out[: count - 2 * r], blurred, r, 1, weights)


@compiled
def _blur_heading(out: Floats, source: Floats, alive: Bytes, k: int, weights: Floats) -> None:
    """One layer of the circular convolution along heading; the layer behind the last is nothing."""
    layers = source.shape[0] - 1
    m = out.shape[0]
    radius = weights.shape[0] - 1
    near = np.full(7, layers, dtype=np.uint64)
    if radius in (2, 3):
        for t in range(-radius, radius + 1):
            neighbour = _wrapped(k + t, layers)
            if alive[neighbour]:
                near[3 + t] = neighbour
        l3, l2, l1, here, r1, r2, r3 = near[0], near[1], near[2], near[3], near[4], near[5], near[6]
        w0, w1, w2 = weights[0], weights[1], weights[2]
        if radius == 2:
            for x in range(m):
                out[x] = (
                    w0 * source[here, x]
                    + w1 * (source[l1, x] + source[r1, x])
                    + w2 * (source[l2, x] + source[r2, x])
                )
        else:
            w3 = weights[3]
            for x in range(m):
                out[x] = (
                    w0 * source[here, x]
                    + w1 * (source[l1, x] + source[r1, x])
                    + w2 * (source[l2, x] + source[r2, x])
                    + w3 * (source[l3, x] + source[r3, x])
                )
        return
    out[:] = 0.0
    for t in range(-radius, radius + 1):
        neighbour = _wrapped(k + t, layers)
        if alive[neighbour]:
            w = weights[abs(t)]
            for x in range(m):
                out[x] += w * source[neighbour, x]


@compiled
def _dilate(alive: Bytes, layers: int, radius: int) -> Bytes:
    result = np.zeros(layers, dtype=np.uint8)
    for k in range(layers):
        if alive[k]:
            for t in range(-radius, radius + 1):
                result[_wrapped(k + t, layers)] = 1
    return result


@compiled
def _torus_places(first: int, count: int, n: int) -> Ints:
    """first .. first + count - 1 on a ring of n places."""
    places = np.empty(count, dtype=np.int64)
    for p in range(count):
        places[p] = _wrapped(first + p, n)
    return places


@compiled
def _torus_window(rows: Ints, columns: Ints, n: int) -> Places:
    """Where the cells of rows x columns lie in a layer of n x n."""
    m = columns.shape[0]
    window = np.empty(rows.shape[0] * m, dtype=np.uint64)
    for p in range(rows.shape[0]):
        for x in range(m):
            window[p * m + x] = rows[p] * n + columns[x]
    return window


@compiled
def _box_window(
    top: int,
    rows: int,
    left: int,
    columns: int,
    height: int,
    width: int,
    stride: int,
    n: int,
) -> Places:
    """Where a window lies in a box of height x width; behind the box, height * stride, is a zero.

    A box as high or wide as the torus closes on itself.
    """
    window = np.empty(rows * columns, dtype=np.uint64)
    for p in range(rows):
        j = _wrapped(top + p, n) if height == n else top + p
        for x in range(columns):
            i = _wrapped(left + x, n) if width == n else left + x
            inside = 0 <= j < height and 0 <= i < width
            window[p * columns + x] = j * stride + i if inside else height * stride
    return window


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
        top, height = _arc(occupied[ROW], n)
        left, width = _arc(occupied[COLUMN], n)
        grown_height = min(n, height + 2 * out_radius)
        grown_width = min(n, width + 2 * out_radius)
        top -= (grown_height - height) // 2
        left -= (grown_width - width) // 2
        height, width = grown_height, grown_width
        rows = _torus_places(top - out_radius, height + 2 * out_radius, n)
        columns = _torus_places(left - out_radius, width + 2 * out_radius, n)
        window = _torus_window(rows, columns, n)
        stride = columns.shape[0]
        size = height * stride
        for k in range(layers):
            if alive[k]:
                _blur_layer(blurred[k], flat[k], window, stride, excite, padded)
        raised = _dilate(alive, layers, out_radius)
        for k in range(layers):
            if raised[k]:
                _blur_heading(excited[k, :size], blurred, alive, k, excite)
        for k in range(layers):
            if alive[k]:
                for p in range(out_radius, rows.shape[0] - out_radius):
                    flat[k, rows[p] * n : rows[p] * n + n] = 0.0

        kept = _dilate(raised, layers, in_radius)
        low_row, high_row, low_column, high_column = 0, height, 0, width
        if not faithful:
            # without negative activity inhibition only lowers: little is already nothing
            low_row, high_row, low_column, high_column = _enough(
                excited, raised, kept, height, width, stride, global_inhibition
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
            _box_window(low_row, inner_height, low_column, inner_width, height, width, stride, n),
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
            _torus_places(top + low_row + in_radius, inner_height - 2 * in_radius, n),
            _torus_places(left + low_column + in_radius, inner_width - 2 * in_radius, n),
            inner_width,
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
    stride: int,
    least: float,
) -> tuple[int, int, int, int]:
    """Mark the layers and bound the rows and columns where some activity reaches `least`."""
    size = height * stride
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
            if highest[j * stride + i] >= least:
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
    stride_out: int,
    weights: Floats,
    global_inhibition: float,
    padded: Floats,
) -> float:
    """What inhibition leaves of the kept layers within a box, and its sum.

    window: the box and a radius around it, `stride_out` wide, as places in `excited`. Row j of a
    layer of the result starts at j * stride_out.
    """
    radius = weights.shape[0] - 1
    height = window.shape[0] // stride_out - 2 * radius
    width = stride_out - 2 * radius
    sums = np.zeros(width)
    line = np.zeros(size + 1)
    for k in range(kept.shape[0]):
        if not kept[k]:
            continue
        _blur_heading(line[:size], excited, raised, k, weights)
        _blur_layer(result[k], line, window, stride_out, weights, padded)
        for j in range(height):
            start = int(window[(j + radius) * stride_out + radius])
            here = excited[k, start : start + width]
            lost = result[k, j * stride_out : j * stride_out + width]
            for x in range(width):
                value = here[x] - lost[x]
                value = value - global_inhibition if value >= global_inhibition else 0.0
                lost[x] = value
                sums[x] += value
    total = 0.0
    for x in range(width):
        total += sums[x]
    return total


@compiled
def integrate(
    cells: Floats,
    occupied: Bytes,
    source: Floats,
    kept: Bytes,
    rows: Ints,
    columns: Ints,
    stride: int,
    scale: float,
    step: float,
    spin: float,
    faithful: bool,
    directions: Floats,
) -> None:
    """Add `source` times `scale`, moved by step and spin, to the empty `cells`; mark `occupied`.

    source[k, y * stride + x] is the activity of the cell in rows[y], columns[x].
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
            j_up = _wrapped(j + up_j, n)
            j_right = _wrapped(j + right_j, n)
            j_both = _wrapped(j_up + right_j, n)
            for x in range(columns.shape[0]):
                value = source[k, y * stride + x]
                if value == 0.0:
                    continue
                value *= scale
                i = columns[x]
                i_up = _wrapped(i + up_i, n)
                i_right = _wrapped(i + right_i, n)
                i_both = _wrapped(i_up + right_i, n)
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
                occupied[COLUMN, _wrapped(columns[x] + aside, n)] = 1


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
        k = _wrapped(at_k + dk, layers)
        if not occupied[HEADING, k]:
            continue
        layer_sum = 0.0
        for dj in range(-half, half + 1):
            j = _wrapped(at_j + dj, n)
            row_sum = 0.0
            for di in range(-half, half + 1):
                i = _wrapped(at_i + di, n)
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
