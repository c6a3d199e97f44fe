"""One whisker: beam formulas against independent numbers, and the geometry of contact."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.whisker import (
    INERTIA,
    RING_QQ,
    RING_VV,
    WEIGHT,
    bending_stiffness,
    first_mode,
    second_order_step,
    shaft_table,
    side_extent,
    slice_box,
    slip_coefficient,
    wall_angles,
)

# Length, base and tip diameter (m); first natural frequency (Hz) at E 3 GPa, 1200 kg/m^3, from a
# 200-element Hermite finite-element model.
FINITE_ELEMENT_HZ = [
    (0.160, 1.6e-3, 0.4e-3, 22.9),
    (0.110, 1.3e-3, 0.4e-3, 36.9),
    (0.050, 0.8e-3, 0.3e-3, 103.0),
    (0.160, 1.0e-3, 1.0e-3, 8.6),
]
# Exact elastica against a frictionless peg, E 3 GPa, impingement 10 degrees: length, base and tip
# diameter, peg distance over length, base moment (N m), shaft slipped past (m).
ELASTICA = [
    (0.160, 1.0e-3, 1.0e-3, 0.50, 956.84e-6, 0.24e-3),
    (0.160, 1.6e-3, 0.4e-3, 0.50, 3883.88e-6, 0.39e-3),
    (0.160, 1.6e-3, 0.4e-3, 0.75, 1785.36e-6, 0.86e-3),
    (0.160, 1.6e-3, 0.4e-3, 0.95, 889.47e-6, 1.72e-3),
    (0.110, 1.3e-3, 0.4e-3, 0.95, 685.87e-6, 0.97e-3),
]


def rigidity(diameter: float) -> float:
    return 3e9 * math.pi * diameter**4 / 64


@given(st.floats(0.01, 0.2), st.floats(1e-6, 0.05))
def test_cylinder_moment_is_three_ei_gamma_over_d(distance: float, gamma: float) -> None:
    ei = rigidity(1e-3)
    moment = bending_stiffness(ei, 0.0, distance) * gamma
    assert moment == pytest.approx(3 * ei * gamma / distance, rel=1e-14)


@pytest.mark.parametrize(("length", "base", "tip", "share", "moment", "slip"), ELASTICA)
def test_small_angle_beam_agrees_with_the_elastica_at_ten_degrees(
    length: float, base: float, tip: float, share: float, moment: float, slip: float
) -> None:
    taper, d, gamma = (1 - tip / base) / length, share * length, math.radians(10)
    # The linear beam errs by gamma^2-order terms: at most 8 % here, most near the thin tip.
    assert bending_stiffness(rigidity(base), taper, d) * gamma == pytest.approx(moment, rel=0.08)
    assert slip_coefficient(1 - taper * d) * d * gamma**2 == pytest.approx(slip, rel=0.08)


def test_cylinder_slips_a_tenth_of_d_gamma_squared() -> None:
    assert slip_coefficient(1.0) == pytest.approx(0.1, rel=1e-5)


@pytest.mark.parametrize(("length", "base", "tip", "hertz"), FINITE_ELEMENT_HZ)
def test_first_mode_agrees_with_finite_elements(
    length: float, base: float, tip: float, hertz: float
) -> None:
    assert first_mode(length, base, tip, 3e9, 1200) / (2 * math.pi) == pytest.approx(
        hertz, rel=5e-3
    )


def test_shaft_table_weight_and_inertia_of_a_cylinder() -> None:
    length, d = np.array([0.1]), np.array([1e-3])
    table = shaft_table(length, d, d, 3e9, 1200.0, 0.15, 5e-4)
    mass = 1200 * math.pi * 1e-6 / 4 * 0.1
    assert table[WEIGHT, 0] == pytest.approx(mass * 9.80665 * 0.05)
    assert table[INERTIA, 0] == pytest.approx(mass * 0.01 / 3)
    assert table[RING_QQ, 0] * table[RING_VV, 0] != 0


@given(st.floats(0.1, 3000.0), st.floats(0.0, 0.99))
def test_second_order_step_is_the_closed_form(omega: float, zeta: float) -> None:
    dt = 5e-4
    qq, qv, vq, vv = second_order_step(omega, zeta, dt)
    damped = omega * math.sqrt(1 - zeta * zeta)
    decay, c, s = math.exp(-zeta * omega * dt), math.cos(damped * dt), math.sin(damped * dt)
    assert qq == pytest.approx(decay * (c + zeta * omega / damped * s), abs=1e-12)
    assert qv == pytest.approx(decay * s / damped, abs=1e-12)
    assert vq == pytest.approx(-decay * omega * omega / damped * s, rel=1e-10, abs=1e-12)
    assert vv == pytest.approx(decay * (c - zeta * omega / damped * s), abs=1e-12)


def test_critically_damped_step_is_the_closed_form() -> None:
    omega, dt = 62.8, 5e-4
    qq, qv, _, _ = second_order_step(omega, 1.0, dt)
    assert qq == pytest.approx(math.exp(-omega * dt) * (1 + omega * dt), rel=1e-14)
    assert qv == pytest.approx(math.exp(-omega * dt) * dt, rel=1e-14)


def test_far_edge_in_reach_is_a_peg_and_out_of_reach_the_tip_lands_on_top() -> None:
    _, outer, edge = wall_angles(0.11, 0.057, 0.060, 0.072)
    assert edge and outer == pytest.approx(math.atan2(0.072, 0.057))
    inner, outer, edge = wall_angles(0.11, 0.057, 0.085, 0.097)
    assert not edge and outer == pytest.approx(math.acos(0.057 / 0.11))
    assert inner == pytest.approx(math.asin(0.085 / 0.11))


def test_wall_beyond_the_tip_and_bent_whisker_pass() -> None:
    inner, outer, _ = wall_angles(0.11, 0.057, 0.095, 0.107)
    assert inner > outer
    inner, outer, _ = wall_angles(0.11 / (1 + 0.4 * 0.5**2), 0.057, 0.085, 0.097)
    assert inner > outer


@given(st.floats(-math.pi, math.pi), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_slice_is_the_part_of_the_ray_inside_the_box(heading: float, px: float, py: float) -> None:
    box = np.array([-0.1, 0.12, -0.006, 0.006, 0.05])
    ux, uy = math.cos(heading), math.sin(heading)
    near, far, _, _ = slice_box(box, px, py, ux, uy)
    for u in np.linspace(0.0005, 0.4995, 200):
        x, y = px + u * ux, py + u * uy
        depth = min(x - box[0], box[1] - x, y - box[2], box[3] - y)
        if abs(depth) > 1e-9:
            assert (near < u < far) == (depth > 0)


def test_side_extent_of_a_wall_along_the_plane() -> None:
    box = np.array([0.05, 0.5, -0.002, 0.010, 0.05])
    left, _, right, _ = side_extent(box, 0.0, 0.0, 1.0, 0.0, 0.03, 0.12)
    assert (left, right) == pytest.approx((0.010 / 0.05, -0.002 / 0.05))
    assert side_extent(box, 0.0, 0.0, 1.0, 0.0, 0.01, 0.04) == (0.0, 0.0, 0.0, 0.0)
    left, _, right, _ = side_extent(box, 0.0, -0.1, 1.0, 0.0, 0.03, 0.12)
    assert (left, right) == pytest.approx((0.110 / 0.05, 0.098 / 0.12))
