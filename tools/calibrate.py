"""`vibrissa calibrate` and `vibrissa start`: before a run with devices, and its beginning."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated

import typer

from vibrissa.tools.console import note, stdout
from vibrissa.tools.control import Run, _client
from vibrissa.tools.run import ExperimentFile


def calibrate(
    file: ExperimentFile = None,
    cycles: Annotated[int, typer.Option(min=1, max=100, help="Whisk cycles to learn from.")] = 4,
    out: Annotated[
        Path | None, typer.Option(help="New file. Default: calibration-HEAD-DATE.json.")
    ] = None,
) -> None:
    """Whisk freely and write each whisker's mean, noise and contact threshold into a dated file.

    The whiskers move, the arm does not. Nothing may touch them: a touch ends it, and no file is
    written. A run uses the file with `whisk.calibration = "FILE"`; its log then embeds it.
    """
    from vibrissa.processes.config import load_experiment
    from vibrissa.processes.results import RunError
    from vibrissa.tools.free_whisking import measure, only_whisking

    experiment = only_whisking(load_experiment(file), cycles)
    name, text = measure(experiment)
    made = out or Path(f"calibration-{name}-{datetime.date.today().isoformat()}.json")
    try:
        with made.open("x") as sink:
            sink.write(text)
    except OSError as error:
        raise RunError(f"{made}: {error.strerror}") from None
    note(f'to use it: [whisk] calibration = "{made}"')
    stdout().print(str(made), markup=False)


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
