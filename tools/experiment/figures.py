"""The paper's figures 2 to 7, drawn from our runs, and two of our own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from vibrissa.rig.maze import Maze
from vibrissa.rig.scene import wall_boxes
from vibrissa.tools.experiment.analysis import EM_SETS, PRINTED_EM, Row, values
from vibrissa.tools.experiment.design import (
    CONTACT_ANGLE,
    CONTROLLERS,
    MAX_ANGLE,
    NOISE,
    PAPER,
    UNGATED,
    Scale,
)
from vibrissa.tools.experiment.scores import Trace, first_seen
from vibrissa.tools.experiment.statistics import summarise

Floats = NDArray[np.float64]

NAMES: Final = {
    "open_loop": "open loop",
    "rcp": "RCP",
    "max_angle_gated": "max angle",
    "max_angle_ungated": "max angle, ungated",
    "contact_angle": "contact angle",
}
COLOURS: Final = {"open_loop": "#4878a8", "rcp": "#d1603d"}
CLOCKWISE, ANTICLOCKWISE = "#c0392b", "#2e8b57"


def aligned(estimate: Floats, truth: Floats) -> Floats:
    """The estimate's positions moved and turned onto the truth's, least squares, float64[n, 2]."""
    a, b = estimate[:, :2] - estimate[:, :2].mean(0), truth[:, :2] - truth[:, :2].mean(0)
    cross = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    turn = math.atan2(cross, float((a * b).sum()))
    c, s = math.cos(turn), math.sin(turn)
    moved: Floats = a @ np.array([[c, s], [-s, c]]) + truth[:, :2].mean(0)
    return moved


def mean_of(found: Sequence[float]) -> float:
    """Mean of the numbers among them; NaN without any."""
    return summarise(found).mean


def draw_walls(ax: Axes, maze: Maze) -> None:
    """The maze from above."""
    for x0, x1, y0, y1, _ in wall_boxes(maze):
        ax.fill([x0, x1, x1, x0], [y0, y0, y1, y1], color="0.75", lw=0)
    ax.set_aspect("equal")
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")


def figure2(trace: Trace, maze: Maze) -> Figure:
    """True path and the path of the integrated odometry, first three circuits."""
    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    ax = figure.add_subplot()
    draw_walls(ax, maze)
    start = trace.truth[0]
    c, s = math.cos(start[2]), math.sin(start[2])
    reckoned = trace.reckoned[:, :2] @ np.array([[c, s], [-s, c]]) + start[:2]
    for circuit in range(min(3, int(trace.circuit.max()) + 1)):
        rows = trace.circuit == circuit
        depth = (circuit + 1.5) / 4.5
        step = slice(None, None, 4)
        ax.plot(*trace.truth[rows][step, :2].T, "o", ms=3, color="tab:blue", alpha=depth)
        ax.plot(*reckoned[rows][step].T, "s", ms=3, color="tab:red", alpha=depth)
    ax.plot(*start[:2], "o", ms=14, mfc="none", mec="k", mew=1.5)
    handles = [
        Line2D([], [], marker="o", ls="", color="tab:blue", label="actual path"),
        Line2D([], [], marker="s", ls="", color="tab:red", label="integrated odometry"),
    ]
    ax.legend(handles=handles, loc="center", fontsize=8, framealpha=0.95)
    ax.set_title("Figure 2: three clockwise circuits, darker with time", loc="left", fontsize=10)
    return figure


def figure3(trace: Trace) -> Figure:
    """Which experience the agent is in, step by step."""
    figure = Figure(figsize=(7.5, 3.6), layout="constrained")
    ax = figure.add_subplot()
    steps = np.arange(len(trace.experience))
    made = first_seen(trace.experience)[trace.experience]
    away = np.hypot(*(trace.truth[:, :2] - trace.truth[made, :2]).T)
    turned = np.abs((trace.truth[:, 2] - trace.truth[made, 2] + np.pi) % (2 * np.pi) - np.pi)
    right = (away < 0.1) & (turned < math.radians(25.0))
    back = trace.circuit[made] < trace.circuit
    ax.plot(steps, trace.experience, ".", ms=2, color="0.6", label="experience")
    for rows, colour, name in (
        (back & right, "tab:green", "return to an earlier circuit, right"),
        (back & ~right, "tab:red", "wrong"),
    ):
        ax.plot(steps[rows], trace.experience[rows], ".", ms=3, color=colour, label=name)
    ax.axvline(int((trace.circuit == 0).sum()), color="tab:red", ls="--", lw=1)
    for circuit in range(1, int(trace.circuit.max()) + 1):
        ax.axvline(int((trace.circuit < circuit).sum()), color="0.85", lw=0.7, zorder=0)
    ax.set_xlabel("whisk (grey: circuits; dashed: end of the base set)")
    ax.set_ylabel("experience id")
    ax.legend(fontsize=8, loc="upper left", markerscale=3)
    ax.set_title("Figure 3: experiences, RCP, contact angle", loc="left", fontsize=10)
    return figure


def figure4(rows: list[Row]) -> Figure:
    """ARR, ARCR and EM of manipulated runs."""
    figure = Figure(figsize=(9, 5.2), layout="constrained")
    behaviours = list(dict.fromkeys(row["behaviour"] for row in rows))
    scores = (("arr", "ARR"), ("arcr", "ARCR"), (f"{PRINTED_EM}", "EM, by experience, 20 apart"))
    axes = figure.subplots(2, len(scores), squeeze=False)
    for line, image in zip(axes, (MAX_ANGLE, CONTACT_ANGLE), strict=True):
        for ax, (score, name) in zip(line, scores, strict=True):
            for x, behaviour in enumerate(behaviours):
                (row,) = (r for r in rows if (r["image"], r["behaviour"]) == (image, behaviour))
                found = row[score]
                error = [[found["mean"] - found["low"]], [found["high"] - found["mean"]]]
                colour = "0.55" if behaviour == "plain" else "#8e6bb0"
                ax.bar(x, found["mean"], color=colour, yerr=np.abs(error), capsize=3)
            ax.set_xticks(range(len(behaviours)), behaviours, rotation=20, fontsize=7, ha="right")
            ax.set_title(f"{name}, {NAMES[image]}", fontsize=8, loc="left")
    figure.suptitle("Figure 4: manipulated data sets, RCP (bars: bootstrap intervals)", fontsize=10)
    return figure


def figure5(before: Trace, after: Trace, scale: Scale, maze: Maze) -> Figure:
    """Estimated trajectories by direction, before and after the alternating circuits."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    panels = (("before the alternating circuits", before), ("after them", after))
    for ax, (name, trace) in zip(figure.subplots(1, 2), panels, strict=True):
        draw_walls(ax, maze)
        path = aligned(trace.map_poses[trace.experience], trace.truth)
        for circuit in range(int(trace.circuit.max()) + 1):
            rows = trace.circuit == circuit
            colour = CLOCKWISE if scale.sequence[circuit] == "C" else ANTICLOCKWISE
            ax.plot(*path[rows].T, color=colour, lw=1, alpha=0.7)
        ax.set_title(name, fontsize=9, loc="left")
    handles = [Line2D([], [], color=c) for c in (CLOCKWISE, ANTICLOCKWISE)]
    figure.legend(handles, ["clockwise", "anticlockwise"], fontsize=8, loc="outside lower center",
                  ncols=2)  # fmt: skip
    figure.suptitle("Figure 5: trajectory in the map, open loop, max angle", fontsize=10)
    return figure


