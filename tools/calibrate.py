"""`vibrissa calibrate` and `vibrissa start`: before a run with devices, and its beginning."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated, Final

import typer

from vibrissa.tools.console import note, stdout
from vibrissa.tools.control import Run, _client


def calibrate(
    what: Annotated[
        str, typer.Argument(help="`head` (may be left out) or `odometry`.", show_default=False)
    ] = "head",
    file: Annotated[
        Path | None,
        typer.Argument(
            help="Experiment file (TOML); without one, the defaults. `odometry`: or a recorded run."
        ),
    ] = None,
    cycles: Annotated[
        int, typer.Option(min=1, max=100, help="head: whisk cycles to learn from.")
    ] = 4,
    circuits: Annotated[
        int, typer.Option(min=1, max=100, help="odometry: circuits to drive, there and back.")
    ] = 2,
    out: Annotated[
        Path | None,
        typer.Option(help="New file. Default: calibration-HEAD-DATE.json, odometer-DATE.json."),
    ] = None,
) -> None:
    """Learn what a head's whiskers feel in the air, or how far the odometry can be trusted.

    **head**: whisk freely and write each whisker's mean, noise and contact threshold into a dated
    file. The whiskers move, the arm does not. Nothing may touch them: a touch ends it, and no file
    is written. A run uses the file with `whisk.calibration = "FILE"`; its log then embeds it.

    **odometry**: drive circuits (simulated, or on the rig that the file names, after `vibrissa
    start`), or take a run that was recorded before, and compare odometry with the way of the arm:
    on the straights and on the turns in place. A run uses the file with `slam.odometer = "FILE"`;
    its log then embeds it. `vibrissa calibrate odometry rig.toml`, `vibrissa calibrate odometry
    runs/first`
    """
    if what not in MADE:
        if file is not None:
            raise typer.BadParameter(f"calibrate {what!r}: expected {' or '.join(MADE)}")
        what, file = "head", Path(what)
    MADE[what](file, cycles if what == "head" else circuits, out)


def _head(file: Path | None, cycles: int, out: Path | None) -> None:
    from vibrissa.processes.config import load_experiment
    from vibrissa.tools.free_whisking import measure, only_whisking

    name, text = measure(only_whisking(load_experiment(file), cycles))
    made = _write(out, f"calibration-{name}", text)
    note(f'to use it: [whisk] calibration = "{made}"')
    stdout().print(str(made), markup=False)


def _odometry(file: Path | None, circuits: int, out: Path | None) -> None:
    from vibrissa.processes.config import load_experiment
    from vibrissa.tools.odometer_drive import drive, driving, from_log

    if file is not None and (file.is_dir() or file.suffix == ".mcap"):
        text = from_log(file)
    else:
        text = drive(driving(load_experiment(file), circuits))
    made = _write(out, "odometer", text)
    note(f'to use it: [slam] odometer = "{made}"')
    stdout().print(str(made), markup=False)


def _write(out: Path | None, name: str, text: str) -> Path:
    """Keep what was learnt in a new file. Raises RunError."""
    from vibrissa.processes.results import RunError

    made = out or Path(f"{name}-{datetime.date.today().isoformat()}.json")
    try:
        with made.open("x") as sink:
            sink.write(text)
    except OSError as error:
        raise RunError(f"{made}: {error.strerror}") from None
    return made


MADE: Final = {"head": _head, "odometry": _odometry}


def start(run: Run = None) -> None:
    """Let a run with real devices begin; before this nothing moves.

    Exit code 2 when no run waits.
    """
    with _client(run) as client:
        stdout().print(client.start(), markup=False)


VERBS = (
    (calibrate, "vibrissa calibrate rig.toml --cycles 6"),
    (start, "vibrissa start --run runs/first"),
)
