"""Tuning: what a run is scored by, what the controls are, and which point is chosen and why."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vibrissa.slam.circuits import circuit_numbers, directions
from vibrissa.slam.config import WHISKER
from vibrissa.slam.metrics import (
    MetricError,
    energy_metric,
    experience_metric,
    first_circuit,
    fixed_interval,
)
from vibrissa.slam.tuning import (
    ENERGY,
    GRID,
    THRESHOLD,
    Recording,
    Score,
    Trial,
    TuningError,
    blind_key,
    choose,
    configured,
    dead_reckoning,
    energies,
    grid_points,
    score,
)

PLACES = 40
CONFIG = replace(WHISKER, pc_vt_inject_energy=0.1)


def circle(laps, places=PLACES, radius=0.5):
    """Poses of laps of a circle: 1 anticlockwise, -1 clockwise."""
    poses, angle = [], 0.0
    for sense in laps:
        for _ in range(places):
            x, y = radius * math.cos(angle), radius * math.sin(angle)
            poses.append((x, y, angle + sense * math.pi / 2))
            angle += sense * 2.0 * math.pi / places
    return np.array(poses)


def ring(laps=4, turned=0.9):
    """A recording of laps of a ring of places, by an odometry that turns too little."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (PLACES, 3, 6)).astype(np.uint8)
    truth = circle([1] * laps)
    turn = 2.0 * math.pi / PLACES
    odometry = np.tile([2.0 * 0.5 * math.sin(turn / 2), turned * turn, 1.0], (len(truth), 1))
    return Recording(images[np.arange(len(truth)) % PLACES], odometry, truth)


@pytest.fixture(scope="module")
def recording():
    return ring()


def test_touch_closes_loops_where_controls_do_not(recording):
    touch = score(recording, CONFIG)
    blind = score(recording, CONFIG, "blind")
    shuffled = score(recording, CONFIG, "shuffled")
    assert touch.closes_cleanly
    assert touch.closed_at >= PLACES
    assert touch.templates == PLACES and blind.templates == 1
    assert touch.earlier_right > max(blind.earlier_right, shuffled.earlier_right)
    assert Trial({}, touch, blind, shuffled).touched
    assert (
        touch.whisks.all.total
        < energies(dead_reckoning(recording.odometry), recording.truth).all.total
    )


def test_counts_are_what_they_are_called(recording):
    found = score(recording, CONFIG)
    assert found.earlier_right <= found.earlier <= found.returns
    assert found.earlier_right <= found.right <= found.returns
    assert 0.0 <= found.arr <= 1.0 and 0.0 <= found.arcr <= 1.0
    assert found.whisks.consecutive.relations == len(recording.truth) - 1
    assert found.whisks.interval.relations == len(recording.truth) - 20
    assert found.whisks.all.relations == len(recording.truth) * (len(recording.truth) - 1) // 2
    assert found.experiences_made.consecutive.relations == found.experiences - 1


def test_a_perfect_run_without_views_scores_as_its_odometry():
    """Nothing is recognised, so every whisk is an experience and the map is the odometry."""
    truth = circle([1, 1])
    rng = np.random.default_rng(1)
    images = rng.integers(0, 256, (len(truth), 3, 6)).astype(np.uint8)
    turn = 2.0 * math.pi / PLACES
    odometry = np.tile([2.0 * 0.5 * math.sin(turn / 2), turn, 1.0], (len(truth), 1))
    found = score(Recording(images, odometry, truth), CONFIG)
    assert (found.returns, found.arr, found.arcr) == (0, 0.0, None)
    assert (found.closed_at, found.wrong_before) == (None, 0)
    assert not found.closes_cleanly
    reckoned = energies(dead_reckoning(odometry), truth)
    assert found.whisks.all.total == pytest.approx(reckoned.all.total, abs=1e-9)


def test_controls_keep_shape_and_images(recording):
    shuffled = recording.controlled("shuffled")
    assert sorted(map(bytes, shuffled)) == sorted(map(bytes, recording.images))
    assert (shuffled != recording.images).any(axis=(1, 2)).mean() > 0.8
    assert (shuffled == recording.controlled("shuffled")).all()
    assert not recording.controlled("blind").any()
    assert recording.controlled("touch") is recording.images


def test_blind_runs_do_not_depend_on_the_threshold(recording):
    scores = {
        threshold: score(recording, replace(CONFIG, vt_match_threshold=threshold), "blind")
        for threshold in (0.0005, 0.01)
    }
    assert scores[0.0005] == scores[0.01]
    points = grid_points({THRESHOLD: (1, 2), ENERGY: (3,)})
    assert blind_key(points[0]) == blind_key(points[1])


def test_the_grid_holds_every_combination_once():
    points = grid_points(GRID)
    assert len(points) == math.prod(len(values) for values in GRID.values())
    assert len({tuple(point.items()) for point in points}) == len(points)
    assert all(configured(WHISKER, point).pc_dim_xy == point["pc_dim_xy"] for point in points)


# ----------------------------------------------------------------------------------- choosing

NONE = energies(np.zeros((30, 3)), np.zeros((30, 3)))


def made(threshold, *, energy=0.02, closed=50, wrong=0, earlier=10, control=0, right=10):
    """A trial with the counts that decide."""

    def of(count):
        return Score(
            0.5, 0.5, 20, right, count, count, closed, wrong, 5, 9, whisks=NONE,
            experiences_made=None,
        )  # fmt: skip

    point = {THRESHOLD: threshold, ENERGY: energy}
    return Trial(point, of(earlier), of(control), of(0))