def figure67(rows: list[Row], image: str, number: int) -> Figure:
    """Open loop against RCP: ARR, ARCR, EM, every seed, the blind control, the paper's numbers."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    scores = (("arr", "ARR", "arr"), ("arcr", "ARCR", ""), (PRINTED_EM, "EM", "em"))
    for ax, (score, name, printed) in zip(figure.subplots(1, 3), scores, strict=True):
        both = []
        for x, controller in enumerate(CONTROLLERS):
            labels = {"noise": NOISE, "controller": controller, "image": image}
            found = values(rows, score, control="none", **labels)
            both.append(found)
            ax.bar(x, mean_of(found), color=COLOURS[controller], alpha=0.6, width=0.6)
            for control, mark in (("blind", "_"), ("shuffled", "x")):
                other = values(rows, score, control=control, **labels)
                ax.plot(x + 0.22, mean_of(other), mark, color="k", ms=9)
            if score.startswith("em"):
                odometry = values(rows, "odo" + score[2:], control="none", **labels)
                ax.plot(x - 0.22, mean_of(odometry), "_", color="tab:green", ms=14, mew=2)
            paper = PAPER.get((controller, image), {}).get(printed)
            if paper is not None:
                ax.plot([x - 0.36, x + 0.36], [paper, paper], "--", color="0.2", lw=1.2)
        ax.plot([0, 1], np.array(both), "o-", color="0.3", ms=3, lw=0.6)
        ax.set_xticks([0, 1], [NAMES[c] for c in CONTROLLERS])
        ax.set_title(name, fontsize=9, loc="left")
        ax.set_ylim(bottom=0)
    handles = [
        Line2D([], [], marker="o", color="0.3", ms=3, lw=0.6, label="one seed"),
        Line2D([], [], ls="--", color="0.2", lw=1.2, label="the paper"),
        Line2D([], [], marker="_", ls="", color="k", ms=9, label="blind"),
        Line2D([], [], marker="x", ls="", color="k", ms=7, label="shuffled"),
        Line2D([], [], marker="_", ls="", color="tab:green", ms=14, mew=2, label="odometry's own"),
    ]
    figure.legend(handles=handles, fontsize=8, ncols=5, loc="outside lower center", frameon=False)
    figure.suptitle(f"Figure {number}: {NAMES[image]} (EM by experience, 20 apart)", fontsize=10)
    return figure


def odometry_figure(rows: list[Row]) -> Figure:
    """EM of the map over that of its odometry, every condition and relation set."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    noises = list(dict.fromkeys(row["noise"] for row in rows))
    for ax, noise in zip(figure.subplots(1, len(noises), sharey=True, squeeze=False)[0], noises,
                         strict=True):  # fmt: skip
        for row in rows:
            if row["noise"] != noise or row["control"] == "shuffled" or row["image"] == UNGATED:
                continue
            blind = row["control"] == "blind"
            ratios = [row["ratios"].get(name, {}).get("ratio", math.nan) for name in EM_SETS]
            style = {"color": "k", "marker": "x", "ls": ":"} if blind else {
                "color": COLOURS[row["controller"]],
                "marker": "s" if row["image"] == CONTACT_ANGLE else "o",
                "ls": "-",
            }  # fmt: skip
            ax.plot(range(len(ratios)), ratios, ms=4, lw=0.8, alpha=0.8, **style)
        ax.axhline(1.0, color="tab:green", lw=1)
        ax.set_yscale("log")
        names = [name.replace("_", " ") for name in EM_SETS]
        ax.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=6)
        ax.set_title(f"odometry noise {noise}", fontsize=9, loc="left")
        ax.set_ylabel("EM of the map / EM of its odometry" if noise == noises[0] else "")
    handles = [
        Line2D([], [], color=COLOURS[c], marker=m, ms=4, label=f"{NAMES[c]}, {NAMES[i]}")
        for c in CONTROLLERS
        for i, m in ((MAX_ANGLE, "o"), (CONTACT_ANGLE, "s"))
    ]
    handles.append(Line2D([], [], color="k", marker="x", ls=":", ms=4, label="blind"))
    figure.legend(handles=handles, fontsize=7, ncols=5, loc="outside lower center", frameon=False)
    return figure


