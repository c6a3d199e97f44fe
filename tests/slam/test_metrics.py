"""Experience Metric with every pitfall of its printed form, Energy Metric, and export."""

from __future__ import annotations

import math

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.slam import oracle
from vibrissa.slam.metrics import (
    MetricError,
    all_pairs,
    energy_metric,
    experience_metric,
    first_circuit,
    first_loop_closure,
    fixed_interval,
    relocalisations,
    to_tum,
)

DELTA = math.radians(25.0)
logs = st.lists(st.integers(0, 7), min_size=1, max_size=60)
variants = st.sampled_from(["or", "and", "and-not"])


def places(ids, where):
    """True poses from a place per experience."""
    return [where[i] for i in ids]


def random_poses(rng, n, step):
    moves = rng.uniform(-step, step, (n, 3))
    poses = np.cumsum(moves, axis=0)
    poses[:, 2] = [oracle.wrap(a) for a in 5 * poses[:, 2]]
    return poses


@settings(max_examples=150, deadline=None)
@given(ids=logs, seed=st.integers(0, 2**32 - 1), variant=variants, data=st.data())
def test_it_is_algorithm_1_line_by_line(ids, seed, variant, data):
    base = data.draw(st.integers(1, len(ids)))
    poses = random_poses(np.random.default_rng(seed), len(ids), 0.15)
    found = experience_metric(ids, poses, base, variant=variant)
    eta, eta_c = oracle.experience_metric(ids, poses, base, 0.1, DELTA, variant)
    assert (found.relocalised, found.correct) == (eta, eta_c)
    assert 0 <= found.correct <= found.relocalised <= found.steps == len(ids) - base
    assert found.arr == (eta / found.steps if found.steps else None)
    assert found.arcr == (eta_c / eta if eta else None)
    assert found.variant == variant


@settings(max_examples=50, deadline=None)
@given(ids=logs, seed=st.integers(0, 2**32 - 1), variant=variants)
def test_the_names_of_experiences_do_not_matter(ids, seed, variant):
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, len(ids), 0.15)
    names = rng.permutation(1000)
    base = 1 + len(ids) // 3
    assert experience_metric(ids, poses, base, variant=variant) == experience_metric(
        [int(names[i]) for i in ids], poses, base, variant=variant
    )


@settings(max_examples=50, deadline=None)
@given(ids=logs, seed=st.integers(0, 2**32 - 1))
def test_as_printed_nothing_is_ever_correct(ids, seed):
    poses = random_poses(np.random.default_rng(seed), len(ids), 0.05)
    assert experience_metric(ids, poses, 1, variant="and").correct == 0


@settings(max_examples=50, deadline=None)
@given(ids=logs, seed=st.integers(0, 2**32 - 1))
def test_every_step_in_a_relocalised_experience_counts(ids, seed):
    poses = random_poses(np.random.default_rng(seed), len(ids), 0.15)
    base = 1 + len(ids) // 4
    entered, expected = set(), 0
    for i in range(base, len(ids)):
        if ids[i] in ids[:i] and ids[i] != ids[i - 1]:
            entered.add(ids[i])
        expected += ids[i] in entered
    assert experience_metric(ids, poses, base).relocalised == expected


@settings(max_examples=50, deadline=None)
@given(ids=logs, seed=st.integers(0, 2**32 - 1), variant=variants)
def test_verdicts_add_up_to_the_metric(ids, seed, variant):
    poses = random_poses(np.random.default_rng(seed), len(ids), 0.15)
    base = 1 + len(ids) // 4
    found = experience_metric(ids, poses, base, variant=variant)
    verdicts = relocalisations(ids, poses, base, variant=variant)
    assert (abs(verdicts).sum(), (verdicts > 0).sum()) == (found.relocalised, found.correct)
    assert not verdicts[:base].any()


def test_a_perfect_revisit_with_stays_scores_one_with_or_and_less_with_and_not():
    ids = [0, 1, 2, 3, 0, 0, 1, 1, 1, 2, 2]
    where = {i: (0.3 * i, 0.0, 0.0) for i in range(4)}
    poses = places(ids, where)
    full = experience_metric(ids, poses, 4)
    assert (full.arr, full.arcr) == (1.0, 1.0)
    once = experience_metric(ids, poses, 4, variant="and-not")
    assert once.arr == 1.0
    # each repeated correct entry fails "and-not"; the stays themselves then count as wrong
    assert 0.0 < once.arcr < 1.0


def test_headings_on_both_sides_of_pi_agree():
    ids, poses = [0, 1, 0], [(0, 0, 3.1), (1, 0, 0), (0, 0, -3.1)]
    assert experience_metric(ids, poses, 2).arcr == 1.0
    unwrapped = oracle.experience_metric(ids, poses, 2, 0.1, DELTA, "or", wrapped=False)
    assert unwrapped == (1, 0)


