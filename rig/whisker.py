"""The shafts of a head as numbers: length, taper, rigidity, weight, inertia and vibration."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vibrissa.rig.modes import natural_modes, second_order_step
from vibrissa.rig.rows import (
    FIRST_QQ,
    FIRST_VV,
    INERTIA,
    LENGTH,
    RELEASE,
    RIGIDITY,
    SECOND_QQ,
    SECOND_VV,
    SHAFT_ROWS,
    SWAY,
    TAPER,
    TIP_SLIP,
    WEIGHT,
)

GRAVITY = 9.80665


def slip_coefficient(q: float) -> float:
    """c in arc length = d (1 + c gamma^2) for a contact where the diameter is q of the base's.

    Small angles: half the mean square of (slope / gamma - 1) along the loaded cantilever, by the
    midpoint rule; a cylinder has c = 0.1.
    """
    steps = 2000
    slope, total, step = 0.0, 0.0, 1.0 / steps
    for k in range(steps):
        t = (k + 0.5) * step
        v = 1.0 - (1.0 - q) * t
        curvature = 3.0 * q * (1.0 - t) / (v * v * v * v)
        middle = slope + 0.5 * step * curvature
        slope += step * curvature
        total += step * (middle - 1.0) * (middle - 1.0)
    return 0.5 * total


def mode_frequencies(
    length: float, base: float, tip: float, modulus: float, density: float
) -> tuple[float, float]:
    """First two natural frequencies, rad/s, of a tapered cantilever of round section.

    length, base and tip diameter in m, modulus in Pa, density in kg/m^3.
    """
    # E I0 / (rho A0) = E base^2 / (16 rho)
    unit = math.sqrt(modulus / density) * base / (4.0 * length * length)
    first, second = natural_modes(tip / base).frequency
    return first * unit, second * unit


def shaft_table(
    length: NDArray[np.float64],
    base: NDArray[np.float64],
    tip: NDArray[np.float64],
    modulus: float,
    density: float,
    damping: float,
    dt: float,
) -> NDArray[np.float64]:
    """The rows LENGTH .. TIP_SLIP, float64[SHAFT_ROWS, n], of n shafts.

    length, base and tip diameter float64[n] in m; modulus Pa; density kg/m^3; damping: ratio of
    both modes; dt: tick in s.
    """
    table = np.empty((SHAFT_ROWS, len(length)), dtype=np.float64)
    for i, (l, d0, d1) in enumerate(zip(length, base, tip, strict=True)):
        if i and (l, d0, d1) == (length[i - 1], base[i - 1], tip[i - 1]):
            table[:, i] = table[:, i - 1]
            continue
        r = d1 / d0 - 1.0
        mass_per_length = density * math.pi * d0 * d0 / 4.0
        table[LENGTH, i] = l
        table[TAPER, i] = -r / l
        table[RIGIDITY, i] = modulus * math.pi * (d0 * d0) * (d0 * d0) / 64.0
        # Integrals of (1 + r t)^2 t and (1 + r t)^2 t^2 over the length.
        table[WEIGHT, i] = GRAVITY * mass_per_length * l * l * (1 / 2 + 2 * r / 3 + r * r / 4)
        table[INERTIA, i] = mass_per_length * (l * l * l) * (1 / 3 + 2 * r / 4 + r * r / 5)
        first, second = mode_frequencies(l, d0, d1, modulus, density)
        table[FIRST_QQ : FIRST_VV + 1, i] = second_order_step(first, damping, dt)
        table[SECOND_QQ : SECOND_VV + 1, i] = second_order_step(second, damping, dt)
        modes = natural_modes(float(d1 / d0))
        table[RELEASE, i] = modes.release[0]
        table[SWAY, i] = modes.inertia[0]
        table[TIP_SLIP, i] = slip_coefficient(d1 / d0)
    return table
