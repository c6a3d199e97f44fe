"""Odometer calibration from a straight and a turn."""

from __future__ import annotations

import numpy as np
import pytest

from vibrissa.slam.interface import SlamInputError
from vibrissa.slam.odometer import FLOOR, OdometerNoise, calibrated, calibrated_against


def segments(seed: int, noise: OdometerNoise, count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    found = []
    for motion in ((0.01, 0.0), (0.0, 0.5)):
        sigmas = noise.sigmas(*motion)
        found.append(np.array(motion) + rng.normal(size=(count, 2)) * sigmas)
    return found[0], found[1]


@pytest.mark.parametrize(
    "noise",
    [
        OdometerNoise(0.003, 0.0, 0.034, 0.0),
        OdometerNoise(0.001, 0.2, 0.01, 0.2),
        OdometerNoise(0.008, 0.5, 0.1, 0.3),
    ],
)
def test_calibration_finds_the_noise_it_was_driven_with(noise: OdometerNoise) -> None:
    found = calibrated(*segments(1, noise))
    for motion in ((0.01, 0.0), (0.0, 0.5), (0.01, 0.5)):
        assert found.sigmas(*motion) == pytest.approx(noise.sigmas(*motion), rel=0.06)


def test_an_exact_odometer_is_believed_up_to_a_floor() -> None:
    straight, turn = np.tile([0.01, 0.0], (10, 1)), np.tile([0.0, 0.5], (10, 1))
    found = calibrated(straight, turn)
    assert (found.distance, found.turn) == (FLOOR.distance, FLOOR.turn)
    assert (found.distance_share, found.turn_share) == pytest.approx((0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize(
    ("straight", "turn", "message"),
    [
        (np.ones((7, 2)), np.ones((9, 2)), "odometer straight: expected at least 8 steps"),
        (np.ones((9, 2)), np.ones((9, 3)), "odometer turn: expected at least 8 steps"),
        (np.full((9, 2), np.nan), np.ones((9, 2)), "odometer straight: expected finite"),
        (np.zeros((9, 2)), np.ones((9, 2)), "expected some way per step"),
        (np.ones((9, 2)), np.zeros((9, 2)), "expected some turn per step"),
    ],
)
def test_segments_that_say_nothing_are_refused(
    straight: np.ndarray, turn: np.ndarray, message: str
) -> None:
    with pytest.raises(SlamInputError, match=message):
        calibrated(straight, turn)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_noise_is_refused(value: float) -> None:
    with pytest.raises(SlamInputError, match="odometer distance: expected a finite number > 0"):
        OdometerNoise(distance=value)


def driven(noise: OdometerNoise, steps: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Steps as felt and as they were: straights, turns in place, corners, rests; uneven."""
    rng = np.random.default_rng(3)
    kinds = np.array([(0.01, 0.0), (0.0, -0.5), (0.005, 0.3), (0.0, 0.0)])
    true = np.repeat(kinds, steps, axis=0) * rng.uniform(0.8, 1.0, (4 * steps, 1))
    sigmas = np.array([noise.sigmas(*step) for step in true.tolist()])
    return true + rng.normal(size=true.shape) * sigmas, true


def test_against_the_truth_uneven_steps_do_and_corners_and_rests_say_nothing() -> None:
    noise = OdometerNoise(0.001, 0.2, 0.01, 0.2)
    found, straights, turns = calibrated_against(*driven(noise))
    assert (straights, turns) == (4000, 4000)
    for motion in ((0.01, 0.0), (0.0, 0.5), (0.01, 0.5)):
        assert found.sigmas(*motion) == pytest.approx(noise.sigmas(*motion), rel=0.06)


def test_against_the_truth_a_steady_error_is_noise_too() -> None:
    _, true = driven(OdometerNoise(), 20)
    found, _, _ = calibrated_against(true * [1.2, 1.0], true)
    assert found.distance_share == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("true", "message"),
    [
        (np.tile([0.01, 0.0], (50, 1)), "expected at least 8 whisks turning in place, found 0"),
        (np.tile([0.0, 0.5], (50, 1)), "expected at least 8 whisks straight ahead, found 0"),
        (np.zeros((50, 2)), "expected at least 8 whisks straight ahead, found 0"),
        (np.zeros((0, 2)), "expected at least 8 whisks straight ahead, found 0"),
        (np.full((9, 2), np.inf), "expected finite numbers"),
        (np.zeros((9, 3)), "expected float64"),
    ],
)
def test_a_drive_that_says_nothing_is_refused(true: np.ndarray, message: str) -> None:
    with pytest.raises(SlamInputError, match=message):
        calibrated_against(true, true)
