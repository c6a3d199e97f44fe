"""What the sequence SLAM costs: by length of run, by memory and lag, and its solver beside SciPy's.

Times are processor times of one core. Memory is that of a process that does nothing else.
"""

from __future__ import annotations

import multiprocessing
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from vibrissa.slam.graph import (
    Graph,
    GraphParams,
    block_pairs,
    normal_equations,
    optimise,
    weigh,
)
from vibrissa.slam.graph_solver import Structure, analyse
from vibrissa.slam.graph_start import start_values
from vibrissa.slam.interface import Odometry
from vibrissa.slam.sequence import SequenceSlam
from vibrissa.slam.sequence_config import BATCH, SequenceConfig
from vibrissa.slam.sequence_rehearsal import rehearse
from vibrissa.tools.experiment.design import CONTACT_ANGLE
from vibrissa.tools.experiment.mapping import noisy
from vibrissa.tools.experiment.recording import Recording
from vibrissa.tools.experiment.scores import RELATIONS
from vibrissa.tools.experiment.slam_runs import SlamRow, odometer, run_row
from vibrissa.tools.experiment.statistics import geometric_mean

Floats = NDArray[np.float64]

LAG: Final = 100
LENGTHS: Final = (1_000, 10_000, 100_000)
MAPPED: Final = 10_000
"""Whisks up to which the map is asked for."""
NEWEST: Final = 1_000
MEMORIES: Final = (512, 2048, 8192)
LAGS: Final = (BATCH, 100, 30, 10, 0)
REPEATS: Final = 5


