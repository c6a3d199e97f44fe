"""`vibrissa tune`: RatSLAM's parameters for a recorded run, over a grid, beside its controls."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from vibrissa.tools.console import Json, Log, log_file, print_json, progress_bar, stdout, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vibrissa.processes.config import Experiment
    from vibrissa.processes.results import OnProgress
    from vibrissa.slam.config import RatSlamConfig
    from vibrissa.slam.tuning import (
        Choice,
        Control,
        Energies,
        Point,
        Recording,
        Score,
        Trial,
        Value,
    )

ONE_THREAD: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
SHORT: Final = {
    "vt_match_threshold": "match",
    "pc_vt_inject_energy": "inject",
    "pc_dim_xy": "torus",
    "pc_cell_x_size": "cell",
    "exp_delta_pc_threshold": "dpc",
}


def tune(
    log: Log,
    *,
    image: Annotated[
        str | None, typer.Option(help="Kind of tactile image. Default: the one the run used.")
    ] = None,
    axis: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=V1,V2,..",
            help="Values of a RatSLAM parameter, instead of the grid's or in addition to it.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Directory for tune.png and tuned.toml. Default: the log's.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes. Default: one per core.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Sweep RatSLAM's parameters over a recorded run, choose, and say why.

    Every point stands beside two controls (black images, images of other whisks) and the raw
    odometry. Writes a picture of the sweep, and an experiment file with the chosen parameters that
    `run` and `simulate` take. Needs a log of more than one circuit with ground truth.
    """
    from vibrissa.processes.slams import make_slam_config
    from vibrissa.slam.tuning import GRID, Recording, choose, dead_reckoning, energies, grid_points
    from vibrissa.tools.dataset import IMAGES, load

    grid = {**GRID, **dict(parse_axis(text) for text in axis or ())}
    path = log_file(log)
    data = load(path)
    kind = image or data.experiment.slam.image
    if kind not in IMAGES:
        raise typer.BadParameter(f"--image {kind}: expected one of {', '.join(IMAGES)}")
    recording = Recording(data.images[kind], data.odometry, data.truth)
    with progress_bar() as on_progress:
        trials = sweep(
            recording,
            make_slam_config(data.experiment),
            grid_points(grid),
            jobs or len(os.sched_getaffinity(0)),
            on_progress,
        )
    choice = choose(trials)
    odometry = energies(dead_reckoning(data.odometry), data.truth)
    out = out or path.parent
    out.mkdir(parents=True, exist_ok=True)
    draw(trials, choice, odometry).savefig(out / "tune.png", dpi=130)
    text = toml_of(data.experiment, kind, choice)
    (out / "tuned.toml").write_text(text)
    if as_json:
        print_json(to_json(trials, choice, odometry, kind, text, out))
    else:
        print_sweep(trials, choice, odometry, out, text)


VERBS = ((tune, "vibrissa tune runs/first --axis vt_match_threshold=0.001,0.002,0.004"),)


def parse_axis(text: str) -> tuple[str, tuple[Value, ...]]:
    """NAME=V1,V2,.. as a person typed it. Raises typer.BadParameter."""
    name, equals, values = text.partition("=")
    try:
        numbers = tuple(
            float(value) if any(c in value for c in ".eE") else int(value)
            for value in values.split(",")
        )
    except ValueError:
        equals = ""
        numbers = ()
    if not equals or not name:
        raise typer.BadParameter(f"--axis {text}: expected NAME=V1,V2,.. with numbers")
    return name, numbers


# --------------------------------------------------------------------------------- the sweep

_work: dict[str, Any] = {}


def _prepare(recording: Recording, base: RatSlamConfig) -> None:
    _work.update(recording=recording, base=base)


def _score(point: Point, control: Control) -> Score:
    from vibrissa.slam.tuning import configured, score

    return score(_work["recording"], configured(_work["base"], point), control)


