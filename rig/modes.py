"""Vibration of the whisker's shaft: natural modes by finite elements, and their exact time step.

Lengths in those of the whisker, stiffness and mass per length in those of the base; a frequency is
then b sqrt(E I0 / (rho A0)) / L^2 with b from `natural_modes`. Hermite beam elements with the
diameter falling linearly, integrated exactly; the modes by inverse iteration on the banded matrix.
Plain arithmetic only, so the bits are the same on every machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal, localcontext
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled

ELEMENTS = 60
_BAND = 4  # half band width plus one of the matrices
# Gauss points and weights of order 5 on (0, 1).
_ROOT = math.sqrt(10.0 / 7.0)
_INNER = math.sqrt(5.0 - 2.0 * _ROOT) / 6.0
_OUTER = math.sqrt(5.0 + 2.0 * _ROOT) / 6.0
_POINTS = (0.5, 0.5 - _INNER, 0.5 + _INNER, 0.5 - _OUTER, 0.5 + _OUTER)
_SHORT = (322.0 - 13.0 * math.sqrt(70.0)) / 1800.0
_LONG = (322.0 + 13.0 * math.sqrt(70.0)) / 1800.0
_WEIGHTS = (64.0 / 225.0, _LONG, _LONG, _SHORT, _SHORT)


@dataclass(frozen=True)
class Modes:
    """The first modes of a clamped shaft, first mode first.

    frequency  b, see above
    release    share of each in the base moment after a force on the tip is let go; all modes: 1
    inertia    share of each in the base moment of a turning base; all modes together: 1
    """

    frequency: tuple[float, ...]
    release: tuple[float, ...]
    inertia: tuple[float, ...]


@compiled
def _element(
    x: float,
    h: float,
    taper: float,
    points: NDArray[np.float64],
    weights: NDArray[np.float64],
    stiffness: NDArray[np.float64],
    mass: NDArray[np.float64],
) -> None:
    """Stiffness and mass float64[4, 4] of the element from x to x + h; slopes are scaled by h."""
    stiffness[:] = 0.0
    mass[:] = 0.0
    shape, curve = np.empty(4), np.empty(4)
    for k in range(5):
        s = points[k]
        v = 1.0 - taper * (x + h * s)
        shape[0] = 1.0 - 3.0 * s * s + 2.0 * s * s * s
        shape[1] = s - 2.0 * s * s + s * s * s
        shape[2] = 3.0 * s * s - 2.0 * s * s * s
        shape[3] = s * s * s - s * s
        curve[0], curve[1] = 12.0 * s - 6.0, 6.0 * s - 4.0
        curve[2], curve[3] = 6.0 - 12.0 * s, 6.0 * s - 2.0
        for a in range(4):
            for b in range(4):
                stiffness[a, b] += weights[k] * v * v * v * v * curve[a] * curve[b] / (h * h * h)
                mass[a, b] += weights[k] * v * v * shape[a] * shape[b] * h


@compiled
def _times(
    band: NDArray[np.float64], vector: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """out = A vector for the symmetric A with A[i, i - k] = band[i, k]."""
    for i in range(len(vector)):
        total = band[i, 0] * vector[i]
        for k in range(1, _BAND):
            if i - k >= 0:
                total += band[i, k] * vector[i - k]
            if i + k < len(vector):
                total += band[i + k, k] * vector[i + k]
        out[i] = total


@compiled
def _product(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled
def _solve_modes(
    r: float,
    points: NDArray[np.float64],
    weights: NDArray[np.float64],
    elements: int,
    found: NDArray[np.float64],
) -> None:
    """Fill found float64[modes, 3] with b, release share and inertia share."""
    size, h = 2 * elements, 1.0 / elements
    stiffness, mass = np.zeros((size, _BAND)), np.zeros((size, _BAND))
    ke, me = np.empty((4, 4)), np.empty((4, 4))
    for e in range(elements):
        _element(e * h, h, 1.0 - r, points, weights, ke, me)
        for a in range(4):
            for b in range(a + 1):
                i, j = 2 * e - 2 + a, 2 * e - 2 + b
                if j >= 0:
                    stiffness[i, i - j] += ke[a, b]
                    mass[i, i - j] += me[a, b]
    factor = np.zeros((size, _BAND))  # Cholesky
    for i in range(size):
        for j in range(max(i - 3, 0), i + 1):
            total = stiffness[i, i - j]
            for k in range(max(i - 3, 0), j):
                if j - k < _BAND:
                    total -= factor[i, i - k] * factor[j, j - k]
            factor[i, i - j] = math.sqrt(total) if i == j else total / factor[j, 0]
    lever = np.empty(size)  # the shape of a rigid turn
    for e in range(elements):
        lever[2 * e], lever[2 * e + 1] = (e + 1) * h, h
    load, weighted, shape = np.empty(size), np.empty(size), np.empty(size)
    _times(mass, lever, weighted)
    inertia = _product(lever, weighted)
    modes = found.shape[0]
    kept = np.zeros((modes, size))
    kept_load = np.zeros((modes, size))
    for m in range(modes):
        for i in range(size):
            shape[i] = 1.0 + i % 5  # any shape that holds something of every mode
        square = 0.0
        for _ in range(400):
            for n in range(m):
                part = _product(kept_load[n], shape)
                for i in range(size):
                    shape[i] -= part * kept[n, i]
            _times(mass, shape, load)
            norm = math.sqrt(_product(shape, load))
            for i in range(size):
                shape[i] /= norm
                load[i] /= norm
            for i in range(size):
                total = load[i]
                for k in range(1, _BAND):
                    if i - k >= 0:
                        total -= factor[i, k] * weighted[i - k]
                weighted[i] = total / factor[i, 0]
            for i in range(size - 1, -1, -1):
                total = weighted[i]
                for k in range(1, _BAND):
                    if i + k < size:
                        total -= factor[i + k, k] * weighted[i + k]
                weighted[i] = total / factor[i, 0]
            before, square = square, 1.0 / _product(load, weighted)
            if abs(square - before) <= 1e-13 * square:
                break
            for i in range(size):
                shape[i] = weighted[i]
        for i in range(size):
            kept[m, i], kept_load[m, i] = shape[i], load[i]
        turn = _product(lever, load)
        found[m, 0] = math.sqrt(square)
        found[m, 1] = shape[size - 2] * turn
        found[m, 2] = turn * turn / inertia


@lru_cache(maxsize=64)
def natural_modes(r: float, modes: int = 2, elements: int = ELEMENTS) -> Modes:
    """The first modes of a shaft whose tip has r times the diameter of its base, 0 < r <= 1."""
    if not 0.0 < r <= 1.0:
        raise ValueError(f"natural modes: expected tip over base diameter in (0, 1], found {r}")
    found = np.empty((modes, 3), dtype=np.float64)
    points, weights = (np.array(v, dtype=np.float64) for v in (_POINTS, _WEIGHTS))
    _solve_modes(r, points, weights, elements, found)
    frequency, release, inertia = (tuple(float(v) for v in column) for column in found.T)
    return Modes(frequency, release, inertia)


def second_order_step(omega: float, zeta: float, dt: float) -> tuple[float, float, float, float]:
    """exp(A dt), row by row, of q'' = -omega^2 q - 2 zeta omega q': exact over one tick.

    The Taylor series with 50 decimal digits, rounded once: an undamped mode keeps its energy.
    """
    with localcontext() as context:
        context.prec = 50
        w, z, step = Decimal(omega), Decimal(zeta), Decimal(dt)
        a = (Decimal(0), step, -w * w * step, -2 * z * w * step)
        halvings = 0
        while max(abs(value) for value in a) > Decimal("0.1"):
            a = (a[0] / 2, a[1] / 2, a[2] / 2, a[3] / 2)
            halvings += 1
        term = total = (Decimal(1), Decimal(0), Decimal(0), Decimal(1))
        for k in range(1, 40):
            p, q, r, s = _matrix(term, a)
            term = (p / k, q / k, r / k, s / k)
            p, q, r, s = total
            total = (p + term[0], q + term[1], r + term[2], s + term[3])
        for _ in range(halvings):
            total = _matrix(total, total)
        qq, qv, vq, vv = total
        return float(qq), float(qv), float(vq), float(vv)


Matrix = tuple[Decimal, Decimal, Decimal, Decimal]


def _matrix(a: Matrix, b: Matrix) -> Matrix:
    return (
        a[0] * b[0] + a[1] * b[2],
        a[0] * b[1] + a[1] * b[3],
        a[2] * b[0] + a[3] * b[2],
        a[2] * b[1] + a[3] * b[3],
    )
