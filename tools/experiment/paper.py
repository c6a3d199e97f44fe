"""The paper's experiment from start to report: tune, run what the cache lacks, analyse, write."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from vibrissa.rig.maze import parse_maze
from vibrissa.tools.console import note, stderr, write_json
from vibrissa.tools.experiment import figures
from vibrissa.tools.experiment.analysis import Row, analyse, tune
from vibrissa.tools.experiment.design import (
    CONTACT_ANGLE,
    MAX_ANGLE,
    NOISE,
    Point,
    Scale,
    before_alternation,
    main_rig,
    maze_text,
    result_works,
    tuning_works,
)
from vibrissa.tools.experiment.mapping import MapCase, run_map
from vibrissa.tools.experiment.recording import IMAGES, RigCase, duration, record
from vibrissa.tools.experiment.report import page
from vibrissa.tools.experiment.scores import scores
from vibrissa.tools.experiment.tasks import cost, missing, quality, run_all, trace_of
from vibrissa.tools.machine import machine

OnCost = Callable[[float], None]


def run_paper(wanted: Scale, jobs: int, out: Path) -> Row:
    """Run what the cache lacks, analyse, write results.json and report.html; the results."""
    begun = time.monotonic()
    cache = out / "cache"
    cache.mkdir(parents=True, exist_ok=True)
    if jobs > 1:
        note("compiling")
    compile_all()
    tuning = tuning_works(wanted)
    rough = result_works(wanted, {image: Point(0.0, 0.0) for image in IMAGES})
    lengths: dict[RigCase, float] = {}

    def seconds(rig: RigCase) -> float:
        if rig not in lengths:
            lengths[rig] = duration(rig)
        return lengths[rig]

    total = sum(cost(work, seconds(work.rig)) for work in missing(cache, tuning))
    total += sum(cost(work, seconds(work.rig)) for work in missing(cache, rough))
    with _bar(total) as on_cost:
        run_all(cache, tuning, jobs, seconds, on_cost)
        points, grid = tune(cache, wanted)
        works = result_works(wanted, points)
        run_all(cache, works, jobs, seconds, on_cost)
    results = analyse(cache, wanted, points, grid)
    rigs = {work.rig for work in (*tuning, *works)}
    results["timing"] = {
        "wall_s": time.monotonic() - begun,
        "jobs": jobs,
        "robot_s": sum(seconds(rig) for rig in rigs),
        "data_sets": len(rigs),
    }
    results["machine"] = machine()
    write_json(out / "results.json", results)
    write_report(cache, wanted, points, results, out / "report.html")
    return results


def compile_all() -> None:
    """Compile every kernel once, so that the processes find it on disk."""
    tiny = RigCase(maze_text(), 0, "rcp", "CC", speed=0.2, calibration_cycles=1)
    made = record(tiny)
    quality(made)
    scores(run_map(made, MapCase(MAX_ANGLE, 0)))


def write_report(
    cache: Path, wanted: Scale, points: dict[str, Point], results: Row, file: Path
) -> None:
    """Draw the figures from the runs of the first seed and write the page."""
    seed = wanted.seeds[0]
    maze = parse_maze(maze_text(), "experiment")
    open_loop, rcp = (main_rig(wanted, seed, controller) for controller in ("open_loop", "rcp"))
    usual = points[MAX_ANGLE].applied(MapCase(MAX_ANGLE, seed, NOISE))
    touch = points[CONTACT_ANGLE].applied(MapCase(CONTACT_ANGLE, seed, NOISE))
    whole = trace_of(cache, open_loop, usual)
    before = trace_of(cache, open_loop, before_alternation(wanted, seed, points))
    runs: list[dict[str, Any]] = results["runs"]
    drawn = {
        "2": figures.figure2(whole, maze),
        "3": figures.figure3(trace_of(cache, rcp, touch)),
        "4": figures.figure4(results["figure4"]),
        "5": figures.figure5(before, whole, wanted, maze),
        "6": figures.figure67(runs, MAX_ANGLE, 6),
        "7": figures.figure67(runs, CONTACT_ANGLE, 7),
    }
    if results["against_odometry"]:
        drawn["odometry"] = figures.odometry_figure(results["against_odometry"])
    if results["sensitivity"]:
        drawn["sensitivity"] = figures.sensitivity_figure(results["sensitivity"])
    scratch = file.with_suffix(".part")
    scratch.write_text(page(results, drawn))
    scratch.replace(file)


@contextlib.contextmanager
def _bar(total: float) -> Iterator[OnCost]:
    """A bar with the time left; nothing where stderr is no terminal."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = stderr()
    if not console.is_terminal or total <= 0.0:
        yield lambda cost: None
        return
    columns = TextColumn("experiment"), BarColumn(), TextColumn("{task.percentage:.0f} %")
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as bars:
        task = bars.add_task("", total=total)
        yield lambda cost: bars.advance(task, cost)
