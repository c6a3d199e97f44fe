"""The pose graph against dense and general solvers, and what loops may and may not do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from vibrissa.slam.graph import Graph, GraphParams, optimise
from vibrissa.slam.graph_solver import analyse, factorise, solve
from vibrissa.slam.graph_start import start_values
from vibrissa.slam.graph_window import refine

PARAMS = GraphParams()


def random_system(seed: int, nodes: int, extra: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of a chain with extra pairs, the blocks (a, b) of a system, and the dense matrix."""
    rng = np.random.default_rng(seed)
    pairs = {(i, i + 1) for i in range(nodes - 1)}
    for a, b in rng.integers(0, nodes, (extra, 2)):
        if a != b:
            pairs.add((min(a, b), max(a, b)))
    found = np.array(sorted(pairs), dtype=np.int32).reshape(-1, 2)
    blocks = rng.normal(size=(len(found), 3, 3))
    dense = np.eye(3 * nodes) * 40.0
    for (a, b), block in zip(found, blocks, strict=True):
        dense[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] = block
        dense[3 * b : 3 * b + 3, 3 * a : 3 * a + 3] = block.T
    return found, blocks, dense


@pytest.mark.parametrize(("nodes", "extra"), [(1, 0), (2, 0), (3, 2), (30, 0), (60, 40), (90, 200)])
def test_the_block_solver_solves_what_a_dense_one_solves(nodes: int, extra: int) -> None:
    pairs, blocks, dense = random_system(nodes, nodes, extra)
    structure = analyse(nodes, pairs)
    assert sorted(structure.place.tolist()) == list(range(nodes))
    diagonal = np.tile(np.eye(3) * 40.0, (nodes, 1, 1))
    lower = np.zeros((len(structure.row), 3, 3))
    swap = structure.pair_swap[:, None, None]
    lower[structure.pair_slot] = np.where(swap, blocks.transpose(0, 2, 1), blocks)
    assert factorise(structure.start, structure.row, diagonal, lower)
    b = np.random.default_rng(1).normal(size=(nodes, 3))
    x = b.copy()
    solve(structure.place, structure.start, structure.row, diagonal, lower, x)
    assert x.ravel() == pytest.approx(np.linalg.solve(dense, b.ravel()), rel=1e-11, abs=1e-14)


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    structure = analyse(2, np.array([[0, 1]], dtype=np.int32))
    diagonal = np.tile(np.eye(3), (2, 1, 1))
    assert not factorise(structure.start, structure.row, diagonal, 2.0 * np.eye(3)[None])


def test_a_chain_is_ordered_without_fill() -> None:
    pairs = np.stack([np.arange(99), np.arange(1, 100)], axis=1).astype(np.int32)
    assert len(analyse(100, pairs).row) == 99


