"""Places on a ring, and one-dimensional Gaussian blurs in long flat loops, compiled."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled, exp

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

LANES: Final = 32
"""Flat loops run over whole multiples of this: what a turn of a vectorised loop does at most."""


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
def whole(count: int) -> int:
    """The next multiple of LANES."""
    return (count + LANES - 1) // LANES * LANES


@compiled
def blur_line(out: Floats, source: Floats, first: int, stride: int, weights: Floats) -> None:
    """out[x] = sum over taps t of weight |t| times source[first + x + t stride].

    Works on shifted slices: loops over plain indices are what the compiler vectorises.
    """
    centre = source[first:]
    w0 = weights[0]
    if weights.shape[0] == 4:
        w1, w2, w3 = weights[1], weights[2], weights[3]
        l1, r1 = source[first - stride :], source[first + stride :]
        l2, r2 = source[first - 2 * stride :], source[first + 2 * stride :]
        l3, r3 = source[first - 3 * stride :], source[first + 3 * stride :]
        for x in range(out.shape[0]):
            out[x] = (
                w0 * centre[x] + w1 * (l1[x] + r1[x]) + w2 * (l2[x] + r2[x]) + w3 * (l3[x] + r3[x])
            )
    elif weights.shape[0] == 3:
        w1, w2 = weights[1], weights[2]
        l1, r1 = source[first - stride :], source[first + stride :]
        l2, r2 = source[first - 2 * stride :], source[first + 2 * stride :]
        for x in range(out.shape[0]):
            out[x] = w0 * centre[x] + w1 * (l1[x] + r1[x]) + w2 * (l2[x] + r2[x])
    else:
        for x in range(out.shape[0]):
            out[x] = w0 * centre[x]
        for t in range(1, weights.shape[0]):
            w = weights[t]
            left, right = source[first - t * stride :], source[first + t * stride :]
            for x in range(out.shape[0]):
                out[x] += w * (left[x] + right[x])
