"""`vibrissa bench slam`: RatSLAM's speed, its growth, and its approximations against their error.

One process on one core. Peers: the plain NumPy formulas (`plain_ratslam.py`) in the same call, and
the figures of OpenRatSLAM (C++, -O2), which are quoted.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from vibrissa.processes.results import OnProgress, Progress
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.slam_accuracy import (
    grid_rows,
    precision_rows,
    pruning_rows,
    relaxation_front,
    truncation_rows,
)
from vibrissa.tools.slam_speed import (
    FULL,
    OPENRATSLAM_LINK_NS,
    QUICK,
    exponent,
    memory_rows,
    pose_cell_rows,
    relaxation_rows,
    template_rows,
)

Row = dict[str, Any]
Rows = Sequence[Row]


def bench(_out: Path, _duration: float, on_progress: OnProgress, *, quick: bool = False) -> Bench:
    """Measure everything; quick: at sizes that only show that the bench works."""
    sizes = QUICK if quick else FULL
    path = 200 if quick else 3000
    parts: dict[str, Callable[[], Any]] = {
        "pose cells": lambda: pose_cell_rows(sizes),
        "templates": lambda: template_rows(sizes),
        "relaxation": lambda: relaxation_rows(sizes),
        "memory": lambda: memory_rows(300 if quick else 20_000),
        "grid": lambda: grid_rows(path),
        "precision": lambda: [] if quick else precision_rows(path),
        "truncation": lambda: truncation_rows(path),
        "front": lambda: relaxation_front(60 if quick else 1000),
        "pruning": lambda: pruning_rows(sizes),
    }
    found: dict[str, Any] = {}
    with one_core():
        for number, (name, measure) in enumerate(parts.items()):
            on_progress(Progress("measuring", number, len(parts), name))
            found[name] = measure()
    speeds, growth = found["templates"]
    fits = growth_rows(growth, found["relaxation"])
    rows = [
        *found["pose cells"],
        *speeds,
        *growth,
        *found["relaxation"],
        *fits,
        *found["memory"],
        *found["grid"],
        *found["precision"],
        *found["truncation"],
        *found["front"],
        *found["pruning"],
    ]
    return Bench(
        "slam",
        rows,
        targets([*found["pose cells"], *speeds], found["relaxation"], found["pruning"]),
        figure(growth, found["relaxation"], found),
    )


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """This process on the last of its cores."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def growth_rows(templates: Rows, relaxation: Rows) -> list[Row]:
    """Fitted exponents of time over size: 0 = constant, 1 = linear."""
    rows = []
    for means in ("spread", "equal"):
        line = [row for row in templates if row["means"] == means]
        sizes = [row["templates"] for row in line]
        for kind in ("unseen", "seen"):
            times = [row[f"{kind} us"] for row in line]
            what = f"search, {means} means, {kind} image"
            rows.append(
                {"growth of": what, "with": "templates", "exponent": exponent(sizes, times)}
            )
    sizes = [row["experiences"] for row in relaxation]
    times = [row["20 sweeps us"] for row in relaxation]
    rows.append(
        {
            "growth of": "20 relaxation sweeps",
            "with": "experiences",
            "exponent": exponent(sizes, times),
        }
    )
    return rows


def targets(speeds: Rows, relaxation: Rows, pruning: Rows) -> list[Target]:
    """What was aimed at; sizes that were not measured are not there."""
    us = {row["what"]: row["us"] for row in speeds}
    aims = (
        ("pose cells 11x11x36", 40.0),
        ("pose cells 11x11x36", 15.0),
        ("18 pixels, 10000 templates, spread", 15.0),
        ("18 pixels, 10000 templates, equal", 15.0),
        ("18 pixels, 100000 templates, spread", 100.0),
        ("18 pixels, 100000 templates, equal", 100.0),
    )
    made = [Target(name, us[name], "us", "<=", aim) for name, aim in aims if name in us]
    made += [
        Target(
            "relaxation of 5,000 experiences, a link visit",
            row["ns per link visit"],
            "ns",
            "<=",
            OPENRATSLAM_LINK_NS,
        )
        for row in relaxation
        if row["experiences"] == 5000
    ]
    wrong = sum(row["different ids or errors"] for row in pruning)
    return [*made, Target("template search: ids or errors that differ", wrong, "", "==", 0)]