def sensitivity_figure(rows: list[Row]) -> Figure:
    """Image quality and impingement of every variant."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    names = list(dict.fromkeys((row["what"], row["value"]) for row in rows))
    panels: tuple[tuple[str, str, tuple[str, ...]], ...] = (
        ("auc", "place recognition (AUC)", ("max_angle_ungated", MAX_ANGLE, CONTACT_ANGLE)),
        ("impingement_deg", "impingement (deg)", (MAX_ANGLE,)),
        ("slips", "slips per whisk", (MAX_ANGLE,)),
        ("arr", "ARR", (MAX_ANGLE, CONTACT_ANGLE)),
    )
    marks: dict[str, Any] = {"max_angle_ungated": "^", MAX_ANGLE: "o", CONTACT_ANGLE: "s"}
    axes = figure.subplots(1, len(panels), sharey=True)
    for ax, (score, title, images) in zip(axes, panels, strict=True):
        for row in rows:
            if row["image"] not in images:
                continue
            y = names.index((row["what"], row["value"]))
            shift = -0.15 if row["controller"] == "open_loop" else 0.15
            colour = COLOURS["open_loop" if row["controller"] == "open_loop" else "rcp"]
            ax.plot(row[score], y + shift, marks[row["image"]], color=colour, ms=4, alpha=0.8)
        ax.set_title(title, fontsize=8, loc="left")
        ax.grid(axis="y", alpha=0.25)
    labels = [f"{what}  {value}".strip() for what, value in names]
    axes[0].set_yticks(range(len(names)), labels, fontsize=7)
    axes[0].invert_yaxis()
    handles = [
        Line2D([], [], ls="", marker=marks[i], color="0.3", ms=4, label=NAMES[i]) for i in marks
    ]
    handles += [
        Line2D([], [], ls="", marker="o", color=COLOURS[c], ms=4, label=NAMES[c])
        for c in CONTROLLERS
    ]
    figure.legend(handles=handles, fontsize=7, ncols=5, loc="outside lower center", frameon=False)
    return figure
