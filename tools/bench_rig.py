"""`vibrissa bench rig`: the simulated rig's run time against its error.

One process on one core, processor time. Errors of the beam are against its exact form, and those of
the exact form against four times as many steps; errors of the integration against 64 kHz. Speeds of
skipping are ratios to the same run without it, whose bytes are compared.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vibrissa.control.kinematics import NOSE_HEIGHT, WHISKERS
from vibrissa.numerics import compiled
from vibrissa.processes.results import OnProgress, Progress
from vibrissa.rig import elastica
from vibrissa.rig.beam import EXACT, LINEAR, TABLE, beam_tables, peg, tip
from vibrissa.rig.beam_table import LEAST_HEIGHT, LEAST_Q, SIZE
from vibrissa.rig.maze_random import random_maze
from vibrissa.rig.plant import HeadPlantParams, head_model
from vibrissa.rig.scene import wall_boxes
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.bench_slam import one_core
from vibrissa.tools.carried_head import Carriage, carried, carry, tour

Row = dict[str, Any]
Float64s = NDArray[np.float64]

RATIO: Final = 0.25
"""Tip over base diameter of the beam front: the rear ring's."""
SIZES: Final = (9, 17, 33, SIZE, 97)
RATES: Final = (500, 1000, 2000, 4000, 8000, 16000)
REFERENCE_RATE: Final = 64000
KNOTS: Final = 500
DENSITIES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
PEGS, TIPS = range(2)


def bench(out: Path, seconds: float, on_progress: OnProgress, *, quick: bool = False) -> Bench:
    """Measure everything; seconds: of the long run; quick: only enough to see that it works."""
    stretch = 2.0 if quick else 20.0
    parts: dict[str, Callable[[], list[Row]]] = {
        "beam": lambda: beam_rows(12 if quick else 400, SIZES[:3] if quick else SIZES),
        "integration": lambda: rate_rows(stretch, RATES[:4] if quick else RATES),
        "whisker step": lambda: step_rows(stretch),
        "skipping": lambda: skipping_rows(stretch, DENSITIES[::2] if quick else DENSITIES),
        "long run": lambda: [long_run_row(seconds)],
    }
    found: dict[str, list[Row]] = {}
    with one_core():
        for number, (name, measure) in enumerate(parts.items()):
            on_progress(Progress("measuring", number, len(parts), name))
            found[name] = measure()
    rows = [row for part in found.values() for row in part]
    return Bench("rig", rows, targets(found), figure(found["beam"], found["integration"]))


def targets(found: dict[str, list[Row]]) -> list[Target]:
    """What was aimed at; what was not measured is not there."""
    beam = {row["beam"]: row for row in found["beam"]}
    steps = {row["whisker step"]: row["ns"] for row in found["whisker step"]}
    made = [Target("exact beam", beam["exact"]["largest error"], "of full scale", "<=", 1e-6)]
    if f"table {SIZE}" in beam:
        error = beam[f"table {SIZE}"]["largest error"]
        made.append(Target(f"beam table of {SIZE}", error, "of full scale", "<=", 1e-3))
    made += [
        Target("2 kHz against 64 kHz, rms", row["rms error over noise"], "of noise", "<", 1.0)
        for row in found["integration"]
        if row["rate Hz"] == 2000
    ]
    skipping = found["skipping"]
    made += [
        Target("whisker step, free", steps["free, in the air"], "ns", "<=", 65.0),
        Target("whisker step, touching", steps["touching"], "ns", "<=", 400.0),
        Target("runs that differ by skipping", sum(r["differs"] for r in skipping), "", "==", 0),
        Target("slowest run with skipping", min(r["speed-up"] for r in skipping), "x", ">=", 1.0),
        Target(
            "whiskers not finite after the long run",
            found["long run"][0]["not finite"],
            "",
            "==",
            0,
        ),
    ]
    return made


