"""Returns, energies and image quality on logs small enough to count by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vibrissa.tools.experiment.scores import (
    Trace,
    dead_reckoning,
    energies,
    first_seen,
    recognition,
    relation_pairs,
    returns,
    scores,
    touch_quality,
)

LAP = 40


def circle(laps: int) -> np.ndarray:
    """True poses on a circle of 0.5 m, LAP steps a lap."""
    angle = 2 * math.pi * np.arange(laps * LAP) / LAP
    return np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), angle + math.pi / 2], axis=1)


def trace(experience: np.ndarray, laps: int) -> Trace:
    truth = circle(laps)
    made = first_seen(experience)
    return Trace(
        experience=experience,
        reckoned=truth.copy(),
        truth=truth,
        circuit=np.arange(laps * LAP) // LAP,
        map_poses=truth[made],
        templates=LAP,
    )


def test_an_agent_that_knows_every_place_again_returns_right_all_the_time() -> None:
    found = returns(trace(np.tile(np.arange(LAP), 3), 3), LAP)
    assert found["returns"] == found["right"] == found["earlier"] == found["earlier_right"] == 1.0
    assert found["opposite"] == 0.0


def test_an_agent_that_knows_nothing_again_never_returns() -> None:
    found = returns(trace(np.arange(3 * LAP), 3), LAP)
    assert found["returns"] == found["earlier"] == 0.0
    assert found["right"] is None and found["earlier_right"] is None


def test_returns_to_the_wrong_place_are_not_right() -> None:
    log = np.r_[np.arange(LAP), np.roll(np.arange(LAP), LAP // 2)]
    found = returns(trace(log, 2), LAP)
    assert found["earlier"] == 1.0 and found["earlier_right"] == 0.0
    assert found["opposite"] == 1.0


def test_staying_is_no_return_but_counts_as_a_step_in_an_earlier_circuit() -> None:
    log = np.r_[np.arange(LAP), np.zeros(LAP, np.int64)]
    found = returns(trace(log, 2), LAP)
    assert found["returns"] == pytest.approx(1 / LAP)
    assert found["earlier"] == 1.0


def test_a_perfect_map_has_no_energy_and_its_odometry_has_its_own() -> None:
    perfect = trace(np.arange(2 * LAP), 2)
    bent = perfect.reckoned.copy()
    bent[:, 2] *= 1.01
    found = energies(
        Trace(perfect.experience, bent, perfect.truth, perfect.circuit, perfect.map_poses, 1)
    )
    for relations in ("consecutive", "interval", "all"):
        for by in ("whisk", "experience"):
            assert found[f"em_{by}_{relations}"] < 1e-25
            total = found[f"odo_{by}_{relations}"]
            assert total > 0
            parts = found[f"odo_{by}_{relations}_t"] + found[f"odo_{by}_{relations}_r"]
            assert total == pytest.approx(parts)


def test_all_scores_are_defined_on_a_log_without_any_return() -> None:
    found = scores(trace(np.arange(2 * LAP), 2))
    assert found["arr"] == 0.0 and found["arcr"] is None
    assert (found["templates"], found["experiences"], found["steps"]) == (LAP, 2 * LAP, 2 * LAP)


def test_far_pairs_are_ordered_distinct_and_cover_the_log() -> None:
    pairs = relation_pairs("all", 50)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert set(pairs.ravel()) == set(range(50))


def test_dead_reckoning_of_exact_odometry_closes_a_square() -> None:
    side = [(1.0, 0.0, 1.0)] * 3 + [(1.0, math.pi / 2, 1.0)]
    poses = dead_reckoning(np.array(side * 4))
    np.testing.assert_allclose(poses[-1], 0.0, atol=1e-9)
    assert np.hypot(*poses[:, :2].T).max() > 3.0


def test_images_that_tell_places_apart_have_an_auc_of_one_and_blind_ones_a_half() -> None:
    truth, circuit = circle(2), np.arange(2 * LAP) // LAP
    place = (np.arange(2 * LAP) % LAP * 6).astype(np.uint8)
    telling = np.repeat(place[:, None], 18, axis=1)
    found = recognition(telling, truth, circuit)
    assert found["auc"] == 1.0 and found["top1"] == 1.0 and found["same"] == 0.0
    blind = recognition(np.zeros_like(telling), truth, circuit)
    assert blind["auc"] == 0.5
    noise = np.random.default_rng(2).integers(0, 255, telling.shape).astype(np.uint8)
    assert abs(recognition(noise, truth, circuit)["auc"] - 0.5) < 0.1


def test_one_circuit_alone_has_nothing_to_compare() -> None:
    found = recognition(np.zeros((LAP, 18), np.uint8), circle(1), np.zeros(LAP, np.int64))
    assert found == {"auc": None, "same": None, "top1": None}


def test_impingement_counts_the_whiskers_that_were_pushed() -> None:
    deepest = np.zeros((4, 18))
    deepest[0, 3] = math.radians(10.0)
    deepest[1, 5] = math.radians(20.0)
    slips = np.zeros((4, 18), np.int64)
    slips[2, 7] = 2
    found = touch_quality(deepest, slips)
    assert found["impingement_deg"] == pytest.approx(15.0) and found["slips"] == 0.5
