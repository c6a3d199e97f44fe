"""Spread reduction and contralateral protraction: what a touch does to the other whiskers."""

from __future__ import annotations

import numpy as np
import pytest

from vibrissa.control.calibration import Calibration
from vibrissa.control.kinematics import PER_RING, WHISKERS, paper_head
from vibrissa.control.rcp import Rcp, RcpParams
from vibrissa.control.social import (
    Social,
    SocialParameterError,
    SocialParams,
    contralateral_protraction,
    mimc,
    spread_reduction,
)
from vibrissa.control.whisk_pattern import full_whisk

PERIOD = 400
WHISK = full_whisk(paper_head(), PERIOD, 0.01)
CALIBRATION = Calibration(
    mean_y=np.full(WHISKERS, 1e-5),
    sigma_y=np.full(WHISKERS, 1e-5),
    threshold_y=np.full(WHISKERS, 2e-4),
    mean_dy=np.zeros(WHISKERS),
    threshold_dy=np.full(WHISKERS, 1e-4),
    samples=1000,
)
TOUCHING = 12  # rear ring, row 0
SAME_ROW = [0, 6]
OPPOSITE_ROW = [3, 9, 15]


def peak(controller, touching: dict[int, float] | None = None) -> np.ndarray:
    """Largest protraction of every whisker in one cycle, rad; touching: whisker -> y in N m."""
    rest = np.zeros(WHISKERS, np.float32)
    y = np.zeros(WHISKERS, np.float32)
    for whisker, moment in (touching or {}).items():
        y[whisker] = moment
    controller.activate(0, rest, rest)
    controller.calibrate(CALIBRATION)
    return np.max([controller.step(t, rest, rest, y) for t in range(PERIOD)], axis=0)


def test_with_both_gains_off_the_law_is_rcp_to_the_bit() -> None:
    rng = np.random.default_rng(3)
    params = RcpParams(WHISK)
    one, other = Rcp(params), Social(SocialParams(params))
    rest = np.zeros(WHISKERS, np.float32)
    for controller in (one, other):
        controller.activate(0, rest, rest)
        controller.calibrate(CALIBRATION)
    for tick in range(3 * PERIOD):
        x, y = rng.normal(0, 4e-4, (2, WHISKERS)).astype(np.float32)
        np.testing.assert_array_equal(one.step(tick, rest, x, y), other.step(tick, rest, x, y))


def test_without_touch_no_whisker_does_anything_but_whisk() -> None:
    free = peak(mimc(WHISK, reserve=0.2))
    np.testing.assert_allclose(free, 0.8 * WHISK.amplitude, rtol=1e-3)


def test_spread_reduction_brings_a_touching_whiskers_row_to_where_it_stands() -> None:
    share = peak(spread_reduction(WHISK), {TOUCHING: 4e-3}) / WHISK.amplitude
    alone = peak(Rcp(RcpParams(WHISK)), {TOUCHING: 4e-3}) / WHISK.amplitude
    assert share[TOUCHING] < 0.9
    assert np.ptp(share[[TOUCHING, *SAME_ROW]]) < 0.5 * np.ptp(alone[[TOUCHING, *SAME_ROW]])
    others = [i for i in range(WHISKERS) if i % PER_RING != TOUCHING % PER_RING]
    np.testing.assert_allclose(share[others], 1.0, rtol=1e-3)


def test_the_whisker_that_touches_is_not_driven_on_by_its_row() -> None:
    alone = peak(Rcp(RcpParams(WHISK)), {TOUCHING: 6e-3, 6: 1e-3})
    spread = peak(spread_reduction(WHISK), {TOUCHING: 6e-3, 6: 1e-3})
    assert spread[TOUCHING] <= alone[TOUCHING] + 0.3 * (alone[6] - alone[TOUCHING])


def test_contralateral_whiskers_protract_further_and_no_others() -> None:
    controller = contralateral_protraction(WHISK, reserve=0.2)
    free, touched = peak(controller), peak(controller, {TOUCHING: 4e-3})
    for i in OPPOSITE_ROW:
        assert touched[i] > 1.03 * free[i]
    others = [i for i in range(WHISKERS) if i not in (*OPPOSITE_ROW, TOUCHING)]
    np.testing.assert_array_equal(touched[others], free[others])
    assert touched[TOUCHING] < free[TOUCHING]


def test_commands_stay_within_the_travel_whatever_is_felt() -> None:
    rng = np.random.default_rng(5)
    controller = mimc(WHISK, spread=5.0, contralateral=9.0)
    travel = paper_head().swing.astype(np.float32)
    rest = np.zeros(WHISKERS, np.float32)
    controller.activate(0, rest, rest)
    controller.calibrate(CALIBRATION)
    for tick in range(2 * PERIOD):
        y = rng.choice([0.0, 0.03, -0.03, np.nan], WHISKERS).astype(np.float32)
        command = controller.step(tick, rest, rest, y)
        assert (command >= 0).all() and (command <= travel).all()


@pytest.mark.parametrize(
    "wrong", [{"spread": -1.0}, {"contralateral": np.inf}, {"reserve": -0.1}, {"reserve": np.nan}]
)
def test_impossible_gains_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SocialParameterError, match=next(iter(wrong))):
        SocialParams(RcpParams(WHISK), **wrong)


def test_a_reserve_of_the_whole_travel_is_refused() -> None:
    with pytest.raises(SocialParameterError, match="reserve"):
        mimc(WHISK, reserve=1.0)