def sweep(
    recording: Recording,
    base: RatSlamConfig,
    points: Sequence[Point],
    jobs: int,
    on_progress: OnProgress,
) -> list[Trial]:
    """Every point with its controls, over `jobs` processes of one thread each.

    The result does not depend on `jobs`. Raises TuningError before anything runs.
    """
    import multiprocessing
    from concurrent import futures

    from vibrissa.processes.results import Progress
    from vibrissa.slam.tuning import Trial, blind_key, configured

    for point in points:
        configured(base, point)
    tasks: dict[tuple[Any, ...], tuple[Point, Control]] = {}
    for number, point in enumerate(points):
        tasks["touch", number] = point, "touch"
        tasks["shuffled", number] = point, "shuffled"
        tasks.setdefault(("blind", blind_key(point)), (point, "blind"))
    seconds = float(recording.odometry[:, 2].sum())
    found: dict[tuple[Any, ...], Score] = {}
    with (
        one_thread(),
        futures.ProcessPoolExecutor(
            jobs, multiprocessing.get_context("spawn"), _prepare, (recording, base)
        ) as pool,
    ):
        waiting = {pool.submit(_score, *task): key for key, task in tasks.items()}
        for done in futures.as_completed(waiting):
            found[waiting[done]] = done.result()
            note = f"{len(found)} of {len(tasks)} runs"
            on_progress(Progress("tuning", len(found) * seconds, len(tasks) * seconds, note))
    return [
        Trial(
            point,
            found["touch", number],
            found["blind", blind_key(point)],
            found["shuffled", number],
        )
        for number, point in enumerate(points)
    ]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Processes started within have one thread for linear algebra and compiled code."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


# --------------------------------------------------------------------------------- telling


def toml_of(experiment: Experiment, image: str, choice: Choice) -> str:
    """The [slam] section of an experiment file with the chosen parameters."""
    settings = experiment.slam
    parameters = {**settings.parameters, **choice.trial.point}
    lines = [
        f"# {choice.reason}",
        "[slam]",
        f'preset = "{settings.preset}"',
        f'image = "{image}"',
        f'odometry_noise = "{settings.odometry_noise}"',
        "",
        "[slam.parameters]",
        *(f"{name} = {_toml(value)}" for name, value in sorted(parameters.items())),
    ]
    return "\n".join(lines) + "\n"


def _toml(value: Value | bool) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


def to_json(
    trials: Sequence[Trial],
    choice: Choice,
    odometry: Energies,
    image: str,
    toml: str,
    out: Path,
) -> dict[str, Any]:
    """Everything the sweep found, as plain values."""
    return {
        "image": image,
        "trials": [dataclasses.asdict(trial) for trial in trials],
        "odometry": dataclasses.asdict(odometry),
        "chosen": dict(choice.trial.point),
        "stage": choice.stage,
        "reason": choice.reason,
        "toml": toml,
        "out": out,
    }


def print_sweep(
    trials: Sequence[Trial], choice: Choice, odometry: Energies, out: Path, toml: str
) -> None:
    """The sweep as two tables, returns and energies; the chosen point is marked."""
    console = stdout()
    varied, fixed = axes(trials)
    told = ", ".join(f"{name} {value:g}" for name, value in fixed.items())
    short = tuple(SHORT.get(name, name) for name in varied)
    counts = table(
        f"returns: touch/blind/shuffled{'; ' + told if told else ''}",
        (*short, "closed", "wrong", "earlier", "right %", "templates", "experiences"),
        text_columns=0,
    )
    rates = table(
        "Experience Metric: touch/blind/shuffled",
        (*short, "ARR", "ARCR"),
        text_columns=0,
    )
    energy = table(
        "Energy Metric, m^2 + rad^2: touch/blind/shuffled; raw odometry "
        + ", ".join(f"{getattr(odometry, reading).total:.2g}" for reading in READINGS),
        (*short, *READINGS, "experiences, interval"),
        text_columns=0,
    )
    for trial in trials:
        style = "bold green" if trial is choice.trial else None
        named = [f"{trial.point[name]:g}" for name in varied]
        scores = (trial.touch, trial.blind, trial.shuffled)
        closed = trial.touch.closed_at
        counts.add_row(
            *named,
            "-" if closed is None else str(closed),
            "/".join(str(s.wrong_before) for s in scores),
            "/".join(str(s.earlier_right) for s in scores),
            "/".join(f"{100 * s.right / s.returns:.0f}" if s.returns else "-" for s in scores),
            str(trial.touch.templates),
            str(trial.touch.experiences),
            style=style,
        )
        rates.add_row(
            *named,
            "/".join(_rate(s.arr) for s in scores),
            "/".join(_rate(s.arcr) for s in scores),
            style=style,
        )
        made = [s.experiences_made for s in scores]
        energy.add_row(
            *named,
            *(
                "/".join(f"{getattr(s.whisks, reading).total:.2g}" for s in scores)
                for reading in READINGS
            ),
            "/".join(f"{m.interval.total:.2g}" if m else "-" for m in made),
            style=style,
        )
    console.print(counts)
    console.print(
        "closed: whisk of the first right return to an earlier circuit; wrong: returns before it"
        " to another place; earlier: right returns to earlier circuits; right %: of all returns",
        style="dim",
    )
    console.print(rates)
    console.print(energy)
    console.print(f"chosen ({choice.stage}): {choice.reason}", markup=False)
    console.print(toml.partition("\n")[2], markup=False)
    console.print(f"{out / 'tune.png'}, {out / 'tuned.toml'}", markup=False)


