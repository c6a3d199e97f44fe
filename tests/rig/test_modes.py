"""Vibration: frequencies and shares against independent numbers, and a step that loses nothing."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.modes import natural_modes, second_order_step
from vibrissa.rig.whisker import mode_frequencies

# Tip over base diameter; b of omega = b sqrt(E I0 / (rho A0)) / L^2 for three modes, from a
# 200-element model of another implementation; the cylinder from textbooks.
FREQUENCIES = [
    (1.0, (3.5160, 22.0345, 61.6972)),
    (0.5, (4.6252, 19.5476, 48.5789)),
    (0.375, (5.1211, 18.951, 45.0143)),
    (0.25, (5.8230, 18.4797, 41.3213)),
    (0.1, (7.2049, 18.6802, 37.1238)),
    (0.001, (8.7018, 21.1034, 38.3769)),
]
# Length, base and tip diameter (m); first and second frequency (Hz) at E 3 GPa, 1200 kg/m^3.
HERTZ = [
    (0.160, 1.6e-3, 0.4e-3, 22.9, 72.7),
    (0.110, 1.3e-3, 0.4e-3, 36.9, 126.0),
    (0.050, 0.8e-3, 0.3e-3, 103.0, 382.0),
    (0.160, 1.0e-3, 1.0e-3, 8.6, 54.0),
]


@pytest.mark.parametrize(("ratio", "expected"), FREQUENCIES)
def test_frequencies_are_those_of_the_reference(ratio: float, expected) -> None:
    assert natural_modes(ratio, 3).frequency == pytest.approx(expected, rel=2e-5)


@pytest.mark.parametrize(("length", "base", "tip", "first", "second"), HERTZ)
def test_frequencies_in_hertz(length, base, tip, first, second) -> None:
    found = [w / (2 * math.pi) for w in mode_frequencies(length, base, tip, 3e9, 1200.0)]
    assert found == pytest.approx((first, second), rel=6e-3)


def test_modal_shares_of_a_cylinder_are_the_textbook_s_and_add_up_to_one() -> None:
    modes = natural_modes(1.0, 12)
    # A cylinder's modes have phi(L) = +-2 and phi''(0) = 2 b, normalised: shares +-4 / b.
    for k in range(3):
        assert abs(modes.release[k]) == pytest.approx(4 / modes.frequency[k], rel=1e-4)
    assert sum(modes.inertia) == pytest.approx(1, abs=1e-3)
    assert sum(modes.release) == pytest.approx(1, abs=0.03)


def test_impossible_shaft_is_refused() -> None:
    with pytest.raises(ValueError, match="tip over base"):
        natural_modes(0.0)


@given(st.floats(0.1, 3000.0), st.floats(0.0, 0.99))
def test_step_is_the_closed_form(omega: float, zeta: float) -> None:
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


@given(st.floats(1.0, 1e5))
def test_undamped_step_keeps_areas_to_the_last_bit_or_two(omega: float) -> None:
    qq, qv, vq, vv = second_order_step(omega, 0.0, 5e-4)
    assert abs(qq * vv - qv * vq - 1) < 5e-16
