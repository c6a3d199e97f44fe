"""Mechanics of one whisker: the shaft as a beam, and its contact with a wall.

The shaft is an Euler-Bernoulli cantilever whose diameter falls linearly from base to tip. With q
the diameter at distance d over the base diameter and I0 the base's second moment of area, a
frictionless contact at d that holds the shaft gamma away from its straight direction gives, at
small angles, the base moment 3 E I0 q gamma / d (a cylinder: q = 1) and lets c(q) d gamma^2 of
shaft slip past (a cylinder: c = 0.1). Both follow from integrating w'' = F (d - s) / (E I(s)).

Contact happens in the whisking plane, the vertical plane through head axis and pivot, in
coordinates (u, z): u outward from the pivot, z up. The state is the chord, the straight line from
the pivot to the contact: `psi` is its angle from straight down.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled
from vibrissa.rig.scene import X_MAX, X_MIN, Y_MAX, Y_MIN

# Rows of the shaft table float64[SHAFT_ROWS, whiskers].
(
    LENGTH,  # m
    TAPER,  # 1/m, diameter(s) = base (1 - TAPER s)
    RIGIDITY,  # N m^2, E I at the base
    WEIGHT,  # N m, moment of the whisker's weight about its base when horizontal
    INERTIA,  # kg m^2, moment of inertia about its base
    RING_QQ,  # vibration over one tick: q' = QQ q + QV v, v' = VQ q + VV v
    RING_QV,
    RING_VQ,
    RING_VV,
    TIP_SLIP,  # the chord to a held tip is LENGTH / (1 + TIP_SLIP gamma^2)
) = range(10)
SHAFT_ROWS = 10

GRAVITY = 9.80665
LEAST_ARM = 0.02  # of the length: a contact nearer than this counts as being there
NO_WALL = 9.0  # rad, beyond any angle


@lru_cache(maxsize=64)
def slip_coefficient(q: float) -> float:
    """c in arc length = d (1 + c gamma^2) for a contact where the diameter is q of the base's.

    Half the mean square of (slope / gamma - 1) along the loaded cantilever, by the midpoint rule.
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


@compiled
def bending_stiffness(rigidity: float, taper: float, distance: float) -> float:
    """Base moment per angle, N m/rad, of a shaft held at ``distance`` m: 3 E I0 q / d."""
    return 3.0 * rigidity * (1.0 - taper * distance) / distance


@compiled
def slice_box(
    box: NDArray[np.float64], px: float, py: float, ux: float, uy: float
) -> tuple[float, float, bool, bool]:
    """Cut a box with the half plane from (px, py) along the unit vector (ux, uy).

    Returns near and far distance (m) of the cut, near > far where there is none, and for each
    whether it lies on a face that looks along x (else along y).
    """
    inverse = 1.0 / ux if abs(ux) > 1e-12 else 1e12
    a = (box[X_MIN] - px) * inverse
    b = (box[X_MAX] - px) * inverse
    x_near, x_far = min(a, b), max(a, b)
    inverse = 1.0 / uy if abs(uy) > 1e-12 else 1e12
    a = (box[Y_MIN] - py) * inverse
    b = (box[Y_MAX] - py) * inverse
    y_near, y_far = min(a, b), max(a, b)
    near, far = max(x_near, y_near), min(x_far, y_far)
    if far <= 0.0:
        return 1.0, -1.0, True, True
    return max(near, 0.0), far, x_near > y_near, x_far < y_far


@compiled
def wall_angles(chord: float, drop: float, near: float, far: float) -> tuple[float, float, bool]:
    """Chord angles (inner, outer), rad, between which a wall section is in the whisker's way.

    chord: distance from base to tip, m, which bending shortens; drop: height of the pivot above the
    wall's top, m; near, far: the section's extent in u, m. Third: whether the outer end is the
    shaft on the far top edge (else the tip on the top). inner > outer: the whisker passes, too
    short or bent so far that its tip has slipped over the near edge.
    """
    inner = -NO_WALL
    if near * near + drop * drop >= chord * chord:
        return NO_WALL, -NO_WALL, False
    if near > 0.0:
        inner = atan2(near, math.sqrt(chord * chord - near * near))
    if far * far + drop * drop < chord * chord:
        return inner, atan2(far, drop), True
    return inner, atan2(math.sqrt(chord * chord - drop * drop), drop), False


