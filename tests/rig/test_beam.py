"""The beam: exact form against independent numbers, the fast forms against the exact one."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from vibrissa.rig.beam import EXACT, LEAST_HEIGHT, LINEAR, TABLE, beam_tables, peg, tip
from vibrissa.rig.beam_table import most_gamma, peg_table, tip_table
from vibrissa.rig.elastica import STEPS, dead_load, last_peg, peg_contact, shoot, tip_contact
from vibrissa.rig.whisker import slip_coefficient

RATIO = 0.25  # tip over base diameter
TABLES = beam_tables((RATIO, 1.0), 49)

# Dead transverse load on the tip of a cylinder: P L^2 / (E I), deflection and shortening over the
# length, tip angle (rad). After Bisshopp and Drucker, and Mattiasson.
DEAD_LOADS = [
    (0.2, 0.066364, 0.002647, 0.099636),
    (0.25, 0.082746, 0.004118, 0.124292),
    (0.5, 0.162144, 0.015919, 0.244534),
    (1.0, 0.301721, 0.056433, 0.461352),
    (2.0, 0.493457, 0.160642, 0.781750),
    (3.0, 0.603253, 0.254420, 0.986017),
    (4.0, 0.669964, 0.328941, 1.121239),
    (5.0, 0.713792, 0.387628, 1.215368),
    (7.5, 0.776702, 0.489574, 1.355927),
    (10.0, 0.810609, 0.554996, 1.430286),
]
# A frictionless peg, E 3 GPa: length, base and tip diameter (mm), distance over length, hub turned
# past first touch (deg); force (mN), base moment (uN m), slip (mm), shaft angle (deg).
PEGS = [
    (160, 1.0, 1.0, 0.50, 10, 12.006, 956.84, 0.24, 15.01),
    (160, 1.0, 1.0, 0.95, 20, 6.583, 985.23, 1.88, 30.04),
    (160, 1.6, 0.4, 0.50, 10, 49.032, 3883.88, 0.39, 18.06),
    (160, 1.6, 0.4, 0.75, 10, 15.190, 1785.36, 0.86, 21.64),
    (160, 1.6, 0.4, 0.95, 10, 6.163, 889.47, 1.72, 28.29),
    (110, 1.3, 0.4, 0.95, 10, 6.798, 685.87, 0.97, 25.10),
    (50, 0.8, 0.3, 0.75, 20, 23.090, 815.01, 0.92, 39.73),
    (50, 0.8, 0.3, 0.95, 20, 10.830, 457.39, 1.64, 47.24),
]


def rigidity(millimetres: float) -> float:
    return 3e9 * math.pi * (millimetres * 1e-3) ** 4 / 64


@pytest.mark.parametrize(("load", "deflection", "shortening", "angle"), DEAD_LOADS)
def test_dead_load_bends_the_tip_as_published(load, deflection, shortening, angle) -> None:
    found = dead_load(1.0, load, STEPS)
    assert found == pytest.approx((deflection, shortening, angle), abs=1e-6)


@pytest.mark.parametrize("load", [row[0] for row in DEAD_LOADS])
def test_dead_load_agrees_with_elliptic_integrals(load: float) -> None:
    deflection, shortening, angle = dead_load(1.0, load, STEPS)
    p = math.sqrt((1.0 + math.sin(angle)) / 2.0)
    start = math.asin(1.0 / (p * math.sqrt(2.0)))
    root = ellipk(p * p) - ellipkinc(start, p * p)
    assert root**2 == pytest.approx(load, rel=1e-9)
    expected = 1.0 - 2.0 * (ellipe(p * p) - ellipeinc(start, p * p)) / math.sqrt(load)
    assert deflection == pytest.approx(expected, abs=1e-9)
    assert 1.0 - shortening == pytest.approx(math.sqrt(2 * math.sin(angle) / load), abs=1e-9)


@pytest.mark.parametrize(
    ("length", "base", "end", "share", "turn", "force", "moment", "slip", "angle"), PEGS
)
def test_peg_pushes_back_as_published(
    length, base, end, share, turn, force, moment, slip, angle
) -> None:
    d, ei = share * length * 1e-3, rigidity(base)
    q = 1 - (1 - end / base) * share
    f, arc, m, theta, rests = peg_contact(q, math.radians(turn), STEPS)
    assert rests and arc * share < 1
    assert f * ei / d**2 * 1e3 == pytest.approx(force, abs=0.0006)
    assert m * ei / d * 1e6 == pytest.approx(moment, abs=0.006)
    assert (arc - 1) * d * 1e3 == pytest.approx(slip, abs=0.006)
    assert math.degrees(theta) == pytest.approx(angle, abs=0.006)


def test_thin_whisker_slips_off_where_published() -> None:
    _, arc, _, _, rests = peg_contact(1 - 0.75 * 0.95, math.radians(20), STEPS)
    assert rests
    assert arc * 0.95 * 160 == pytest.approx(161.97, abs=0.005)


@pytest.mark.parametrize("q", [1.0, 0.6, 0.25, 0.12])
def test_exact_form_has_converged_to_1e_9(q: float) -> None:
    gamma = 0.9 * last_peg(q, STEPS)[2]
    coarse, fine = peg_contact(q, gamma, STEPS), peg_contact(q, gamma, 4 * STEPS)
    assert coarse[:4] == pytest.approx(fine[:4], rel=2e-9)
    coarse, fine = tip_contact(q, 0.6, 0.5, STEPS), tip_contact(q, 0.6, 0.5, 4 * STEPS)
    assert coarse[:3] == pytest.approx(fine[:3], rel=2e-9)


@given(st.floats(0.1, 1.0), st.floats(0.01, 0.999))
@settings(max_examples=60, deadline=None)
def test_solution_satisfies_the_conditions_of_the_peg(q: float, share: float) -> None:
    gamma = share * last_peg(q, 100)[2]
    force, arc, _, _, rests = peg_contact(q, gamma, STEPS)
    assert rests
    x, y, theta = shoot(1 - q, arc, force, 0.0, STEPS)
    assert math.hypot(x, y) == pytest.approx(1, abs=1e-9)
    assert theta - math.atan2(y, x) == pytest.approx(gamma, abs=1e-9)


def test_beyond_the_largest_angle_nothing_holds_the_shaft() -> None:
    for q in (1.0, 0.5, 0.15):
        most = last_peg(q, STEPS)[2]
        assert peg_contact(q, 0.9999 * most, STEPS)[4]
        assert not peg_contact(q, 1.0001 * most, STEPS)[4]
        assert most_gamma(peg_table(49), (q - 0.1) / 0.9) == pytest.approx(most, rel=1e-4)


def test_tip_on_a_plane_lies_down_and_its_contact_moves_up_the_shaft() -> None:
    arcs = [tip_contact(RATIO, 0.6, turn, STEPS)[2] for turn in np.linspace(0.9, 0.0, 10)]
    assert arcs[:3] == [1.0] * 3 and (np.diff(arcs[4:]) < 0).all()


@given(st.floats(0.1, 1.0), st.floats(1e-6, 1e-3))
def test_forms_agree_at_small_angles(q: float, gamma: float) -> None:
    for form in (LINEAR, TABLE, EXACT):
        moment, arc, _, rests = peg(form, TABLES, q, gamma)
        assert rests
        assert moment == pytest.approx(3 * q * gamma, rel=2e-3)
        assert arc - 1 == pytest.approx(slip_coefficient(q) * gamma**2, rel=2e-2, abs=1e-12)


@given(st.floats(0.1, 1.0), st.floats(0.0, 0.9999))
@settings(max_examples=200, deadline=None)
def test_interpolated_peg_is_within_a_thousandth_everywhere(q: float, share: float) -> None:
    gamma = share * most_gamma(TABLES[0], (q - 0.1) / 0.9)
    fast, exact = peg(TABLE, TABLES, q, gamma), peg(EXACT, TABLES, q, gamma)
    if exact[3]:
        assert fast[0] == pytest.approx(exact[0], rel=1e-3, abs=1e-9)
        assert fast[1] == pytest.approx(exact[1], rel=1e-4)
        assert fast[2] == pytest.approx(exact[2], rel=1e-2, abs=1e-9)


@pytest.mark.parametrize(("table", "ratio"), [(1, RATIO), (2, 1.0)])
def test_interpolated_tip_is_within_a_thousandth_of_full_scale(table: int, ratio: float) -> None:
    rng = np.random.default_rng(table)
    moments, errors, offsets = [], [], []
    for height, share in rng.uniform((LEAST_HEIGHT, 0.0), (0.9999, 1.0), (300, 2)):
        turn = math.acos(height) * (1 - share)
        fast = tip(TABLE, TABLES, table, ratio, height, turn)
        exact = tip(EXACT, TABLES, table, ratio, height, turn)
        moments.append(exact[0])
        errors.append(abs(fast[0] - exact[0]))
        offsets.append(abs(fast[1] - exact[1]))
    # Full scale: what a whisker feels on a plane half its length away, not at the extreme of the
    # table, where a thousandth would be easy.
    full_scale = tip(EXACT, TABLES, table, ratio, 0.5, 0.0)[0]
    moderate = np.array(moments) < 2 * full_scale
    assert moderate.mean() > 0.6
    assert np.array(errors)[moderate].max() < 1e-3 * full_scale
    assert np.array(errors).max() < 1e-3 * max(moments)
    assert max(offsets) < 1e-4


def test_tables_are_the_same_however_often_they_are_built() -> None:
    first = peg_table(9).tobytes(), tip_table(RATIO, 9).tobytes()
    peg_table.cache_clear()
    tip_table.cache_clear()
    assert (peg_table(9).tobytes(), tip_table(RATIO, 9).tobytes()) == first


def test_larger_tables_are_nearer_to_the_exact_form() -> None:
    errors = []
    for size in (9, 17, 33):
        tables = beam_tables((RATIO,), size)
        found = [
            (peg(TABLE, tables, q, g * q)[0], peg(EXACT, tables, q, g * q)[0])
            for q in np.linspace(0.3, 1.0, 8)
            for g in (0.2, 0.5, 0.8)
        ]
        errors.append(max(abs(a / b - 1) for a, b in found))
    assert errors[1] < 0.2 * errors[0] and errors[2] < 0.2 * errors[1]