def test_the_largest_threshold_between_good_neighbours_is_chosen():
    trials = [made(1), made(2), made(3), made(4, wrong=1), made(5), made(6)]
    choice = choose(trials)
    assert (choice.trial, choice.stage) == (trials[1], "stable")
    assert "largest threshold of the 1 of 6 points" in choice.reason


def test_an_island_of_luck_is_not_stable():
    """5 and 6 are good, but 6 is at the end of the grid and 5 has a bad neighbour."""
    trials = [made(4, wrong=3), made(5), made(6)]
    choice = choose(trials)
    assert (choice.trial, choice.stage) == (trials[2], "isolated")
    assert "not stable" in choice.reason


def test_points_that_a_control_matches_do_not_qualify():
    trials = [made(n, earlier=7, control=7) for n in (1, 2, 3)]
    choice = choose(trials)
    assert choice.stage == "untouched"
    assert "no point where touch beats both controls" in choice.reason


def test_without_a_clean_closure_the_fewest_wrong_win_and_without_any_the_most_right():
    trials = [made(1, wrong=2), made(2, wrong=1), made(3, closed=None, earlier=0)]
    choice = choose(trials)
    assert (choice.trial, choice.stage) == (trials[1], "wrong")
    trials = [made(n, closed=None, earlier=0, right=r) for n, r in ((1, 3), (2, 8), (3, 1))]
    choice = choose(trials)
    assert (choice.trial, choice.stage) == (trials[1], "open")


def test_ties_go_to_more_right_returns_and_then_to_less_energy():
    def line(energy, earlier):
        return [made(n, energy=energy, earlier=earlier) for n in (1, 2, 3)]

    trials = [*line(0.05, 10), *line(0.02, 12), *line(0.01, 12)]
    choice = choose(trials)
    assert choice.trial.point == {THRESHOLD: 2, ENERGY: 0.01}
    assert "tied with 2" in choice.reason


@settings(max_examples=40, deadline=None)
@given(
    rows=st.lists(
        st.tuples(st.integers(0, 2), st.integers(0, 3), st.integers(0, 3)), min_size=1, max_size=8
    ),
    order=st.randoms(use_true_random=False),
)
def test_the_choice_does_not_depend_on_the_order_of_trials(rows, order):
    trials = [
        made(n, wrong=wrong, earlier=earlier, control=control, closed=None if earlier == 0 else 9)
        for n, (wrong, earlier, control) in enumerate(rows)
    ]
    shuffled = list(trials)
    order.shuffle(shuffled)
    assert choose(shuffled).trial is choose(trials).trial


# ---------------------------------------------------------------------------------- bad input


def test_what_cannot_be_tuned_is_refused_by_name(recording):
    images, odometry, truth = recording.images, recording.odometry, recording.truth
    for arguments, message in (
        ((images, odometry[1:], truth), r"expected odometry and truth of shape \(160, 3\)"),
        ((images[:30], odometry[:30], truth[:30]), "more than one circuit"),
        ((images[:0], odometry[:0], truth[:0]), "none in 0 whisks"),
    ):
        with pytest.raises(TuningError, match=message):
            Recording(*arguments)
    with pytest.raises(TuningError, match="grid warp: no such RatSLAM parameter"):
        grid_points({"warp": (1,)})
    with pytest.raises(TuningError, match="grid pc_dim_xy: expected at least one value"):
        grid_points({"pc_dim_xy": ()})
    with pytest.raises(TuningError, match="grid pc_dim_xy: expected > 0, found -1"):
        configured(WHISKER, {"pc_dim_xy": -1})
    with pytest.raises(TuningError, match="at least one trial"):
        choose([])


# ----------------------------------------------------------------------------------- circuits


def test_circuits_begin_where_the_agent_is_nearest_its_start():
    numbers = circuit_numbers(circle([1, 1, -1]))
    assert np.bincount(numbers).tolist() == [PLACES, PLACES, PLACES]
    assert directions(circle([1, 1, -1]), numbers).tolist() == [1, 1, -1]


def test_an_unfinished_circuit_counts_and_a_start_is_none():
    assert circuit_numbers(circle([1])[: PLACES // 2]).tolist() == [0] * (PLACES // 2)
    assert set(circuit_numbers(circle([1, 1])[: PLACES + 10])) == {0, 1}
    assert circuit_numbers(np.zeros((4, 3))).tolist() == [0] * 4
    assert directions(np.zeros((4, 3)), np.zeros(4)).tolist() == [0]
    with pytest.raises(MetricError, match=r"expected poses of shape \(n, 3\)"):
        circuit_numbers(np.zeros((4, 2)))


@settings(max_examples=20, deadline=None)
@given(
    move=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3, 3)),
    laps=st.lists(st.sampled_from([1, -1]), min_size=1, max_size=4),
)
def test_circuits_do_not_depend_on_the_frame(move, laps):
    poses = circle(laps)
    x, y, angle = move
    c, s = math.cos(angle), math.sin(angle)
    moved = np.column_stack(
        [poses[:, :2] @ np.array([[c, s], [-s, c]]) + [x, y], poses[:, 2] + angle]
    )
    numbers = circuit_numbers(poses)
    assert (circuit_numbers(moved) == numbers).all()
    assert (directions(moved, numbers) == directions(poses, numbers)).all()
    assert directions(poses, numbers).tolist() == laps


def test_dead_reckoning_of_exact_odometry_is_the_truth():
    truth = circle([1, -1])
    reckoned = dead_reckoning(ring(2, turned=1.0).odometry)
    found = energy_metric(reckoned[:PLACES], truth[:PLACES], fixed_interval(PLACES))
    assert found.rotation == pytest.approx(0.0, abs=1e-20)
    assert first_circuit(truth) <= PLACES
    assert experience_metric(range(80), truth, PLACES).arr == 0.0