def figure(growth: Rows, relaxation: Rows, found: dict[str, Any]) -> Figure:
    """Growth in the upper row, run time against error in the lower."""
    made = Figure(figsize=(13, 7.5), layout="constrained")
    axes = made.subplots(2, 3)
    ax = axes[0, 0]
    for means, colour in (("spread", "tab:blue"), ("equal", "tab:red")):
        line = [row for row in growth if row["means"] == means]
        sizes = [row["templates"] for row in line]
        for kind, style in (("unseen", "o-"), ("seen", "o--")):
            times = [row[f"{kind} us"] for row in line]
            power = exponent(sizes, times)
            label = f"{means} means, {kind}: n^{power:.2f}"
            ax.plot(sizes, times, style, color=colour, label=label)
    _log(ax, "templates of 18 pixels", "search (us)", "template search")
    ax = axes[0, 1]
    sizes = [row["experiences"] for row in relaxation]
    times = [row["20 sweeps us"] for row in relaxation]
    ax.plot(sizes, times, "o-", label=f"20 sweeps: n^{exponent(sizes, times):.2f}")
    exact = [row["exact optimum ms"] * 1e3 for row in relaxation]
    ax.plot(sizes, exact, "s-", label="exact optimum (once)")
    _log(ax, "experiences", "time (us)", "map relaxation")
    ax = axes[0, 2]
    rows = [row for row in found["front"] if row["relaxation"] != "exact"]
    ax.plot([r["us"] for r in rows], [r["rms distance mm"] for r in rows], "o-")
    for r in rows:
        at = r["us"], r["rms distance mm"]
        ax.annotate(
            r["relaxation"].split()[0], at, fontsize=7, xytext=(3, 3), textcoords="offset points"
        )
    exact_us = next(r["us"] for r in found["front"] if r["relaxation"] == "exact")
    ax.axvline(exact_us, color="k", ls="--", lw=0.8, label="exact optimum")
    _log(ax, "time (us)", "distance to the optimum (mm)", "relaxation sweeps (numbers)")
    for ax, name, labels, title in (
        (axes[1, 0], "grid", "grid", "pose-cell grid, same torus"),
        (axes[1, 1], "truncation", "pc_global_inhib", "packet truncation (pc_global_inhib)"),
    ):
        rows = found[name]
        ax.plot([r["us"] for r in rows], [r["error mm"] for r in rows], "o-")
        for r in rows:
            told = r[labels] if isinstance(r[labels], str) else f"{r[labels]:g}"
            at = r["us"], r["error mm"]
            ax.annotate(told, at, fontsize=7, xytext=(3, 3), textcoords="offset points")
        ax.set_xlabel("time (us per step)")
        ax.set_ylabel("error (mm per 100 mm)")
        ax.set_title(title, loc="left", fontsize=10)
        ax.grid(alpha=0.3)
    for r in found["precision"]:
        axes[1, 2].plot(r["us"], r["error mm"], "o", label=f"{r['precision']} precision")
    axes[1, 2].set_xlabel("time (us per step)")
    axes[1, 2].set_ylabel("largest distance to double (mm)")
    axes[1, 2].set_title("precision of the pose cells", loc="left", fontsize=10)
    axes[1, 2].grid(alpha=0.3)
    if found["precision"]:
        axes[1, 2].legend(fontsize=8)
    return made


def _log(ax: Any, x: str, y: str, title: str) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.set_title(title, loc="left", fontsize=10)
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