def by_length(
    recording: Recording, noise: str, seed: int, lengths: Sequence[int] = LENGTHS
) -> list[dict[str, Any]]:
    """Time per whisk of lag 100 at the end of runs of these lengths, in a fresh process.

    The recording is driven again and again, each time with fresh odometry noise.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context) as pool:
        return pool.submit(_by_length, recording, noise, seed, tuple(lengths)).result()


def _by_length(
    recording: Recording, noise: str, seed: int, lengths: tuple[int, ...]
) -> list[dict[str, Any]]:
    rehearse()
    slam = SequenceSlam(SequenceConfig(lag=LAG, odometer=odometer(noise, seed)))
    spent: list[float] = []
    found = []
    for image, step in _again_and_again(recording, noise, seed, max(lengths)):
        begun = time.process_time()
        slam.step(image, step)
        spent.append(1e3 * (time.process_time() - begun))
        if len(spent) not in lengths:
            continue
        mapped = None
        if len(spent) <= MAPPED:
            begun = time.process_time()
            slam.map()
            mapped = time.process_time() - begun
        newest = np.array(spent[-NEWEST:])
        row = {"whisks": str(len(spent)), f"mean of last {NEWEST}, ms": float(newest.mean())}
        row |= {"p99, ms": float(np.percentile(newest, 99)), "worst, ms": float(newest.max())}
        row |= {"worst of all, ms": max(spent), "process, MB": _megabytes(), "map, s": mapped}
        found.append(row)
    return found


def _again_and_again(
    recording: Recording, noise: str, seed: int, whisks: int
) -> Iterator[tuple[NDArray[np.uint8], Odometry]]:
    images = np.ascontiguousarray(recording.image(CONTACT_ANGLE))
    n = len(images)
    for lap in range(-(-whisks // n)):
        motion = noisy(recording, noise, seed + lap).tolist()
        for k in range(min(n, whisks - lap * n)):
            yield images[k], Odometry(*motion[k])


def _megabytes() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024.0
    return float("nan")


def by_setting(
    recordings: Sequence[tuple[Recording, int]],
    noise: str,
    rows: Sequence[SlamRow],
) -> list[dict[str, Any]]:
    """Energy Metric over that of odometry, geometric mean over recordings (with their seeds), and
    time per whisk, the map at the end included, of each row."""
    found = []
    for row in rows:
        runs, spent, whisks = [], 0.0, 0
        for recording, seed in recordings:
            motion = noisy(recording, noise, seed)
            begun = time.process_time()
            runs.append(run_row(recording, motion, row, noise, seed))
            spent += time.process_time() - begun
            whisks += len(recording)
        cell: dict[str, Any] = {"setting": row.name, "noise": noise}
        cell |= {r: geometric_mean([run[r] for run in runs]) for r in RELATIONS}
        found.append(cell | {"ms per whisk": 1e3 * spent / whisks})
    return found


def settings() -> list[SlamRow]:
    """Memories at lag 100, and lags."""
    usual = SlamRow("", "sequence", lag=LAG)
    memories = [replace(usual, name=f"memory {size}", memory=size) for size in MEMORIES]
    names = {BATCH: "batch", 0: "past only"}
    lags = [replace(usual, name=names.get(lag, f"lag {lag}"), lag=lag) for lag in LAGS]
    return memories + lags


def by_solver(recording: Recording, noise: str, seed: int) -> list[dict[str, Any]]:
    """The map's optimisation by the compiled block solver and by SciPy's splu: time, and how far
    their poses are apart (m or rad)."""
    slam = SequenceSlam(SequenceConfig(lag=BATCH, odometer=odometer(noise, seed)))
    images = np.ascontiguousarray(recording.image(CONTACT_ANGLE))
    for image, step in zip(images, noisy(recording, noise, seed).tolist(), strict=True):
        slam.step(image, Odometry(*step))
    steps, loops, facing = slam.pose_graph()
    start, turns = np.zeros((len(steps) + 1, 3)), np.empty(len(loops))
    nearest, surprise = np.zeros(len(loops), dtype=np.bool_), np.empty(len(loops))
    params = GraphParams()
    start_values(start, 0, steps, loops, facing, params.loop_heading, nearest, turns, surprise)
    graph = Graph(steps, loops, turns)

    def own() -> Floats:
        return optimise(graph, start, params).poses

    def peer() -> Floats:
        return optimised_by_scipy(graph, start, params)

    (own_poses, own_s), (peer_poses, peer_s) = _timed(own), _timed(peer)
    apart = float(np.abs(own_poses - peer_poses).max())
    size = {"whisks": len(start), "loops": len(loops)}
    return [
        {"solver": "3 x 3 blocks, compiled"} | size | {"s": own_s, "ratio": 1.0, "apart": 0.0},
        {"solver": "SciPy splu"} | size | {"s": peer_s, "ratio": peer_s / own_s, "apart": apart},
    ]


def _timed(function: Callable[[], Floats]) -> tuple[Floats, float]:
    """What a function returns, and its median processor time, s."""
    spent = []
    for _ in range(REPEATS):
        begun = time.process_time()
        found = function()
        spent.append(time.process_time() - begun)
    return found, statistics.median(spent)


def optimised_by_scipy(graph: Graph, start: Floats, params: GraphParams) -> Floats:
    """What `graph.optimise` does, the linear systems solved by SuperLU by way of SciPy."""
    poses, weights = start.copy(), np.ones(len(graph.loops))
    pairs, slots = block_pairs(len(poses), graph.loops)
    structure = analyse(len(poses), pairs)
    for iteration in range(params.iterations):
        weigh(graph.loops, graph.turns, poses, params, params.scale(iteration), weights)
        blocks = normal_equations(graph, structure, slots, poses, params, weights)
        poses += _solved_by_scipy(structure, pairs, *blocks)
    return poses


def _solved_by_scipy(
    structure: Structure, pairs: NDArray[np.int32], diagonal: Floats, lower: Floats, b: Floats
) -> Floats:
    n = len(b)
    stored = lower[structure.pair_slot]  # rows of the node that is eliminated later
    a_b = np.where(structure.pair_swap[:, None, None], stored.transpose(0, 2, 1), stored)
    rows = np.concatenate([np.arange(n), pairs[:, 0], pairs[:, 1]])
    columns = np.concatenate([np.arange(n), pairs[:, 1], pairs[:, 0]])
    values = np.concatenate([diagonal[structure.place], a_b, a_b.transpose(0, 2, 1)])
    inside = np.arange(3)
    at = np.broadcast_arrays(
        3 * rows[:, None, None] + inside[:, None], 3 * columns[:, None, None] + inside
    )
    matrix = sparse.csc_matrix(
        (values.ravel(), (at[0].ravel(), at[1].ravel())), shape=(3 * n, 3 * n)
    )
    solver = sparse_linalg.splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.asarray(solver.solve(b.ravel())).reshape(n, 3)
