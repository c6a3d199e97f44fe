"""`vibrissa experiment slam` from start to report: run what the cache lacks, tabulate, write."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vibrissa.numerics import cos, sin
from vibrissa.tools.console import note, write_json
from vibrissa.tools.experiment.mapping import noisy
from vibrissa.tools.experiment.report import STYLE, grid, number, picture
from vibrissa.tools.experiment.scores import RELATIONS, dead_reckoning
from vibrissa.tools.experiment.slam_markdown import markdown
from vibrissa.tools.experiment.slam_runs import (
    NOISES,
    ROWS,
    SlamWork,
    is_done,
    odometer,
    run_work,
    sequence_map,
    works,
)
from vibrissa.tools.experiment.statistics import geometric_mean, summarise
from vibrissa.tools.experiment.tasks import recorded, rig_key
from vibrissa.tools.machine import machine

WON: Final = 0.999
"""Ratio below which a run is won; dead reckoning itself is at 1 up to rounding."""
TICKS: Final = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
SHOWN: Final = ("sequence, batch", "sequence, lag 100", "sequence, past only")


def run_slam(
    seeds: int, quick: bool, groups: Sequence[str], jobs: int, out: Path
) -> dict[str, Any]:
    """Run what the cache lacks, write results.json, report.md and report.html into `out`."""
    folder = out / "cache"
    folder.mkdir(parents=True, exist_ok=True)
    wanted = works(seeds, quick, groups)
    run_all(folder, wanted, jobs)
    runs = [row for work in wanted for row in run_work(folder, work)]
    table = tabulate(runs)
    results = {"table": table, "runs": runs, "machine": machine(), "seeds": seeds}
    write_json(out / "results.json", results)
    drawn = [front(table), *(maps(folder, work) for work in wanted[: len(NOISES)])]
    (out / "report.md").write_text(markdown(table))
    (out / "report.html").write_text(page(results, drawn))
    return results


def run_all(folder: Path, wanted: Sequence[SlamWork], jobs: int) -> None:
    """Do what is not in the cache, a data set at a time, over `jobs` processes.

    What was finished before an interrupt is kept.
    """
    sets: dict[str, list[SlamWork]] = {}
    for work in wanted:
        if not is_done(folder, work):
            sets.setdefault(rig_key(work.rig), []).append(work)
    note(f"{len(sets)} data sets to go")
    if jobs == 1:
        for k, works_ in enumerate(sets.values()):
            _do(folder, works_)
            note(f"data set {k + 1} of {len(sets)}: {works_[0].group}")
        return
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(jobs, context, initializer=_prepare) as pool:
        try:
            doing = {pool.submit(_do, folder, works_): works_ for works_ in sets.values()}
            for k, done in enumerate(as_completed(doing)):
                done.result()
                note(f"data set {k + 1} of {len(sets)}: {doing[done][0].group}")
        except BaseException:
            for child in set(multiprocessing.active_children()) - others:
                child.terminate()  # what it was writing never appears in the cache
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _prepare() -> None:
    os.nice(5)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers


def _do(folder: Path, works_: Sequence[SlamWork]) -> None:
    for work in works_:
        run_work(folder, work)


def tabulate(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per group, row and noise: geometric mean, interval of it, worst run and wins by relations."""
    found = []
    groups = list(dict.fromkeys(run["group"] for run in runs))
    for group in groups:
        for row in ROWS:
            for noise in NOISES:
                chosen = [
                    run
                    for run in runs
                    if (run["group"], run["row"], run["noise"]) == (group, row.name, noise)
                ]
                if not chosen:
                    continue
                cell: dict[str, Any] = {"group": group, "row": row.name, "noise": noise}
                cell["n"] = len(chosen)
                cell["ended"] = sum(bool(run["ended"]) for run in chosen)
                cell["loops"] = float(np.mean([run["loops"] for run in chosen]))
                right = [run["right"] for run in chosen if run["right"] is not None]
                cell["right"] = float(np.mean(right)) if right else None
                for relations in RELATIONS:
                    ratios = [run[relations] for run in chosen if run[relations] is not None]
                    if not ratios:
                        ratios = [math.nan]
                    logs = summarise(np.log(ratios))
                    cell[relations] = {
                        "ratio": geometric_mean(ratios),
                        "low": float(np.exp(logs.low)),
                        "high": float(np.exp(logs.high)),
                        "worst": max(ratios),
                        "wins": sum(ratio < WON for ratio in ratios),
                    }
                found.append(cell)
    return found