def circle(
    seed: int, laps: int = 3, per_lap: int = 50
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Noisy steps of laps around a circle, true loops, their facing, and the true poses."""
    rng = np.random.default_rng(seed)
    nodes = laps * per_lap
    turn = 2.0 * np.pi / per_lap
    truth = np.zeros((nodes, 3))
    for i in range(1, nodes):
        h = truth[i - 1, 2] + turn
        truth[i] = truth[i - 1] + [0.02 * np.cos(h), 0.02 * np.sin(h), turn]
    steps = np.empty((nodes - 1, 4))
    steps[:] = 0.02, turn, 0.003, 0.03
    steps[:, :2] += rng.normal(size=(nodes - 1, 2)) * steps[:, 2:]
    loops = np.array([(a, a - per_lap) for a in range(per_lap + 1, nodes, 3)], dtype=np.int64)
    return steps, loops, np.zeros(len(loops), dtype=np.int8), truth


def started(
    steps: np.ndarray, loops: np.ndarray, facing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    poses, turns = np.zeros((len(steps) + 1, 3)), np.empty(len(loops))
    nearest, surprise = np.zeros(len(loops), dtype=np.bool_), np.empty(len(loops))
    start_values(poses, 0, steps, loops, facing, PARAMS.loop_heading, nearest, turns, surprise)
    return poses, turns


def residuals(poses: np.ndarray, graph: Graph, weights: np.ndarray) -> np.ndarray:
    """All residuals over their standard deviations, written out a second time."""
    move = np.diff(poses, axis=0)
    c, s = np.cos(poses[1:, 2]), np.sin(poses[1:, 2])
    steps = graph.steps
    odometry = [
        (c * move[:, 0] + s * move[:, 1] - steps[:, 0]) / steps[:, 2],
        (c * move[:, 1] - s * move[:, 0]) / PARAMS.lateral,
        (move[:, 2] - steps[:, 1]) / steps[:, 3],
    ]
    middle = np.concatenate([poses[:1], (poses[1:] + poses[:-1]) / 2.0])
    apart = middle[graph.loops[:, 0]] - middle[graph.loops[:, 1]]
    apart[:, 2] -= graph.turns
    apart /= [PARAMS.loop_place, PARAMS.loop_place, PARAMS.loop_heading]
    return np.concatenate([*odometry, (apart * np.sqrt(weights)[:, None]).ravel()])


def test_the_poses_found_are_the_least_squares_solution_for_their_weights() -> None:
    steps, loops, facing, _ = circle(1)
    start, turns = started(steps, loops, facing)
    graph = Graph(steps, loops, turns)
    params = GraphParams(iterations=40)
    found = optimise(graph, start, params)

    def cost(free: np.ndarray) -> np.ndarray:
        return residuals(np.vstack([start[:1], free.reshape(-1, 3)]), graph, found.weights)

    peer = least_squares(cost, found.poses[1:].ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert np.abs(peer.x.reshape(-1, 3) - found.poses[1:]).max() < 1e-6
    apart = residuals(found.poses, graph, np.ones(len(loops)))[-3 * len(loops) :].reshape(-1, 3)
    chi2 = (apart**2).sum(axis=1)
    expected = (params.robust / (params.robust + chi2)) ** 2
    assert found.weights == pytest.approx(expected, abs=1e-6)


def test_true_loops_bring_the_poses_nearer_to_the_truth() -> None:
    for seed in range(5):
        steps, loops, facing, truth = circle(seed)
        start, turns = started(steps, loops, facing)
        found = optimise(Graph(steps, loops, turns), start, PARAMS).poses
        plain, _ = started(steps, loops[:0], facing[:0])
        apart = [
            np.hypot(*(p[50:] - p[:-50] - (truth[50:] - truth[:-50]))[:, :2].T)
            for p in (found, plain)
        ]
        assert np.sqrt((apart[0] ** 2).mean()) < 0.5 * np.sqrt((apart[1] ** 2).mean())


def test_without_loops_the_start_stays_to_the_bit() -> None:
    steps, loops, facing, _ = circle(2)
    start, turns = started(steps, loops[:0], facing[:0])
    assert np.array_equal(optimise(Graph(steps, loops[:0], turns), start, PARAMS).poses, start)


def test_false_loops_among_true_ones_lose_their_pull() -> None:
    steps, loops, _facing, _ = circle(3)
    false = np.array([[70, 8], [101, 20], [133, 70]], dtype=np.int64)
    both = np.concatenate([loops, false])
    order = np.argsort(both[:, 0], kind="stable")
    both, is_false = both[order], order >= len(loops)
    start, turns = started(steps, both, np.zeros(len(both), dtype=np.int8))
    found = optimise(Graph(steps, both, turns), start, PARAMS)
    assert found.weights[is_false].max() < 0.1
    assert np.median(found.weights[~is_false]) > 0.8


def test_headings_keep_their_whole_turns() -> None:
    steps, loops, facing, _ = circle(4, laps=6)
    _, turns = started(steps, loops, facing)
    assert turns == pytest.approx(np.full(len(loops), 2.0 * np.pi))
    _, turns = started(steps, loops, np.ones(len(loops), dtype=np.int8))
    assert np.abs(np.mod(turns, 2.0 * np.pi) - np.pi).max() < 1e-9


def test_a_window_over_everything_agrees_with_the_graph_where_all_loops_end_at_held_poses() -> None:
    steps, loops, facing, _ = circle(5, laps=2)
    held = 50
    truth_like, _ = started(steps, loops[:0], facing[:0])
    poses = truth_like.copy()
    refine(poses, held, steps, loops, facing, PARAMS)
    assert np.array_equal(poses[: held + 1], truth_like[: held + 1])
    # the same by a general solver over the free poses
    _, turns = started(steps, loops, facing)
    use = loops[:, 0] >= held + 2
    graph = Graph(steps, loops[use], turns[use])
    apart = residuals(poses, graph, np.ones(use.sum()))[-3 * use.sum() :].reshape(-1, 3)
    weights = (PARAMS.robust / (PARAMS.robust + (apart**2).sum(axis=1))) ** 2

    def cost(free: np.ndarray) -> np.ndarray:
        trial = np.vstack([poses[: held + 1], free.reshape(-1, 3)])
        return residuals(trial, graph, weights)

    peer = least_squares(cost, poses[held + 1 :].ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert np.abs(peer.x.reshape(-1, 3) - poses[held + 1 :]).max() < 1e-3


def test_the_same_graph_gives_the_same_bytes() -> None:
    steps, loops, facing, _ = circle(6)
    runs = []
    for _ in range(2):
        start, turns = started(steps, loops, facing)
        runs.append(optimise(Graph(steps, loops, turns), start, PARAMS).poses.tobytes())
    assert runs[0] == runs[1]
