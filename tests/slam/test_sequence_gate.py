"""What odometry alone says of the way between two whisks, against many drawn drives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vibrissa.slam.sequence_gate import Reckoning

STEPS = 120
PLACE, LATERAL = 0.015, 1e-9


def driven(rng: np.random.Generator, corner: float, sigmas: tuple[float, float]) -> Reckoning:
    """A loop of four straights and corners that comes back to its first place, as measured."""
    found = Reckoning()
    for k in range(STEPS + 1):
        motion = np.array([0.01, corner if k % 30 == 15 else 0.0])
        noisy = motion + rng.normal(size=2) * np.array(sigmas) * (k > 0)
        found.add(k, np.array([*noisy, *sigmas]))
    return found


def test_true_returns_are_within_the_gate_and_a_straight_away_is_not() -> None:
    rng = np.random.default_rng(1)
    for sigmas in ((0.002, 0.01), (0.003, 0.034), (0.008, 0.1)):
        chi2 = [
            driven(rng, math.pi / 2.0, sigmas).place_chi2(STEPS, 0, PLACE, LATERAL)
            for _ in range(200)
        ]
        assert np.mean(chi2) < 2.5  # of two degrees of freedom
        assert (np.array(chi2) < 16.0).mean() > 0.97
    away = [
        driven(rng, 0.0, (0.003, 0.034)).place_chi2(STEPS, 0, PLACE, LATERAL) for _ in range(50)
    ]
    assert min(away) > 16.0


def test_to_first_order_it_is_the_covariance_of_drawn_drives() -> None:
    rng = np.random.default_rng(2)
    sigmas = (0.0005, 0.004)
    ends = np.array([_end(driven(rng, 0.02, sigmas)) for _ in range(3000)])
    covariance = np.cov(ends.T) + PLACE**2 * np.eye(2)
    found = Reckoning()
    for k in range(STEPS + 1):
        found.add(k, np.array([0.01, 0.02 if k % 30 == 15 else 0.0, *sigmas]))
    chi2 = _end(found) @ np.linalg.solve(covariance, _end(found))
    assert found.place_chi2(STEPS, 0, PLACE, LATERAL) == pytest.approx(chi2, rel=0.1)


def _end(reckoning: Reckoning) -> np.ndarray:
    return reckoning.places[STEPS] - reckoning.places[0]


def test_headings_apart_are_those_of_the_turns_between() -> None:
    found = Reckoning()
    for k in range(4):
        found.add(k, np.array([0.01, 1.0, 0.002, 0.1]))
    apart, variance = found.heading_apart(3, 0, 1)
    assert (apart, variance) == pytest.approx((3.0 - math.pi, 0.03))
