"""The pose cells' attractor: excitation, inhibition, path integration and read-out, compiled.

Source: OpenRatSLAM's PosecellNetwork. Activity is float64[heading, y, x] on a torus; `alive` marks
the heading layers that hold any, and all work is confined to them. The Gaussian kernels are applied
one axis after the other, which equals the three-dimensional convolution.
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

READOUT_HALF_WIDTH: Final = 3


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
def _blur_layer(layer: Floats, n: int, weights: Floats, wide: Floats, wrap: Ints) -> None:
    """Circular convolution of one n x n layer (flat) along x and y, in place."""
    r = weights.shape[0] - 1
    width = n + 2 * r
    skip = (wrap.shape[0] - width) // 2
    padded = wide[0]
    for j in range(n):
        row = layer[j * n : j * n + n]
        target = padded[j * width : j * width + width]
        for x in range(r):
            target[x] = row[wrap[skip + x]]
            target[r + n + x] = row[wrap[skip + r + n + x]]
        middle = target[r : r + n]
        for i in range(n):
            middle[i] = row[i]
    # along x, all rows at once; the 2 r cells at each joint of two rows are not used
    blurred = wide[1]
    _blur_line(blurred[: n * width - 2 * r], padded, r, 1, weights)
    for y in range(width):
        start = wrap[skip + y] * width
        row = blurred[start : start + n]
        target = padded[y * n : y * n + n]
        for i in range(n):
            target[i] = row[i]
    _blur_line(layer, padded, r * n, n, weights)


@compiled
def _blur_heading(out: Floats, source: Floats, alive: Bytes, k: int, weights: Floats) -> None:
    """One layer of the circular convolution along heading."""
    layers = source.shape[0]
    out[:] = 0.0
    r = weights.shape[0] - 1
    for t in range(-r, r + 1):
        neighbour = _wrapped(k + t, layers)
        if alive[neighbour]:
            w = weights[abs(t)]
            row = source[neighbour]
            for x in range(out.shape[0]):
                out[x] += w * row[x]


@compiled
def _dilate(alive: Bytes, radius: int) -> Bytes:
    layers = alive.shape[0]
    result = np.zeros(layers, dtype=np.uint8)
    for k in range(layers):
        if alive[k]:
            for t in range(-radius, radius + 1):
                result[_wrapped(k + t, layers)] = 1
    return result


@compiled
def iterate(
    cells: Floats,
    alive: Bytes,
    work: Floats,
    wide: Floats,
    wrap: Ints,
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
    """Iterations of the network with motion `step` (cells) and `spin` (heading cells) each."""
    layers = cells.shape[0]
    n = cells.shape[1]
    flat = cells.reshape(layers, n * n)
    excited = work[0]
    rest = work[1]
    column = np.empty(n * n)
    for _ in range(iterations):
        for k in range(layers):
            if alive[k]:
                _blur_layer(flat[k], n, excite, wide, wrap)
        raised = _dilate(alive, excite.shape[0] - 1)
        for k in range(layers):
            if raised[k]:
                _blur_heading(excited[k], flat, alive, k, excite)
        kept = _dilate(raised, inhibit.shape[0] - 1)
        for k in range(layers):
            if not raised[k]:
                excited[k] = 0.0
            if not faithful:
                # Without negative activity inhibition only lowers: little is already nothing.
                enough = 0
                layer = excited[k]
                for x in range(n * n):
                    enough += layer[x] >= global_inhibition
                kept[k] = enough > 0
        column[:] = 0.0
        for k in range(layers):
            if alive[k]:
                flat[k] = 0.0
            if kept[k]:
                layer = excited[k]
                left = rest[k]
                _blur_heading(left, excited, raised, k, inhibit)
                _blur_layer(left, n, inhibit, wide, wrap)
                for x in range(n * n):
                    value = layer[x] - left[x]
                    value = value - global_inhibition if value >= global_inhibition else 0.0
                    left[x] = value
                    column[x] += value
        total = 0.0
        for x in range(n * n):
            total += column[x]
        if not total > 0.0:
            return False
        for k in range(layers):
            alive[k] = 0
        integrate(cells, alive, rest, kept, 1.0 / total, step, spin, faithful, directions)
    return read_out(cells, alive, faithful, circle_xy, circle_th, best)


@compiled
def integrate(
    cells: Floats,
    alive: Bytes,
    source: Floats,
    kept: Bytes,
    scale: float,
    step: float,
    spin: float,
    faithful: bool,
    directions: Floats,
) -> None:
    """Add `source` times `scale`, moved by step and spin, to the empty `cells`."""
    layers = cells.shape[0]
    n = cells.shape[1]
    speed = abs(step)
    sign = 1 if spin > 0.0 else -1
    turns = abs(spin)
    low = math.floor(turns)
    high = math.ceil(turns)
    far = turns - (high - 1) if spin != 0.0 else 0.0
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
        for j in range(n):
            for i in range(n):
                value = source[k, j * n + i]
                if value == 0.0:
                    continue
                value *= scale
                kept_up, kept_right = 1.0, 1.0
                if faithful:
                    # what leaves one corner upwards and the opposite one to the right is lost
                    if j == corner_j and i == corner_i:
                        kept_up = 0.0
                    if j == n - 1 - corner_j and i == n - 1 - corner_i:
                        kept_right = 0.0
                j_up = _wrapped(j + up_j, n)
                i_up = _wrapped(i + up_i, n)
                j_right = _wrapped(j + right_j, n)
                i_right = _wrapped(i + right_i, n)
                j_both = _wrapped(j_up + right_j, n)
                i_both = _wrapped(i_up + right_i, n)
                for part in range(2):
                    weight = (1.0 - far if part == 0 else far) * value
                    if weight == 0.0:
                        continue
                    layer = first if part == 0 else second
                    alive[layer] = 1
                    cells[layer, j, i] += weight * stay
                    cells[layer, j_up, i_up] += weight * to_up * kept_up
                    cells[layer, j_right, i_right] += weight * to_right * kept_right
                    cells[layer, j_both, i_both] += weight * both


@compiled
def read_out(
    cells: Floats,
    alive: Bytes,
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
        if alive[k]:
            for j in range(n):
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
        if not alive[k]:
            continue
        for dj in range(-half, half + 1):
            j = _wrapped(at_j + dj, n)
            for di in range(-half, half + 1):
                i = _wrapped(at_i + di, n)
                sum_x[i] += cells[k, j, i]
                sum_y[j] += cells[k, j, i]
                sum_th[k] += cells[k, j, i]
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