def front(table: Sequence[dict[str, Any]]) -> Figure:
    """Ratios of the plain data sets by row, one panel per relation set."""
    figure = Figure(figsize=(11.0, 3.6), layout="constrained")
    names = [row.name for row in ROWS]
    for k, relations in enumerate(RELATIONS):
        ax = figure.add_subplot(1, len(RELATIONS), k + 1)
        for shift, noise in enumerate(NOISES):
            cells = [c for c in table if c["group"] == "plain" and c["noise"] == noise]
            values = [c[relations] for c in cells]
            middle = np.array([v["ratio"] for v in values])
            span = np.abs(np.array([[v["low"], v["high"]] for v in values]).T - middle)
            at = np.array([names.index(c["row"]) for c in cells]) + 0.2 * (shift - 1)
            ax.errorbar(middle, at, xerr=span, fmt="o", ms=3, lw=1, label=noise)
        ax.axvline(1.0, color="0.6", lw=0.8)
        ax.set_xscale("log")
        ax.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
        ax.minorticks_off()
        ax.set_title(relations)
        ax.set_yticks(range(len(names)), names if k == 0 else [""] * len(names), fontsize=7)
        ax.invert_yaxis()
        ax.set_xlabel("EM over odometry's")
    figure.axes[0].legend(fontsize=7)
    return figure


def maps(folder: Path, work: SlamWork) -> Figure:
    """The truth, dead reckoning, and the sequence SLAM's final map of a data set."""
    recording = recorded(folder, work.rig)
    motion = noisy(recording, work.noise, work.rig.seed)
    noise = odometer(work.noise, work.rig.seed)
    ways = {"dead reckoning": dead_reckoning(motion)}
    for row in ROWS:
        if row.name in SHOWN[:2]:
            ways[row.name] = sequence_map(recording, motion, row, noise, work.rig.seed)[0]
    figure = Figure(figsize=(11.0, 3.4), layout="constrained")
    for k, (name, poses) in enumerate(ways.items()):
        ax = figure.add_subplot(1, len(ways), k + 1)
        for what, shown in (("truth", recording.truth), (name, poses)):
            x, y = from_first(shown).T
            ax.plot(x, y, lw=0.6, label=what)
        ax.set_aspect("equal", "datalim")
        ax.set_title(f"{name}, {work.noise}", fontsize=9)
        ax.set_xlabel("m")
    return figure


def from_first(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places float64[n, 2] as seen from pose 0 of poses float64[n, 3]."""
    x, y, heading = poses[0]
    c, s = float(cos(heading)), float(sin(heading))
    ahead, left = poses[:, 0] - x, poses[:, 1] - y
    return np.stack([c * ahead + s * left, c * left - s * ahead], axis=1)


def page(results: dict[str, Any], figures: Sequence[Figure]) -> str:
    """The report, one HTML file."""
    table = results["table"]
    parts = [picture(figure) for figure in figures]
    for group in dict.fromkeys(cell["group"] for cell in table):
        rows = []
        for cell in (c for c in table if c["group"] == group):
            row = [cell["row"], cell["noise"]]
            for relations in RELATIONS:
                value = cell[relations]
                row.append(
                    f"{number(value['ratio'])} [{number(value['low'])}, {number(value['high'])}]"
                )
                row += [number(value["worst"]), f"{value['wins']} / {cell['n']}"]
            rows.append([*row, number(cell["loops"]), number(cell["right"]), str(cell["ended"])])
        head = ["row", "noise"]
        for relations in RELATIONS:
            head += [relations, "worst", "wins"]
        parts.append(f"<h2>{group}</h2>" + grid([*head, "loops", "right", "ended early"], rows, 2))
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><title>vibrissa: SLAM by touch</title>"
        f"<style>{STYLE}</style><h1>SLAM by touch against its own odometry</h1><p>Energy Metric of "
        "the whisks in the final map over that of dead reckoning by the same odometry: geometric "
        "mean, bootstrap interval over runs, worst run, runs won. Maze draws differ by run. "
        "Ended early: the SLAM gave up, and the run "
        "counts as not won. Blind: all images zero; shuffled: whole whisks in random order.</p>"
        f"{''.join(parts)}</html>\n"
    )