@pytest.mark.parametrize(("offset", "correct"), [(0.0999, 1), (0.1, 0), (0.2, 0)])
def test_the_position_threshold_is_strict(offset, correct):
    poses = [(0, 0, 0), (1, 0, 0), (offset, 0, 0)]
    assert experience_metric([0, 1, 0], poses, 2).correct == correct


def test_no_relocalisation_and_no_steps_are_not_numbers():
    new = experience_metric([0, 1, 2, 3], np.zeros((4, 3)), 2)
    assert (new.arr, new.arcr) == (0.0, None)
    nothing = experience_metric([0, 1], np.zeros((2, 3)), 2)
    assert (nothing.arr, nothing.arcr, nothing.steps) == (None, None, 0)


def test_staying_after_a_wrong_entry_counts_as_correct():
    """Pitfall 1: the reference of a stay is the step before, so only the entry is wrong."""
    ids = [0, 1, 0, 0, 0, 5]
    poses = [(0, 0, 0), (1, 0, 0), (3, 0, 0), (3, 0, 0), (3, 0, 0), (4, 0, 0)]
    found = experience_metric(ids, poses, 2)
    assert (found.relocalised, found.correct) == (3, 2)


def test_or_differs_from_position_alone_only_when_a_step_is_larger_than_a_threshold():
    """Pitfall 2: in a correct experience, a jump within a stay is correct by kc2 alone."""
    ids = [0, 1, 0, 0]
    poses = [(0, 0, 0), (1, 0, 0), (0, 0, 0), (0.5, 0, 0)]
    assert experience_metric(ids, poses, 2).correct == 2


def test_returning_twice_to_the_same_wrong_place_makes_the_second_return_correct():
    """Pitfall 3: the reference is the last visit, not the first."""
    ids = [0, 1, 0, 1, 0]
    poses = [(0, 0, 0), (1, 0, 0), (7, 0, 0), (1, 0, 0), (7, 0, 0)]
    found = experience_metric(ids, poses, 2)
    assert (found.relocalised, found.correct) == (3, 2)


def test_new_experiences_become_valid_one_step_late():
    """Pitfall 4: the last one of an invalid stretch gets in; its predecessor does not."""
    wrong = [(9, 9, 0)]
    ids = [0, 1, 0, 7, 8, 1]
    poses = [(0, 0, 0), (1, 0, 0), *wrong, (2, 0, 0), (3, 0, 0), (1, 0, 0)]
    returned = {}
    for again in (7, 8):
        log = [*ids, again]
        where = {7: (2, 0, 0), 8: (3, 0, 0)}[again]
        before = experience_metric(ids, poses, 2).correct
        returned[again] = experience_metric(log, [*poses, where], 2).correct - before
    assert returned == {7: 0, 8: 1}


def test_longer_stays_weigh_more():
    """Pitfall 5: the same two returns, the wrong one held longer."""
    where = {0: (0, 0, 0), 1: (1, 0, 0)}
    short = experience_metric([0, 1, 0, 9], [*places([0, 1, 0], where), (5, 0, 0)], 2)
    long = experience_metric([0, 1, 0, 0, 0, 9], [*places([0, 1, 0, 0, 0], where), (5, 0, 0)], 2)
    assert (short.arr, long.arr) == (0.5, 0.75)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 1], np.zeros((3, 3)), 1), "expected one experience per pose"),
        (([0, 1], np.zeros((2, 2)), 1), r"poses: expected shape \(n, 3\)"),
        (([0, 1], np.full((2, 3), np.nan), 1), "poses: expected finite numbers"),
        (([0, 1], np.zeros((2, 3)), 0), "base: expected 1 to 2, found 0"),
        (([0, 1], np.zeros((2, 3)), 3), "base: expected 1 to 2, found 3"),
        (([], np.zeros((0, 3)), 0), "n > 0"),
    ],
)
def test_logs_that_do_not_fit_are_refused(arguments, message):
    with pytest.raises(MetricError, match=message):
        experience_metric(*arguments)


def test_an_unknown_variant_is_refused():
    with pytest.raises(MetricError, match="expected 'or', 'and' or 'and-not', found 'xor'"):
        experience_metric([0], np.zeros((1, 3)), 1, variant="xor")


def test_the_base_set_ends_at_the_first_loop_closure():
    assert first_loop_closure([0, 0, 1, 2, 2, 3, 0, 1]) == 6
    assert first_loop_closure([0, 1, 0, 2, 3, 4, 0], absent=2) == 6
    assert first_loop_closure([0, 1, 2]) == 3
    circle = [(math.cos(a), math.sin(a), a) for a in np.linspace(0, 4 * math.pi, 41)]
    assert first_circuit(circle) == 20
    assert first_circuit(circle[:15]) == 15