@compiled
def side_extent(
    box: NDArray[np.float64],
    px: float,
    py: float,
    ux: float,
    uy: float,
    start: float,
    stop: float,
) -> tuple[float, float, float, float]:
    """How far the shaft must lean to pass a box within start <= u <= stop on either side.

    Returns (left, u there, right, u there): the largest and smallest v / u of the box, v the offset
    towards (-uy, ux) and u in m; all zero where the box is beyond start and stop, or start >= stop.
    """
    left, left_u, right, right_u = -1e9, 0.0, 1e9, 0.0
    if start >= stop:
        return 0.0, 0.0, 0.0, 0.0
    for k in range(4):
        x0 = (box[X_MIN] if k in (0, 3) else box[X_MAX]) - px
        y0 = (box[Y_MIN] if k in (0, 1) else box[Y_MAX]) - py
        x1 = (box[X_MAX] if k in (0, 1) else box[X_MIN]) - px
        y1 = (box[Y_MAX] if k in (1, 2) else box[Y_MIN]) - py
        u0, v0 = x0 * ux + y0 * uy, y0 * ux - x0 * uy
        u1, v1 = x1 * ux + y1 * uy, y1 * ux - x1 * uy
        if u0 > u1:
            u0, v0, u1, v1 = u1, v1, u0, v0
        if u1 < start or u0 > stop:
            continue
        slope = (v1 - v0) / max(u1 - u0, 1e-12)
        if u0 < start:
            v0 += slope * (start - u0)
            u0 = start
        if u1 > stop:
            v1 += slope * (stop - u1)
            u1 = stop
        lean_0, lean_1 = v0 / max(u0, 1e-6), v1 / max(u1, 1e-6)
        if lean_0 > left:
            left, left_u = lean_0, u0
        if lean_1 > left:
            left, left_u = lean_1, u1
        if lean_0 < right:
            right, right_u = lean_0, u0
        if lean_1 < right:
            right, right_u = lean_1, u1
    if left < right:
        return 0.0, 0.0, 0.0, 0.0
    return left, left_u, right, right_u


@lru_cache(maxsize=64)
def first_mode(length: float, base: float, tip: float, modulus: float, density: float) -> float:
    """First natural frequency, rad/s, of the tapered cantilever, by Stodola's iteration.

    length, base and tip diameter in m, modulus in Pa, density in kg/m^3.
    """
    steps = 400
    h = 1.0 / steps
    thickness = [1.0 + (tip / base - 1.0) * (k + 0.5) * h for k in range(steps)]
    shape = [((k + 0.5) * h) ** 2 for k in range(steps)]
    ratio = 1.0
    for _ in range(30):
        load = [w * t * t for w, t in zip(shape, thickness, strict=True)]
        shear = moment = 0.0
        curvature = [0.0] * steps
        for k in reversed(range(steps)):
            moment += h * (shear + 0.5 * h * load[k])
            shear += h * load[k]
            curvature[k] = (moment - 0.5 * h * shear) / thickness[k] ** 4
        slope = deflection = 0.0
        bent = [0.0] * steps
        for k in range(steps):
            middle = slope + 0.25 * h * curvature[k]
            bent[k] = deflection + 0.5 * h * middle
            slope += h * curvature[k]
            deflection += h * (slope - 0.5 * h * curvature[k])
        work = sum(a * b for a, b in zip(load, shape, strict=True))
        ratio = work / sum(a * b for a, b in zip(load, bent, strict=True))
        top = bent[-1]
        shape = [w / top for w in bent]
    # E I0 / (rho A0) = E base^2 / (16 rho) for a round section.
    return math.sqrt(ratio * modulus / density) * base / (4.0 * length * length)


def second_order_step(omega: float, zeta: float, dt: float) -> tuple[float, float, float, float]:
    """exp(A dt), row by row, of q'' = -omega^2 q - 2 zeta omega q': exact over one tick.

    Scaled Taylor series: plain additions and products, so the same bits on every machine.
    """
    halvings = 0
    step = dt
    while (omega + 2.0 * zeta * omega + 1.0) * step > 0.25:
        step *= 0.5
        halvings += 1
    a = (0.0, step, -omega * omega * step, -2.0 * zeta * omega * step)
    term = total = (1.0, 0.0, 0.0, 1.0)
    for k in range(1, 30):
        term = tuple(value / k for value in _product(term, a))  # type: ignore[assignment]
        total = tuple(x + y for x, y in zip(total, term, strict=True))  # type: ignore[assignment]
    for _ in range(halvings):
        total = _product(total, total)
    return total


def _product(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    return (
        a[0] * b[0] + a[1] * b[2],
        a[0] * b[1] + a[1] * b[3],
        a[2] * b[0] + a[3] * b[2],
        a[2] * b[1] + a[3] * b[3],
    )


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
    the first mode; dt: tick in s.
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
        table[RIGIDITY, i] = modulus * math.pi * d0**4 / 64.0
        # Integrals of (1 + r t)^2 t and (1 + r t)^2 t^2 over the length.
        table[WEIGHT, i] = GRAVITY * mass_per_length * l * l * (1 / 2 + 2 * r / 3 + r * r / 4)
        table[INERTIA, i] = mass_per_length * l**3 * (1 / 3 + 2 * r / 4 + r * r / 5)
        omega = first_mode(l, d0, d1, modulus, density)
        table[TIP_SLIP, i] = slip_coefficient(d1 / d0)
        table[RING_QQ : RING_VV + 1, i] = second_order_step(omega, damping, dt)
    return table
