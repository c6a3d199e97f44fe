"""`vibrissa bench slam-stress`: RatSLAM for a very long time, and on inputs without information."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from vibrissa.processes.results import OnProgress, Progress
from vibrissa.slam.config import IRAT, WHISKER
from vibrissa.slam.experience_map import ExperienceMap, ExperienceMapError
from vibrissa.slam.interface import Odometry, SlamInputError
from vibrissa.slam.optimum import optimise
from vibrissa.slam.pose_cells import PoseCells
from vibrissa.slam.ratslam import RatSlam
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.bench_slam import one_core
from vibrissa.tools.slam_speed import wandered_map

Row = dict[str, Any]

ITERATIONS: Final = 10_000_000
LOOPS: Final = 1_000_000
CELLS_PER_CALL: Final = 1000
"""Iterations per call: an odometry step of so many cells is split into as many."""


def bench(_out: Path, _duration: float, on_progress: OnProgress, *, quick: bool = False) -> Bench:
    """1e7 pose-cell iterations, 1e6 relaxation sweeps, degenerate inputs; quick: a thousandth."""
    share = 1000 if quick else 1
    with one_core():
        cells = pose_cells(ITERATIONS // share, on_progress)
        relaxation = relax(LOOPS // share, on_progress)
    inputs = list(degenerate_inputs(30 if quick else 2000))
    return Bench(
        "slam-stress",
        [cells, relaxation, *inputs],
        [
            Target("pose cells: largest |sum - 1|", cells["largest |sum - 1|"], "", "<=", 1e-9),
            Target("pose cells: negative cells", cells["negative"], "", "==", 0),
            Target("pose cells: cells not finite", cells["not finite"], "", "==", 0),
            Target("relaxation: poses not finite", relaxation["not finite"], "", "==", 0),
            Target("relaxation: drift of the centre", relaxation["drift m"], "m", "<=", 1e-6),
            Target("degenerate inputs without an outcome", failures(inputs), "", "==", 0),
        ],
    )


def failures(inputs: list[Row]) -> int:
    """How many inputs gave neither a defined result nor a named error."""
    return sum(row["outcome"].startswith("!") for row in inputs)


def pose_cells(iterations: int, on_progress: OnProgress) -> Row:
    """Long motion in all directions, with injections; the packet looked at after every call."""
    network = PoseCells(IRAT)
    rng = np.random.default_rng(1)
    for view in range(40):
        network.on_view_template(view)
        network.on_odo(0.9 * IRAT.pc_cell_x_size, 0.2, 1.0)
    largest, negative, bad = 0.0, 0, 0
    calls = max(1, iterations // CELLS_PER_CALL)
    start = time.perf_counter()
    for number in range(calls):
        network.on_view_template(int(rng.integers(0, 30)))
        cells = CELLS_PER_CALL * float(rng.choice((-1.0, 1.0))) * float(rng.uniform(0.9991, 1.0))
        network.on_odo(cells * IRAT.pc_cell_x_size, float(rng.normal(0.0, 100.0)), 1.0)
        largest = max(largest, abs(float(network.cells.sum()) - 1.0))
        negative += int((network.cells < 0.0).sum())
        bad += int((~np.isfinite(network.cells)).sum()) + int(not np.isfinite(network.best).all())
        if number % 100 == 0:
            on_progress(Progress("pose cells", number, calls))
    return {
        "stress": "pose cells",
        "iterations": calls * CELLS_PER_CALL,
        "s": time.perf_counter() - start,
        "largest |sum - 1|": largest,
        "negative": negative,
        "not finite": bad,
        "active cells": int(np.count_nonzero(network.cells)),
    }


def relax(loops: int, on_progress: OnProgress) -> Row:
    """A map of 60 experiences relaxed over and over."""
    per_call = min(1000, loops)
    emap = wandered_map(60, loops=per_call)
    centre = emap.poses[:, :2].mean(axis=0)
    start = time.perf_counter()
    calls = loops // per_call
    for number in range(calls):
        emap.iterate()
        if number % 100 == 0:
            on_progress(Progress("relaxation", number, calls))
    return {
        "stress": "relaxation",
        "sweeps": calls * per_call,
        "s": time.perf_counter() - start,
        "drift m": float(np.abs(emap.poses[:, :2].mean(axis=0) - centre).max()),
        "not finite": int((~np.isfinite(emap.poses)).sum()),
    }


# ------------------------------------------------------------------------- degenerate inputs


def degenerate_inputs(steps: int) -> Iterator[Row]:
    """Each input with its outcome: a finite result, a named error, or "! ..." what went wrong."""
    black, white = np.zeros((3, 6), np.uint8), np.full((3, 6), 255, np.uint8)
    noise = np.random.default_rng(2).integers(0, 256, (steps, 3, 6)).astype(np.uint8)
    cell = WHISKER.pc_cell_x_size

    def alternating(number: int) -> np.ndarray[Any, Any]:
        return black if number % 2 else white

    cases: dict[str, Callable[[], str]] = {
        "no motion": lambda: drive(steps, lambda k: noise[k], 0.0, 0.0),
        "no views": lambda: no_views(steps),
        "one template forever": lambda: drive(steps, lambda k: noise[0], 0.01, 0.05),
        "all black": lambda: drive(steps, lambda k: black, 0.01, 0.05),
        "all white": lambda: drive(steps, lambda k: white, 0.01, 0.05),
        "black and white in turn": lambda: drive(steps, alternating, 0.01, 0.05),
        "steps of 1e-12 cells": lambda: drive(steps, lambda k: noise[k], 1e-12 * cell, 1e-12),
        "steps of 1e3 cells": lambda: drive(steps // 10, lambda k: noise[k], 1e3 * cell, 0.3),
        "steps of 1e5 cells": lambda: drive(1, lambda k: noise[k], 1e5 * cell, 0.0),
        "turns of pi": lambda: drive(steps, lambda k: noise[k], 0.01, math.pi),
        "turns of -pi": lambda: drive(steps, lambda k: noise[k], 0.01, -math.pi),
        "reverse": lambda: drive(steps, lambda k: noise[k], -0.01, 0.0),
        "coincident experiences at +-pi": lambda: small_map(
            [[0, 0, math.pi], [0, 0, -math.pi], [0, 0, math.pi]],
            [[0, 1], [1, 2]],
            [[0.0, math.pi, math.pi, 0.0], [0.0, -math.pi, -math.pi, 0.0]],
        ),
        "a disconnected map": lambda: small_map(
            [[0, 0, 0], [2, 0, 0], [9, 0, 1], [9, 3, 1]],
            [[0, 1], [2, 3]],
            [[1.0, 0.0, 0.0, 1.0]] * 2,
        ),
        "a map without links": lambda: small_map([[0, 0, 0], [1, 1, 1]], [], []),
        "an empty map": lambda: small_map([], [], []),
    }
    for name, run in cases.items():
        try:
            outcome = run()
        except (SlamInputError, ExperienceMapError) as error:
            outcome = f"{type(error).__name__}: {error}"
        yield {"input": name, "outcome": outcome}


def drive(steps: int, image: Callable[[int], Any], v: float, w: float) -> str:
    """RatSLAM over images at a constant speed."""
    slam = RatSlam(replace(WHISKER, pc_vt_inject_energy=0.05))
    for number in range(max(1, steps)):
        step = slam.step(image(number), Odometry(v, w, 1.0))
        values = (step.x, step.y, step.heading, step.pc_x, step.pc_y, step.pc_th)
        if not np.isfinite(values).all():
            return f"! step {number}: {values}"
        n, layers = WHISKER.pc_dim_xy, WHISKER.pc_dim_th
        if not (0 <= step.pc_x < n and 0 <= step.pc_y < n and 0 <= step.pc_th < layers):
            return f"! step {number}: packet at {values[3:]}"
    cells, poses = slam.pose_cells.cells, slam.map().poses
    if cells.min() < 0.0 or not np.isfinite(cells).all() or not np.isfinite(poses).all():
        return "! negative or not finite"
    return f"finite, {step.templates} templates, {step.experiences} experiences"


def no_views(steps: int) -> str:
    """Odometry without a single view."""
    network = PoseCells(WHISKER)
    kinds = set()
    for _ in range(steps):
        network.on_odo(0.01, 0.1, 1.0)
        kinds.add(network.get_action().kind)
    if kinds != {0} or abs(float(network.cells.sum()) - 1.0) > 1e-9:
        return f"! actions {kinds}, sum {network.cells.sum()}"
    return "finite, no experiences"


def small_map(poses: Any, links: Any, values: Any) -> str:
    """A map relaxed a thousand times, and its optimum."""
    arrays: dict[str, Any] = {
        "poses": np.array(poses, dtype=np.float64).reshape(-1, 3),
        "links": np.array(links, dtype=np.int32).reshape(-1, 2),
        "link_values": np.array(values, dtype=np.float64).reshape(-1, 4),
        "current": np.array(0),
        "agent": np.zeros(4),
    }
    emap = ExperienceMap.from_arrays(replace(IRAT, exp_loops=1000), arrays)
    emap.iterate()
    if not np.isfinite(emap.poses).all():
        return f"! {emap.poses.tolist()}"
    best = optimise(arrays["poses"], arrays["links"], arrays["link_values"])
    if not np.isfinite(best.poses).all():
        return f"! optimum {best.poses.tolist()}"
    return f"finite, optimum at cost {best.cost:.3g}"
