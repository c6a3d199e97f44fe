"""Shafts as numbers: weight and inertia of simple bodies, slip at small angles."""

import numpy as np
import pytest

from vibrissa.rig.rows import FIRST_QQ, INERTIA, SECOND_VV, SWAY, WEIGHT
from vibrissa.rig.whisker import shaft_table, slip_coefficient


def test_cylinder_slips_a_tenth_of_d_gamma_squared() -> None:
    assert slip_coefficient(1.0) == pytest.approx(0.1, rel=1e-5)


def test_shaft_table_weight_and_inertia_of_a_cylinder() -> None:
    length, d = np.array([0.1]), np.array([1e-3])
    table = shaft_table(length, d, d, 3e9, 1200.0, 0.15, 5e-4)
    mass = 1200 * np.pi * 1e-6 / 4 * 0.1
    assert table[WEIGHT, 0] == pytest.approx(mass * 9.80665 * 0.05)
    assert table[INERTIA, 0] == pytest.approx(mass * 0.01 / 3)
    assert table[FIRST_QQ : SECOND_VV + 1].all()
    assert table[SWAY, 0] == pytest.approx(0.9707, abs=1e-4)


def test_cone_weighs_less_and_turns_more_easily_than_a_cylinder() -> None:
    length = np.array([0.1, 0.1])
    table = shaft_table(length, np.array([1e-3] * 2), np.array([1e-3, 1e-4]), 3e9, 1e3, 0.1, 5e-4)
    # Of a cylinder's, with diameter 1 - 0.9 t at t of the length: 2 int v^2 t and 3 int v^2 t^2.
    t = (np.arange(20000) + 0.5) / 20000
    v = 1 - 0.9 * t
    assert table[WEIGHT, 1] / table[WEIGHT, 0] == pytest.approx((2 * v**2 * t).mean(), rel=1e-6)
    assert table[INERTIA, 1] / table[INERTIA, 0] == pytest.approx(
        (3 * v**2 * t**2).mean(), rel=1e-6
    )
