"""`vibrissa calibrate` and `vibrissa start`: before a run with devices, and its beginning."""

from __future__ import annotations

import datetime
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from vibrissa.control.calibration import Calibration
from vibrissa.messages.codec import decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.types import TICK_HZ
from vibrissa.processes.calibration_file import VIRTUAL_HEAD, to_text
from vibrissa.processes.config import RETRACT_S, Experiment, load_experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.results import Progress, RunError
from vibrissa.tools.console import note, progress_bar, stdout, table
from vibrissa.tools.control import Run, _client
from vibrissa.tools.run import ExperimentFile

ATTEMPTS = 20
"""How often free whisking may be disturbed by a late controller and begin again."""


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


def only_whisking(experiment: Experiment, cycles: int) -> Experiment:
    """The experiment up to its calibration, with an arm that is left alone."""
    period = experiment.whisk.period
    duration = ATTEMPTS * cycles * period + 2.0 * RETRACT_S
    fresh = {"calibration": "", "calibration_text": "", "calibration_cycles": cycles}
    return experiment.model_copy(
        update={
            "run": experiment.run.model_copy(update={"duration": duration}),
            "rig": experiment.rig.model_copy(update={"arm": "virtual"}),
            "whisk": experiment.whisk.model_copy(update=fresh),
            "swap": [],
        }
    )


def measure(experiment: Experiment) -> tuple[str, str]:
    """(serial number of the head, content of its calibration file). Raises RunError."""
    from vibrissa.processes.supervisor import Supervisor
    from vibrissa.processes.whisk import from_message

    with tempfile.TemporaryDirectory(prefix="vibrissa-calibrate-") as scratch, progress_bar() as on:
        folder = Path(scratch) / "run"

        def until_learnt(progress: Progress) -> None:
            on(progress)
            if run.calibration is not None:
                run.interrupt()

        run = Supervisor(experiment, folder, until_learnt, start=True)
        summary = run.run()
        head, found = VIRTUAL_HEAD, None
        for record in LogReader(folder / "run.mcap"):
            if record.topic == "whisk.calibration":
                found = from_message(decode(frame_of(record)).body)
            elif record.topic == "rig.event" and record.source == "head-device":
                event = decode(frame_of(record)).body
                if event.kind == "opened":
                    head = event.cause.rpartition(": head ")[2].partition(",")[0]
    if found is None:
        raise RunError(f"no calibration: {summary['cause']}")
    show(found)
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return head, to_text(found, head, date, summary["run_id"])


def show(calibration: Calibration) -> None:
    """Mean, noise and threshold per whisker, as a table."""
    from vibrissa.control.kinematics import WHISKERS, whisker_name

    made = table("free whisking, uN m", ("whisker", "mean", "noise", "threshold"))
    figures = [getattr(calibration, name) * 1e6 for name in ("mean_y", "sigma_y", "threshold_y")]
    for i in range(WHISKERS):
        made.add_row(whisker_name(i), *(f"{values[i]:.1f}" for values in figures))
    stdout().print(made)
    stdout().print(f"{calibration.samples / TICK_HZ:g} s of samples", markup=False)


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
"""In the order of use."""
