"""A picture of a run, drawn from its log alone.

Left: the maze from above with the head's true path, the path by odometry and the experience map.
Below it: how well the clock was kept. Right: whisk cycles of the whisker that touched most, and
the contacts of all whiskers over time.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from vibrissa.control.kinematics import RINGS, whisker_name
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.types import TICK_HZ, TICK_NS, WHISKERS
from vibrissa.processes.rebuild import open_log
from vibrissa.rig.maze import Maze, parse_maze
from vibrissa.tools.story import BIN_TICKS, Story, messages, tell

if TYPE_CHECKING:
    from matplotlib.axes import Axes


Floats = npt.NDArray[np.float64]

CYCLES_SHOWN: Final = 3
RING_COLOURS: Final = ("#c44e52", "#dd8452", "#4c72b0")


def draw(log: Path) -> Figure:
    """The picture of a log. Raises UnusableLogError for what is no log; a cut-off one will do."""
    reader = open_log(log, allow_cut=True)
    story = tell(reader)
    figure = Figure(figsize=(14, 8), layout="constrained")
    grid = figure.add_gridspec(4, 2, width_ratios=(1.1, 1))
    draw_maze(figure.add_subplot(grid[:3, 0]), story)
    draw_timing(figure.add_subplot(grid[3, 0]), story)
    angle = figure.add_subplot(grid[0, 1])
    draw_cycles(angle, figure.add_subplot(grid[1, 1], sharex=angle), story, reader)
    draw_contacts(figure.add_subplot(grid[2:, 1]), story)
    run = story.experiment
    figure.suptitle(
        f"{log.parent.name or log.name}: {run.whisk.controller}, seed {run.run.seed}, "
        f"{reader.metadata.get('mode', '')}"
    )
    return figure


def draw_maze(ax: Axes, story: Story) -> None:
    """Walls, true path, path by odometry, experience map; all in m in the maze frame."""
    maze = parse_maze(story.experiment.maze.text, story.experiment.maze.file)
    ax.add_collection(LineCollection(walls(maze), colors="0.25", linewidths=3))
    if story.truth:
        truth = np.array(story.truth)
        ax.plot(truth[:, 1], truth[:, 2], color="tab:green", lw=1.5, label="head, true path")
        ax.plot(*truth[-1, 1:3], "o", color="tab:green")
    if story.first is not None:
        start = story.first.truth[[0, 1, 3]]
        path = place(integrate(story.odometry), np.zeros(3), start)
        ax.plot(path[:, 0], path[:, 1], color="tab:orange", lw=1, label="odometry")
    if story.first is not None and story.map is not None and len(story.map.poses):
        nodes = place(story.map.poses, story.first.estimate, start)
        links = [nodes[list(pair), :2] for pair in story.map.links]
        ax.add_collection(LineCollection(links, colors="tab:blue", linewidths=0.7))
        ax.plot(nodes[:, 0], nodes[:, 1], ".", ms=4, color="tab:blue", label="experience map")
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=8, frameon=False)
    ax.set_title("the maze from above", loc="left")


def walls(maze: Maze) -> list[Floats]:
    """The walls as line segments float64[2, 2] in m."""
    along = [((i, j), (i + 1, j)) for j, i in np.argwhere(maze.horizontal)]
    across = [((i, j), (i, j + 1)) for j, i in np.argwhere(maze.vertical)]
    return [np.array(segment, np.float64) * maze.pitch for segment in along + across]


def integrate(odometry: Iterable[tuple[float, ...]]) -> Floats:
    """The path float64[n + 1, 3] (x, y, heading) from the origin by steps (v, w, dt)."""
    x = y = heading = 0.0
    path = [(x, y, heading)]
    for v, w, dt in odometry:
        heading += w * dt
        x, y = x + v * dt * np.cos(heading), y + v * dt * np.sin(heading)
        path.append((x, y, heading))
    return np.array(path)


def place(poses: Floats, here: Floats, there: Floats) -> Floats:
    """Poses float64[n, 3] (x, y, heading) moved so that the pose `here` comes to lie on `there`."""
    turn = there[2] - here[2]
    away = poses[:, :2] - here[:2]
    c, s = np.cos(turn), np.sin(turn)
    placed = np.empty_like(poses)
    placed[:, 0] = there[0] + c * away[:, 0] - s * away[:, 1]
    placed[:, 1] = there[1] + s * away[:, 0] + c * away[:, 1]
    placed[:, 2] = poses[:, 2] + turn
    return placed


def draw_cycles(angle: Axes, moment: Axes, story: Story, reader: LogReader) -> None:
    """Commanded and measured angle, and the moment with its threshold, of one touching whisker."""
    whisker, first = touching_cycles(story)
    last = first + CYCLES_SHOWN * story.experiment.period_ticks
    rows = []
    for message in messages(reader, frozenset(("head.sample",))):
        if message.t > last * TICK_NS:
            break
        body = message.body
        if body.tick >= first:
            values = (body.command[whisker], body.theta[whisker], body.y[whisker])
            rows.append((body.tick / TICK_HZ, *map(float, values)))
    name = whisker_name(whisker)
    angle.set_title(f"whisk cycles of {name}", loc="left")
    if rows:
        t, command, theta, y = np.array(rows).T
        angle.plot(t, np.degrees(command), color="0.5", lw=1, label="commanded")
        angle.plot(t, np.degrees(theta), color="tab:blue", lw=1, label="measured")
        moment.plot(t, y * 1e3, color="tab:red", lw=0.6, label="deflection y")
        angle.legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8, frameon=False
        )
    if story.calibration is not None:
        mean, limit = story.calibration.mean_y[whisker], story.calibration.threshold_y[whisker]
        for bound in (mean - limit, mean + limit):
            moment.axhline(bound * 1e3, color="k", lw=0.7, ls="--")
    angle.set_ylabel("protraction (deg)")
    angle.tick_params(labelbottom=False)
    moment.set_ylabel("moment (mN m)")
    moment.set_xlabel("t (s); dashed: contact threshold")


def touching_cycles(story: Story) -> tuple[int, int]:
    """(whisker, first tick) of the whisk cycles with the most contact; (0, 0) when none touched."""
    period = story.experiment.period_ticks
    counts: dict[int, npt.NDArray[np.int64]] = {}
    for row, touching in story.contacts.items():
        cycle = row * BIN_TICKS // period
        counts[cycle] = counts.get(cycle, np.zeros(WHISKERS, np.int64)) + touching
    if not counts:
        return 0, 0
    whisker = int(np.argmax(sum(counts.values())))
    best = max(counts, key=lambda c: sum(_at(counts, c + k, whisker) for k in range(CYCLES_SHOWN)))
    return whisker, best * period


def _at(counts: dict[int, npt.NDArray[np.int64]], cycle: int, whisker: int) -> int:
    return int(counts[cycle][whisker]) if cycle in counts else 0


def draw_contacts(ax: Axes, story: Story) -> None:
    """When each whisker touched."""
    for whisker in range(WHISKERS):
        t = [row * BIN_TICKS / TICK_HZ for row, on in story.contacts.items() if on[whisker]]
        colour = RING_COLOURS[whisker // (WHISKERS // len(RINGS))]
        ax.plot(t, np.full(len(t), whisker), "|", ms=7, mew=1, color=colour)
    ax.axvspan(0, story.calibrated_s, color="0.92")
    ax.set_xlim(0, story.samples / TICK_HZ or 1)
    ax.set_ylim(WHISKERS - 0.5, -0.5)
    ax.set_yticks(range(WHISKERS), [str(i) for i in range(WHISKERS)], fontsize=7)
    ax.set_ylabel("whisker (front, mid, rear ring)")
    ax.set_xlabel("t (s); grey: calibration in the air")
    ax.set_title("contacts", loc="left")


def draw_timing(ax: Axes, story: Story) -> None:
    """Latency, lateness and work time of each process: median of its means per second, and max."""
    share = story.obeyed / story.samples if story.samples else 0.0
    ax.set_title(f"timing: drives obey the last sample's answer in {share:.1%}", loc="left")
    rows = [
        (f"{node} {kind}", float(np.median(mean[mean > 0])), float(worst.max()))
        for node, bodies in story.telemetry.items()
        for kind in ("latency", "lateness", "work")
        for mean, worst in [np.array([getattr(body, f"{kind}_us") for body in bodies]).T]
        if worst.any()
    ]
    if not rows:
        ax.set_axis_off()
        ax.text(0.0, 0.5, "no wall-clock telemetry: this run did not keep real time")
        return
    names, means, worsts = zip(*rows, strict=True)
    ax.plot(means, range(len(rows)), "o", color="tab:blue", label="mean")
    ax.plot(worsts, range(len(rows)), "o", color="tab:red", label="max")
    ax.axvline(TICK_NS * 1e-3, color="k", lw=0.7, ls="--")
    ax.set_xscale("log")
    ax.set_yticks(range(len(rows)), names, fontsize=7)
    ax.invert_yaxis()
    ax.grid(axis="x", alpha=0.3)
    ax.set_xlabel("us; dashed: one period")
    ax.legend(fontsize=8, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
