"""Figures of a mapping run as the paper draws them, from its log.

odometry: the true path and the integrated odometry, circuit by circuit. experiences: the number of
the current experience over time, with the base set and what became of every re-localisation. map:
the corrected map, clockwise and anticlockwise circuits in their colours, for the first circuits in
both directions and for the whole run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from vibrissa.rig.maze import parse_maze
from vibrissa.slam.circuits import circuit_numbers, directions
from vibrissa.slam.metrics import experience_metric, first_circuit, relocalisations
from vibrissa.slam.tuning import dead_reckoning
from vibrissa.tools.picture import place, walls

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from vibrissa.tools.dataset import Dataset

Floats = NDArray[np.float64]

CIRCUITS_DRAWN: Final = 3
"""Circuits of integrated odometry in the first figure; later ones only hide the earlier."""
CLOCKWISE: Final = "tab:red"
ANTICLOCKWISE: Final = "tab:green"
WRONG: Final = "tab:red"
RIGHT: Final = "tab:green"


def draw_odometry(data: Dataset) -> Figure:
    """Truth and odometry of the first circuits, darker with each; a circle where one begins."""
    circuit = circuit_numbers(data.truth)
    reckoned = dead_reckoning(data.odometry[1:], data.truth[0])
    reckoned = np.vstack([data.truth[:1], reckoned])
    drawn = min(CIRCUITS_DRAWN, int(circuit.max()) + 1)
    figure = Figure(figsize=(7, 5.6), layout="constrained")
    ax = figure.subplots()
    _draw_walls(ax, data)
    for number in range(drawn):
        rows = circuit == number
        shade = 0.35 + 0.6 * (number + 1) / drawn
        for path, colour, style in (
            (data.truth, (0.1, 0.45, 0.1), "o-"),
            (reckoned, (0.85, 0.35, 0.0), "s-"),
        ):
            faded = tuple(1.0 - shade * (1.0 - c) for c in colour)
            ax.plot(path[rows, 0], path[rows, 1], style, ms=2, lw=0.8, color=faded)
            ax.plot(*path[rows, :2][0], "o", ms=11, mfc="none", mew=1.5, color=faded)
    last = circuit < drawn
    error = np.hypot(*(reckoned - data.truth)[last, :2].T)
    ax.set_title(
        f"odometry against truth, {drawn} circuits: {error.mean() * 1e3:.0f} mm off on average,"
        f" {error.max() * 1e3:.0f} mm at most",
        loc="left",
        fontsize=10,
    )
    handles = [
        Line2D([], [], color=(0.1, 0.45, 0.1), marker="o", ms=4, label="true path"),
        Line2D([], [], color=(0.85, 0.35, 0.0), marker="s", ms=4, label="integrated odometry"),
        Line2D([], [], color="0.4", marker="o", ms=9, mfc="none", ls="", label="circuit begins"),
    ]
    _finish_plan(ax, handles)
    return figure


def draw_experiences(data: Dataset) -> Figure:
    """Experience number over whisk cycles, base set, and correct and incorrect re-localisations."""
    base = first_circuit(data.truth)
    verdicts = relocalisations(data.experience, data.truth, base)
    whisk = np.arange(len(data))
    figure = Figure(figsize=(10, 5), layout="constrained")
    ax = figure.subplots()
    ax.axvspan(0, base, color="0.92")
    ax.axvline(base, color="k", lw=1)
    ax.plot(whisk, data.experience, color="0.65", lw=0.7, zorder=1)
    for value, size, colour, name in (
        (0, 3, "tab:blue", "novel, or stays in a novel one"),
        (1, 3, RIGHT, "correct re-localisation"),
        (-1, 7, WRONG, "incorrect re-localisation"),
    ):
        rows = verdicts == value
        label = f"{name} ({rows.sum()})"
        ax.plot(whisk[rows], data.experience[rows], ".", ms=size, color=colour, label=label)
    for start in np.flatnonzero(np.diff(circuit_numbers(data.truth))) + 1:
        ax.axvline(float(start), color="0.5", lw=0.6, ls=":")
    metric = experience_metric(data.experience, data.truth, base)
    told = ", ".join(
        f"{name} {'not defined' if value is None else format(value, '.3f')}"
        for name, value in (("ARR", metric.arr), ("ARCR", metric.arcr))
    )
    ax.set_title(f"experiences: {told} (reading '{metric.variant}')", loc="left", fontsize=10)
    ax.set_xlim(0, len(data))
    ax.set_xlabel("whisk cycle; grey: base set, dotted: circuits")
    ax.set_ylabel("experience")
    ax.legend(fontsize=8, markerscale=2, loc="upper left")
    return figure


def draw_map(data: Dataset) -> Figure:
    """The map on the maze, with experiences by the sense of the circuit that made them."""
    circuit = circuit_numbers(data.truth)
    senses = directions(data.truth, circuit)
    figure = Figure(figsize=(11, 6), layout="constrained")
    before, after = figure.subplots(1, 2, sharex=True, sharey=True)
    # left: the trajectory as it was estimated up to the end of the first circuit in the other sense
    other = np.flatnonzero(senses == -senses[0])
    upto = int(other[0]) if len(other) else 0
    shown = circuit <= upto
    estimate = place(data.estimate, data.estimate[0], data.truth[0])
    _draw_walls(before, data)
    for number in range(upto + 1):
        rows = shown & (circuit == number)
        before.plot(estimate[rows, 0], estimate[rows, 1], lw=0.9, color=_colour(senses[number]))
    before.set_title(
        f"estimated path of circuits 1 to {upto + 1} as it went", loc="left", fontsize=10
    )
    _draw_walls(after, data)
    if data.map is not None and len(data.map.poses):
        made = np.array(
            [np.argmax(data.experience == e) for e in range(len(data.map.poses))], dtype=np.int64
        )
        poses = aligned(data.map.poses, data.truth[made])
        sense = senses[circuit[made]]
        links = data.map.links
        colours = [_colour(sense[b]) for _, b in links]
        after.add_collection(
            LineCollection(list(poses[links][:, :, :2]), colors=colours, linewidths=0.7)
        )
        for value in (-1, 1):
            rows = sense == value
            after.plot(poses[rows, 0], poses[rows, 1], ".", ms=3, color=_colour(value))
        error = np.hypot(*(poses - data.truth[made])[:, :2].T)
        after.set_title(
            f"map after {int(circuit.max()) + 1} circuits: {len(poses)} experiences,"
            f" {error.mean() * 1e3:.0f} mm off",
            loc="left",
            fontsize=10,
        )
    else:
        after.set_title("no map in this log", loc="left", fontsize=10)
    handles = [
        Line2D([], [], color=CLOCKWISE, label="clockwise"),
        Line2D([], [], color=ANTICLOCKWISE, label="anticlockwise"),
    ]
    for ax in (before, after):
        _finish_plan(ax, handles)
    return figure


def aligned(poses: Floats, truth: Floats) -> Floats:
    """poses float64[n, 3] moved rigidly onto truth float64[n, 3], least squares of positions."""
    centre, target = poses[:, :2].mean(axis=0), truth[:, :2].mean(axis=0)
    a, b = poses[:, :2] - centre, truth[:, :2] - target
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    here = np.array([*centre, 0.0])
    return place(poses, here, np.array([*target, turn]))


def _colour(sense: int) -> str:
    return {1: ANTICLOCKWISE, -1: CLOCKWISE}.get(int(sense), "tab:gray")


def _draw_walls(ax: Axes, data: Dataset) -> None:
    maze = parse_maze(data.experiment.maze.text, data.experiment.maze.file)
    ax.add_collection(LineCollection(walls(maze), colors="0.8", linewidths=3, zorder=0))


def _finish_plan(ax: Axes, handles: list[Line2D]) -> None:
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")
    ax.legend(handles=handles, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3)


FIGURES: Final = {
    "odometry": draw_odometry,
    "experiences": draw_experiences,
    "map": draw_map,
}
"""name of the picture -> how it is drawn."""