READINGS: Final = ("consecutive", "interval", "all")


def _rate(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}".removeprefix("0")


def axes(trials: Sequence[Trial]) -> tuple[list[str], dict[str, Value]]:
    """The parameters that vary over the trials, and the values of those that don't."""
    first = trials[0].point
    varied = [name for name in first if len({trial.point[name] for trial in trials}) > 1]
    return varied, {name: value for name, value in first.items() if name not in varied}


def draw(trials: Sequence[Trial], choice: Choice, odometry: Energies) -> Figure:
    """The sweep over the match threshold: a column per geometry, a line per injected energy."""
    import numpy as np
    from matplotlib.figure import Figure

    from vibrissa.slam.tuning import ENERGY, THRESHOLD

    def geometry(point: Mapping[str, Value]) -> dict[str, Value]:
        return {n: v for n, v in point.items() if n not in (ENERGY, THRESHOLD)}

    columns: list[dict[str, Value]] = []
    for trial in trials:
        if geometry(trial.point) not in columns:
            columns.append(geometry(trial.point))
    thresholds = sorted({trial.point.get(THRESHOLD, 1.0) for trial in trials})
    energies_tried = sorted({trial.point.get(ENERGY, np.nan) for trial in trials})
    rows: tuple[tuple[str, Callable[[Score], float | None], str], ...] = (
        ("right returns to\nearlier circuits", lambda s: s.earlier_right, "symlog"),
        ("wrong returns before\nthe first loop closes", lambda s: s.wrong_before, "symlog"),
        ("ARR", lambda s: s.arr, "linear"),
        ("EM 20 apart\n(m^2 + rad^2)", lambda s: s.whisks.interval.total, "log"),
    )
    figure = Figure(figsize=(1.8 + 1.9 * len(columns), 8.6), layout="constrained")
    grid = figure.subplots(len(rows), len(columns), squeeze=False, sharex=True, sharey="row")
    for column, shape in enumerate(columns):
        for row, (label, of, scale) in enumerate(rows):
            ax = grid[row, column]
            for number, energy in enumerate(energies_tried):
                line = [
                    t
                    for t in trials
                    if geometry(t.point) == shape and t.point.get(ENERGY, np.nan) in (energy,)
                ]
                x = [t.point.get(THRESHOLD, 1.0) for t in line]
                for style, control in (("-o", "touch"), (":", "blind"), ("--", "shuffled")):
                    y = [of(getattr(t, control)) for t in line]
                    label_of = f"inject {energy:g}" if control == "touch" else None
                    ax.plot(x, y, style, ms=3, lw=1, color=f"C{number}", label=label_of)
            if label.startswith("EM"):
                ax.axhline(odometry.interval.total, color="k", lw=0.8, ls="-.")
            if geometry(choice.trial.point) == shape:
                at = choice.trial.point.get(THRESHOLD, 1.0)
                ax.plot(at, of(choice.trial.touch), "*", ms=14, mfc="none", color="k")
            ax.set_xscale("log")
            ax.set_xticks(thresholds, [f"{1000 * t:g}" for t in thresholds])
            ax.set_xticks([], minor=True)
            ax.set_yscale(scale)
            ax.grid(alpha=0.3)
            if column == 0:
                ax.set_ylabel(label, fontsize=8)
            if row == 0:
                title = "\n".join(f"{SHORT.get(n, n)} {v:g}" for n, v in shape.items())
                ax.set_title(title, fontsize=8)
            if row == len(rows) - 1:
                ax.set_xlabel("match threshold x 1000", fontsize=8)
            ax.tick_params(labelsize=7)
    grid[0, 0].legend(fontsize=7)
    figure.suptitle(
        "solid: touch, dotted: blind, dashed: shuffled images; dash-dot: raw odometry;"
        " star: chosen",
        fontsize=9,
    )
    return figure