def beam_rows(points: int, sizes: tuple[int, ...]) -> list[Row]:
    """Time and error of every form of the beam, at random places of its whole range."""
    rng = np.random.default_rng(1)
    places = np.empty((points, 3), dtype=np.float64)
    places[:, 0] = rng.uniform(LEAST_Q, 1.0, points)
    for k, q in enumerate(places[:, 0]):
        places[k, 1] = elastica.last_peg(q, 100)[2] * rng.uniform(0.0, 0.999)
    tips = rng.uniform((LEAST_HEIGHT, 0.0), (0.999, 1.0), (points, 2))
    turns = np.array([math.acos(h) * (1.0 - share) for h, share in tips])
    planes = np.stack([tips[:, 0], turns, np.zeros(points)], axis=1)
    exact = [
        evaluated(kind, EXACT, beam_tables((RATIO,), 9), at)
        for kind, at in ((PEGS, places), (TIPS, planes))
    ]
    scale = [np.abs(moment).max() for moment, _ns in exact]
    finer = np.array([_finer(*place) for place in places[: max(points // 8, 4)]])
    rows = []
    forms = [("linear", LINEAR, 9), *((f"table {size}", TABLE, size) for size in sizes)]
    for name, form, size in forms:
        tables = beam_tables((RATIO,), size)
        errors, times = [], []
        for kind, at in ((PEGS, places), (TIPS, planes)):
            moment, ns = evaluated(kind, form, tables, at)
            errors.append(np.abs(moment - exact[kind][0]) / scale[kind])
            times.append(ns)
        rows.append(_beam_row(name, np.concatenate(errors), times, tables.nbytes))
    error = np.abs(exact[PEGS][0][: len(finer)] - finer) / scale[PEGS]
    rows.append(_beam_row("exact", error, [ns for _moment, ns in exact], 0))
    return rows


def _beam_row(name: str, errors: Float64s, ns: list[float], size: int) -> Row:
    return {
        "beam": name,
        "ns, shaft on a peg": ns[PEGS],
        "ns, tip on a plane": ns[TIPS],
        "rms error": float(np.sqrt(np.mean(errors * errors))),
        "largest error": float(errors.max()),
        "table kB": size / 1024,
    }


def evaluated(kind: int, form: int, tables: Float64s, at: Float64s) -> tuple[Float64s, float]:
    """Moments float64[n] at places float64[n, 3], and ns per place (the best of some repeats)."""
    moments = np.empty(len(at))
    repeats = 1 if form == EXACT else 200
    _evaluate(kind, form, tables, at, 1, moments)
    best = math.inf
    for _ in range(1 if form == EXACT else 5):
        start = time.process_time()
        _evaluate(kind, form, tables, at, repeats, moments)
        best = min(best, time.process_time() - start)
    return moments, best / (repeats * len(at)) * 1e9


@compiled
def _evaluate(
    kind: int, form: int, tables: Float64s, at: Float64s, repeats: int, moments: Float64s
) -> None:
    for _ in range(repeats):
        for k in range(at.shape[0]):
            if kind == PEGS:
                moments[k] = peg(form, tables, at[k, 0], at[k, 1])[0]
            else:
                moments[k] = tip(form, tables, 1, RATIO, at[k, 0], at[k, 1])[0]


def _finer(q: float, gamma: float, _unused: float) -> float:
    return float(elastica.peg_contact(q, gamma, 4 * elastica.STEPS)[2])


def rate_rows(seconds: float, rates: tuple[int, ...]) -> list[Row]:
    """Time and error of the integration: the same tour at every rate, without noise."""
    quiet = HeadPlantParams(encoder_noise=0.0, sensor_noise=0.0, sensor_resolution=0.0)
    boxes = wall_boxes(random_maze(7, 5, 1))
    noise = HeadPlantParams().sensor_noise
    over = tour(seconds, KNOTS)
    truth = carried(boxes, replace(quiet, rate=float(REFERENCE_RATE)), over)
    rows = []
    for rate in rates:
        felt = carried(boxes, replace(quiet, rate=float(rate)), over)
        error = np.abs(np.stack([felt.x - truth.x, felt.y - truth.y])).astype(np.float64)
        rows.append(
            {
                "rate Hz": rate,
                "ms per second": felt.seconds / seconds * 1e3,
                "rms error over noise": float(np.sqrt(np.mean(error * error))) / noise,
                "99.9 % below": float(np.quantile(error, 0.999)) / noise,
                "largest error over noise": float(error.max()) / noise,
                "rms theta mrad": float(np.std(felt.theta - truth.theta)) * 1e3,
            }
        )
    return rows


def step_rows(seconds: float) -> list[Row]:
    """ns per whisker step: in the air, and touching (what contact adds, per whisker in contact)."""
    params = HeadPlantParams()
    model = head_model(wall_boxes(random_maze(7, 5, 1)), params)
    air, low = (tour(seconds, 2000, height) for height in (0.3, NOSE_HEIGHT))
    best: dict[str, float] = {}
    held = ticks = 0
    for _ in range(3):
        for name, carriage, skip in (("air", air, True), ("bare", air, False), ("low", low, True)):
            felt = carry(model, params, carriage, skip=skip)
            best[name] = min(best.get(name, math.inf), felt.seconds)
            ticks, held = felt.ticks, felt.held
    steps = ticks * WHISKERS
    free = best["air"] / steps * 1e9
    return [
        {"whisker step": "free, in the air", "ns": free, "share of steps": 1.0},
        {
            "whisker step": "free, nothing skipped",
            "ns": best["bare"] / steps * 1e9,
            "share of steps": 1.0,
        },
        {
            "whisker step": "all, over a maze",
            "ns": best["low"] / steps * 1e9,
            "share of steps": 1.0,
        },
        {
            "whisker step": "touching",
            "ns": free + (best["low"] - best["air"]) / held * 1e9,
            "share of steps": held / steps,
        },
    ]


def skipping_rows(seconds: float, densities: tuple[float, ...]) -> list[Row]:
    """Speed-up of skipping from no walls to walls everywhere, with the bytes of both runs."""
    params, over = HeadPlantParams(), tour(seconds, 2000)
    rows = [_skipping_row("nothing", np.zeros((0, 5)), params, over)]
    for density in densities:
        maze = random_maze(7, 5, 1, ring_walls=density, inner_walls=density)
        if density == 0.0:
            maze = replace(maze, posts=np.zeros_like(maze.posts))
        name = f"{density:.0%} of walls" if density else "border only"
        rows.append(_skipping_row(name, wall_boxes(maze), params, over))
    return rows


def _skipping_row(name: str, boxes: Float64s, params: HeadPlantParams, over: Carriage) -> Row:
    model = head_model(boxes, params)
    quick, full = carry(model, params, over), carry(model, params, over, skip=False)
    logical = len(over.commands) / over.rate
    return {
        "walls": name,
        "boxes": len(boxes),
        "touching": quick.held / (quick.ticks * WHISKERS),
        "skipping x real time": logical / quick.seconds,
        "not skipping x real time": logical / full.seconds,
        "speed-up": full.seconds / quick.seconds,
        "differs": int(quick.bytes() != full.bytes()),
    }


def long_run_row(seconds: float) -> Row:
    """Hours over walls everywhere, many ticks after the first: what is not finite, how fast."""
    params = HeadPlantParams(sensor_drift=1e-6, friction=0.3)
    model = head_model(wall_boxes(random_maze(7, 5, 1, ring_walls=1.0, inner_walls=1.0)), params)
    piece = tour(20.0, 2000)
    pieces = max(1, round(seconds / 20.0))
    bad, taken, worst = 0, 0.0, 0.0
    for k in range(pieces):
        felt = carry(model, params, piece, first_tick=k * len(piece.commands) + 2**33)
        bad += sum(int((~np.isfinite(v)).sum()) for v in (felt.theta, felt.x, felt.y, felt.state))
        worst = max(worst, float(np.abs(felt.y).max()))
        taken += felt.seconds
    return {
        "long run": "walls everywhere, drift, friction",
        "hours": pieces * 20.0 / 3600.0,
        "not finite": bad,
        "largest y N m": worst,
        "x real time": pieces * 20.0 / taken,
    }


def figure(beam: list[Row], rates: list[Row]) -> Figure:
    """Run time against error: beam and integration."""
    made = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = made.subplots(1, 2)
    for column, style in (("ns, shaft on a peg", "o-"), ("ns, tip on a plane", "s--")):
        left.plot(
            [r[column] for r in beam], [r["largest error"] for r in beam], style, label=column[4:]
        )
    for row in beam:
        left.annotate(row["beam"], (row["ns, shaft on a peg"], row["largest error"]), fontsize=7)
    left.set(xlabel="time (ns per contact)", ylabel="largest error (of full scale)", title="beam")
    left.legend(fontsize=8)
    right.plot(
        [r["ms per second"] for r in rates], [r["rms error over noise"] for r in rates], "o-"
    )
    for row in rates:
        at = row["ms per second"], row["rms error over noise"]
        right.annotate(f"{row['rate Hz'] / 1000:g} kHz", at, fontsize=7)
    right.set(
        xlabel="time (ms per simulated second)",
        ylabel="rms error (of the sensors' noise)",
        title="integration",
    )
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.grid(alpha=0.3)
    return made
