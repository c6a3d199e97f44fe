"""Experience map: OpenRatSLAM's numbers, its fixed defects, and the least-squares optimum."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.slam import oracle
from vibrissa.slam.config import IRAT, faithful
from vibrissa.slam.experience_map import ExperienceMap, ExperienceMapError
from vibrissa.slam.optimum import map_cost, optimise


def stored(poses, links, values, current=0):
    return {
        "poses": np.asarray(poses, dtype=np.float64),
        "links": np.asarray(links, dtype=np.int32),
        "link_values": np.asarray(values, dtype=np.float64),
        "current": np.array(current),
        "agent": np.zeros(4),
    }


def relaxation_vectors():
    poses = {}
    for line in oracle.lines("em_relax500"):
        if line[0].isdigit():
            fields = line.split(",")
            poses.setdefault(int(fields[0]), []).append([float(f) for f in fields[2:]])
    links = oracle.table("em_relax500_links")
    return {k: np.array(v) for k, v in poses.items()}, links[:, 1:3].astype(int), links[:, 3:]


def ring(experiences, rng, noise):
    """A map of two laps of a circle: odometry links with noise and loop closures."""
    emap = ExperienceMap(IRAT)
    for n in range(2 * experiences):
        emap.on_odo(0.1, oracle.TAU / experiences + noise * rng.normal(), 1.0)
        if n < experiences:
            emap.create()
        else:
            emap.link(emap.current, n - experiences)
            emap.enter(n - experiences)
    return emap


def test_a_map_with_its_relaxation_equals_openratslam():
    snapshots = {}
    for line in oracle.lines("em_out"):
        if line[0] in "-0123456789":
            fields = line.split(",")
            snapshots.setdefault(int(fields[0]), []).append([float(f) for f in fields[2:]])
    emap = ExperienceMap(faithful(IRAT))
    for step, v, w, dt, action, source, target, relative, iterate in oracle.table("em_in"):
        emap.on_odo(v, w, dt)
        if action == 1:
            assert emap.create() == int(target)
        elif action == 2:
            emap.link(int(source), int(target), relative)
            emap.enter(int(target), relative)
        if iterate:
            emap.iterate()
        if int(step) in snapshots:
            np.testing.assert_allclose(emap.poses, snapshots.pop(int(step)), atol=1e-9)
    np.testing.assert_allclose(emap.poses, snapshots.pop(-1), atol=1e-9)
    assert not snapshots
    links = oracle.table("em_links")
    assert (emap.links() == links[:, 1:3]).all()
    np.testing.assert_allclose(emap.link_values(), links[:, 3:], atol=1e-9)


def test_pure_relaxation_equals_openratslam_and_the_plain_formulas():
    poses, links, values = relaxation_vectors()
    emap = ExperienceMap.from_arrays(IRAT, stored(poses[0], links, values))
    emap.iterate()
    np.testing.assert_allclose(emap.poses, poses[1], atol=1e-9)
    for _ in range(4):
        emap.iterate()
    np.testing.assert_allclose(emap.poses, poses[5], atol=1e-9)
    order = np.argsort(links[:, 0], kind="stable")
    plain = oracle.relax(poses[0], links[order], values[order], 20, 0.5)
    np.testing.assert_allclose(plain, poses[1], atol=1e-9)


def test_full_correction_satisfies_a_single_link_in_one_visit():
    values = [[0.5, 0.2, -0.4, 1.0]]
    arrays = stored([[0.0, 0.0, 1.0], [3.0, -2.0, -3.0]], [[0, 1]], values)
    emap = ExperienceMap.from_arrays(replace(IRAT, exp_loops=1), arrays)
    emap.iterate()
    # the position is satisfied at the heading of the visit; the headings meet half-way
    a, b = emap.poses
    assert b[:2] - a[:2] == pytest.approx([0.5 * math.cos(1.2), 0.5 * math.sin(1.2)])
    assert oracle.wrap(b[2] - a[2]) == pytest.approx(-0.4)


def test_durations_count_from_the_last_experience_and_in_faithful_mode_from_the_start():
    durations = {}
    for config in (IRAT, faithful(IRAT)):
        emap = ExperienceMap(config)
        for _ in range(4):
            emap.on_odo(0.1, 0.0, 2.0)
            emap.create()
        durations[config.faithful] = emap.link_values()[:, 3].tolist()
    assert durations == {False: [2.0, 2.0, 2.0], True: [4.0, 6.0, 8.0]}


def test_odometry_before_the_first_experience_is_counted_twice_only_in_faithful_mode():
    lengths = {}
    for config in (IRAT, faithful(IRAT)):
        emap = ExperienceMap(config)
        for _ in range(3):
            emap.on_odo(0.1, 0.0, 1.0)
            emap.create()
        lengths[config.faithful] = emap.link_values()[:, 0].tolist()
    assert lengths[False] == pytest.approx([0.1, 0.1])
    assert lengths[True] == pytest.approx([0.2, 0.1])


def test_a_relative_heading_means_the_same_for_arrival_and_departure_unless_faithful():
    """Standing still, seeing place 0 again turned by 0.3 rad: the link must say heading - 0.3."""
    facing = {}
    for config in (IRAT, faithful(IRAT)):
        emap = ExperienceMap(config)
        emap.on_odo(0.0, 0.0, 1.0)
        emap.create()
        emap.on_odo(0.1, 0.0, 1.0)
        emap.create()
        emap.on_odo(0.1, 0.0, 1.0)
        emap.create()
        emap.on_odo(0.0, 0.3, 1.0)
        emap.link(2, 0, 0.3)
        facing[config.faithful] = emap.link_values()[-1, 2]
        emap.enter(0, 0.3)
        assert emap.facing == pytest.approx(emap.poses[0, 2] + 0.3)
    assert facing == {False: pytest.approx(0.0), True: pytest.approx(0.6)}


def test_two_experiences_are_linked_once_in_either_direction():
    emap = ExperienceMap(IRAT)
    for _ in range(2):
        emap.on_odo(0.1, 0.1, 1.0)
        emap.create()
    assert not emap.link(1, 0)
    assert not emap.link(0, 1)
    assert len(emap.links()) == 1


def test_reverse_driving_links_backwards():
    emap = ExperienceMap(replace(IRAT, exp_initial_em_deg=0.0))
    emap.create()
    emap.on_odo(-0.2, 0.0, 1.0)
    emap.create()
    assert emap.poses[1] == pytest.approx([-0.2, 0.0, 0.0])
    assert emap.link_values()[0, :3] == pytest.approx([0.2, math.pi, 0.0])


def test_saving_and_loading_goes_on_to_the_same_bits():
    rng = np.random.default_rng(0)
    first = ring(30, rng, 0.05)
    second = ExperienceMap.from_arrays(IRAT, first.to_arrays())
    for emap in (first, second):
        emap.on_odo(0.05, 0.02, 1.0)
        emap.create()
        emap.link(3, 40 % len(emap))
        emap.iterate()
    for name, array in first.to_arrays().items():
        assert (second.to_arrays()[name] == array).all(), name
    assert first.pose == second.pose


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"links": None}, "expected an array 'links', found none"),
        ({"poses": np.zeros((2, 2))}, r"poses: expected \(-1, 3\), found \(2, 2\)"),
        ({"links": np.zeros((2, 2), np.int32)}, "2 links but 1 values"),
        ({"links": np.array([[0, 7]])}, "expected 0 to 1, found 7"),
        ({"current": np.array(9)}, "expected 0 to 1, found 9"),
        ({"agent": np.zeros(3)}, r"agent: expected \(4,\), found \(3,\)"),
    ],
)
def test_a_stored_map_that_does_not_fit_is_refused(change, message):
    arrays = stored(np.zeros((2, 3)), [[0, 1]], np.zeros((1, 4)))
    arrays.update(change)
    with pytest.raises(ExperienceMapError, match=message):
        ExperienceMap.from_arrays(IRAT, {k: v for k, v in arrays.items() if v is not None})


def test_unknown_experiences_are_refused():
    emap = ExperienceMap(IRAT)
    emap.create()
    for call in (lambda: emap.link(0, 1), lambda: emap.enter(-1)):
        with pytest.raises(ExperienceMapError, match="experience: expected 0 to 0"):
            call()


def test_relaxation_comes_down_to_near_the_optimum_and_never_below():
    emap = ring(40, np.random.default_rng(2), 0.05)
    start = map_cost(emap.poses, emap.links(), emap.link_values())
    best = optimise(emap.poses, emap.links(), emap.link_values())
    for _ in range(100):
        emap.iterate()
    relaxed = map_cost(emap.poses, emap.links(), emap.link_values())
    assert best.converged
    assert best.cost < relaxed < 0.5 * start


def test_the_optimum_is_stationary_and_agrees_with_a_general_solver():
    from scipy.optimize import least_squares

    rng = np.random.default_rng(4)
    emap = ring(8, rng, 0.1)
    links, values = emap.links(), emap.link_values()
    best = optimise(emap.poses, links, values)

    def residuals(free):
        poses = np.vstack([emap.poses[:1], free.reshape(-1, 3)])
        rows = []
        for (a, b), (distance, heading, facing, _) in zip(links, values, strict=True):
            towards = poses[a, 2] + heading
            rows.append(poses[b, 0] - poses[a, 0] - distance * math.cos(towards))
            rows.append(poses[b, 1] - poses[a, 1] - distance * math.sin(towards))
            rows.append(oracle.wrap(poses[b, 2] - poses[a, 2] - facing))
        return np.array(rows)

    general = least_squares(residuals, best.poses[1:].ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-12)
    assert 2.0 * general.cost == pytest.approx(best.cost, rel=1e-9)
    assert (best.poses[0] == emap.poses[0]).all()


def test_a_map_without_loops_is_solved_exactly():
    emap = ExperienceMap(IRAT)
    rng = np.random.default_rng(6)
    for _ in range(50):
        emap.on_odo(0.1 * rng.random(), rng.normal(), 1.0)
        emap.create()
    shaken = emap.poses + 0.1 * rng.normal(size=(50, 3))
    shaken[0] = emap.poses[0]
    best = optimise(shaken, emap.links(), emap.link_values())
    assert best.cost < 1e-18
    np.testing.assert_allclose(best.poses, emap.poses, atol=1e-8)


def test_disconnected_maps_are_relaxed_and_solved_part_by_part():
    values = [[1.0, 0.0, 0.0, 1.0]] * 2
    poses = [[0, 0, 0], [2, 0, 0], [10, 0, 1], [10, 3, 1], [5, 5, 2]]
    arrays = stored(poses, [[0, 1], [2, 3]], values)
    best = optimise(arrays["poses"], arrays["links"], arrays["link_values"])
    assert best.converged and best.cost < 1e-18
    assert best.poses[1] == pytest.approx([1.0, 0.0, 0.0])
    assert best.poses[4] == pytest.approx([5.0, 5.0, 2.0])
    emap = ExperienceMap.from_arrays(IRAT, arrays)
    emap.iterate()
    assert emap.poses[4] == pytest.approx([5.0, 5.0, 2.0])
    lonely = optimise(np.zeros((3, 3)), np.zeros((0, 2)), np.zeros((0, 4)))
    assert (lonely.cost, lonely.iterations, lonely.converged) == (0.0, 0, True)


@pytest.mark.parametrize(
    ("poses", "links", "values", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 4)), "expected shape"),
        (np.zeros((2, 3)), [[0, 1]], np.zeros((2, 4)), "expected shapes"),
        (np.zeros((2, 3)), [[0, 2]], np.zeros((1, 4)), "found 0 to 2"),
        (np.full((2, 3), np.nan), [[0, 1]], np.zeros((1, 4)), "found NaN"),
    ],
)
def test_maps_that_do_not_fit_have_no_optimum(poses, links, values, message):
    with pytest.raises(ExperienceMapError, match=message):
        optimise(poses, links, values)


@settings(max_examples=20, deadline=None)
@given(
    move=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3, 3)),
    seed=st.integers(0, 2**32 - 1),
)
def test_relaxation_moves_with_the_map(move, seed):
    rng = np.random.default_rng(seed)
    emap = ring(12, rng, 0.2)
    x, y, angle = move
    c, s = math.cos(angle), math.sin(angle)
    arrays = emap.to_arrays()
    turned = arrays["poses"].copy()
    turned[:, :2] = arrays["poses"][:, :2] @ np.array([[c, s], [-s, c]]) + [x, y]
    turned[:, 2] = [oracle.wrap(th + angle) for th in turned[:, 2]]
    other = ExperienceMap.from_arrays(IRAT, {**arrays, "poses": turned})
    emap.iterate()
    other.iterate()
    expected = emap.poses[:, :2] @ np.array([[c, s], [-s, c]]) + [x, y]
    np.testing.assert_allclose(other.poses[:, :2], expected, atol=1e-9)
    turn = [oracle.wrap(d - angle) for d in other.poses[:, 2] - emap.poses[:, 2]]
    np.testing.assert_allclose(turn, 0.0, atol=1e-9)


def test_coincident_experiences_and_headings_at_pi_stay_finite():
    values = [[0.0, math.pi, math.pi, 0.0], [0.0, -math.pi, -math.pi, 0.0]]
    poses = [[0, 0, math.pi], [0, 0, -math.pi], [0, 0, math.pi]]
    emap = ExperienceMap.from_arrays(IRAT, stored(poses, [[0, 1], [1, 2]], values))
    for _ in range(1000):
        emap.iterate()
    assert np.isfinite(emap.poses).all()
    assert (np.abs(emap.poses[:, 2]) <= math.pi).all()
    assert np.isfinite(optimise(poses, [[0, 1], [1, 2]], values).cost)


def test_a_hundred_thousand_sweeps_stay_finite_and_do_not_wander():
    emap = ring(20, np.random.default_rng(8), 0.05)
    centre = emap.poses[:, :2].mean(axis=0)
    for _ in range(5000):
        emap.iterate()
    assert np.isfinite(emap.poses).all()
    np.testing.assert_allclose(emap.poses[:, :2].mean(axis=0), centre, atol=1e-9)
