"""Places on a ring, and Gaussian blurs of layers of activity, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled, exp

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Places = NDArray[np.uint64]


def half_gaussian(width: int, sigma: float) -> Floats:
    """One side of the normalised Gaussian, centre first: the 3-D kernel is its outer product."""
    radius = width // 2
    half = [float(exp(-(a * a) / (2.0 * sigma * sigma))) for a in range(radius + 1)]
    total = half[0] + 2.0 * sum(half[1:])
    return np.array([h / total for h in half], dtype=np.float64)


@compiled
def wrapped(index: int, length: int) -> int:
    """index modulo length, without a division when it is less than one length outside."""
    if index < 0:
        index += length
    elif index >= length:
        index -= length
    if index < 0 or index >= length:
        index %= length
    return index


@compiled
def arc(marks: Bytes, length: int) -> tuple[int, int]:
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
def blur_layer(
    out: Floats,
    source: Floats,
    window: Places,
    width: int,
    weights: Floats,
    padded: Floats,
) -> None:
    """Convolve a window of a layer along y and x, less a margin of one radius all round.

    source[window[q]] is what lies at row q // width, column q % width of the window. The rows of
    the result are 2 radii shorter.
    """
    gathered, blurred = padded[0], padded[1]
    for q in range(window.shape[0]):
        gathered[q] = source[window[q]]
    r = weights.shape[0] - 1
    count = window.shape[0] - 2 * r * width
    _blur_line(blurred[:count], gathered, r * width, width, weights)
    _blur_line(gathered[: count - 2 * r], blurred, r, 1, weights)
    m = width - 2 * r
    for j in range(count // width):
        for x in range(m):
            out[j * m + x] = gathered[j * width + x]


@compiled
def blur_heading(out: Floats, source: Floats, alive: Bytes, k: int, weights: Floats) -> None:
    """One layer of the circular convolution along heading; the layer behind the last is nothing."""
    layers = source.shape[0] - 1
    m = out.shape[0]
    radius = weights.shape[0] - 1
    near = np.full(7, layers, dtype=np.uint64)
    if radius in (2, 3):
        for t in range(-radius, radius + 1):
            neighbour = wrapped(k + t, layers)
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
        neighbour = wrapped(k + t, layers)
        if alive[neighbour]:
            w = weights[abs(t)]
            for x in range(m):
                out[x] += w * source[neighbour, x]


@compiled
def dilate(alive: Bytes, layers: int, radius: int) -> Bytes:
    result = np.zeros(layers, dtype=np.uint8)
    for k in range(layers):
        if alive[k]:
            for t in range(-radius, radius + 1):
                result[wrapped(k + t, layers)] = 1
    return result


@compiled
def torus_places(first: int, count: int, n: int) -> Ints:
    """first .. first + count - 1 on a ring of n places."""
    places = np.empty(count, dtype=np.int64)
    for p in range(count):
        places[p] = wrapped(first + p, n)
    return places


@compiled
def torus_window(rows: Ints, columns: Ints, n: int) -> Places:
    """Where the cells of rows x columns lie in a layer of n x n."""
    m = columns.shape[0]
    window = np.empty(rows.shape[0] * m, dtype=np.uint64)
    for p in range(rows.shape[0]):
        for x in range(m):
            window[p * m + x] = rows[p] * n + columns[x]
    return window


@compiled
def box_window(
    top: int,
    rows: int,
    left: int,
    columns: int,
    height: int,
    width: int,
    n: int,
) -> Places:
    """Where a window lies in a box of height x width; behind the box, height * width, is a zero.

    A box as high or wide as the torus closes on itself.
    """
    window = np.empty(rows * columns, dtype=np.uint64)
    for p in range(rows):
        j = wrapped(top + p, n) if height == n else top + p
        for x in range(columns):
            i = wrapped(left + x, n) if width == n else left + x
            inside = 0 <= j < height and 0 <= i < width
            window[p * columns + x] = j * width + i if inside else height * width
    return window