@settings(max_examples=30, deadline=None)
@given(
    n=st.integers(2, 12),
    seed=st.integers(0, 2**32 - 1),
    move=st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-7, 7)),
)
def test_energy_equals_matrices_and_ignores_rigid_motion(n, seed, move):
    rng = np.random.default_rng(seed)
    truth, estimate = rng.normal(size=(2, n, 3)) * [1, 1, 2]
    for pairs in (fixed_interval(n), all_pairs(n)):
        found = energy_metric(estimate, truth, pairs)
        expected = oracle.energy(estimate, truth, pairs)
        assert (found.translation, found.rotation) == pytest.approx(expected, abs=1e-9)
        assert found.total == found.translation + found.rotation
        x, y, angle = move
        c, s = math.cos(angle), math.sin(angle)
        moved = estimate @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [x, y, angle]
        again = energy_metric(moved, truth, pairs)
        assert (again.translation, again.rotation) == pytest.approx(expected, abs=1e-9)
    assert energy_metric(truth, truth, all_pairs(n)).total == pytest.approx(0.0, abs=1e-20)


def test_energy_of_the_papers_odometry_noise():
    """Consecutive relations with 8.2 mm and 0.103 rad of noise cost 0.0107, not 0.16 to 0.19."""
    rng = np.random.default_rng(0)
    n = 20_000
    estimate, truth = np.zeros((2, n, 3))
    heading = np.cumsum(rng.normal(0, 0.103, n))
    estimate[:, 2] = heading
    along = rng.normal(0, 8.2e-3, n)
    estimate[:, 0] = np.cumsum(along * np.cos(heading))
    estimate[:, 1] = np.cumsum(along * np.sin(heading))
    found = energy_metric(estimate, truth, fixed_interval(n))
    assert found.translation == pytest.approx(8.2e-3**2, rel=0.05)
    assert found.rotation == pytest.approx(0.103**2, rel=0.05)


def test_relations_are_what_their_names_say():
    assert fixed_interval(4).tolist() == [[0, 1], [1, 2], [2, 3]]
    assert fixed_interval(4, 3).tolist() == [[0, 3]]
    assert fixed_interval(4, 4).shape == (0, 2)
    assert all_pairs(3).tolist() == [[0, 1], [0, 2], [1, 2]]
    with pytest.raises(MetricError, match="interval: expected >= 1, found 0"):
        fixed_interval(4, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((3, 3)), np.zeros((2, 3)), [[0, 1]]), "as many estimates as true poses"),
        ((np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((0, 2))), "with m > 0"),
        ((np.zeros((2, 3)), np.zeros((2, 3)), [[0, 2]]), "expected 0 to 1, found 0 to 2"),
        ((np.full((2, 3), np.inf), np.zeros((2, 3)), [[0, 1]]), "estimate: expected finite"),
    ],
)
def test_relations_that_do_not_fit_are_refused(arguments, message):
    with pytest.raises(MetricError, match=message):
        energy_metric(*arguments)


def test_a_trajectory_exports_in_tum_format():
    text = to_tum([0.0, 1.5], [(1.0, -2.0, 0.0), (0.25, 0.0, math.pi)], height=0.077)
    rows = [[float(v) for v in line.split(" ")] for line in text.splitlines()]
    assert rows[0] == [0.0, 1.0, -2.0, 0.077, 0.0, 0.0, 0.0, 1.0]
    assert rows[1] == pytest.approx([1.5, 0.25, 0.0, 0.077, 0.0, 0.0, 1.0, 0.0], abs=1e-9)
    with pytest.raises(MetricError, match="expected 2 times"):
        to_tum([0.0], np.zeros((2, 3)))


def test_energy_agrees_with_evo():
    rng = np.random.default_rng(1)
    truth, estimate = rng.normal(size=(2, 30, 3))

    def path(poses):
        matrices = []
        for x, y, th in poses:
            matrix = np.eye(4)
            matrix[:2, :2] = [[math.cos(th), -math.sin(th)], [math.sin(th), math.cos(th)]]
            matrix[:2, 3] = x, y
            matrices.append(matrix)
        return PosePath3D(poses_se3=matrices)

    parts = []
    for part in (
        evo_metrics.PoseRelation.translation_part,
        evo_metrics.PoseRelation.rotation_angle_rad,
    ):
        rpe = evo_metrics.RPE(part, delta=1, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        rpe.process_data((path(truth), path(estimate)))
        parts.append(rpe.get_statistic(evo_metrics.StatisticsType.rmse) ** 2)
    found = energy_metric(estimate, truth, fixed_interval(30))
    assert (found.translation, found.rotation) == pytest.approx(tuple(parts), abs=1e-9)
