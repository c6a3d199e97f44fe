"""A run that only whisks, in the air: what every whisker of a head feels then."""

from __future__ import annotations

import datetime
import tempfile
from pathlib import Path
from typing import Final

from vibrissa.control.calibration import Calibration
from vibrissa.control.kinematics import WHISKERS, whisker_name
from vibrissa.messages.codec import decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.types import TICK_HZ
from vibrissa.processes.calibration_file import VIRTUAL_HEAD, to_text
from vibrissa.processes.config import RETRACT_S, Experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.results import Progress, RunError
from vibrissa.processes.supervisor import Supervisor
from vibrissa.processes.whisk import from_message
from vibrissa.tools.console import progress_bar, stdout, table

ATTEMPTS: Final = 20
"""How often free whisking may be disturbed by a late controller and begin again."""


CLOSE: Final = [["rig", "sampler", "whisk"]]
"""In one process: commands come in time on small machines too, and there is nothing to isolate."""


def only_whisking(experiment: Experiment, cycles: int) -> Experiment:
    """The experiment up to its calibration, with an arm that is left alone."""
    period = experiment.whisk.period
    duration = ATTEMPTS * cycles * period + 2.0 * RETRACT_S
    fresh = {"calibration": "", "calibration_text": "", "calibration_cycles": cycles}
    return experiment.model_copy(
        update={
            "run": experiment.run.model_copy(update={"duration": duration, "together": CLOSE}),
            "rig": experiment.rig.model_copy(update={"arm": "virtual"}),
            "whisk": experiment.whisk.model_copy(update=fresh),
            "swap": [],
        }
    )


def measure(experiment: Experiment) -> tuple[str, str]:
    """(serial number of the head, content of its calibration file). Raises RunError."""
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
    made = table("free whisking, uN m", ("whisker", "mean", "noise", "threshold"))
    figures = [getattr(calibration, name) * 1e6 for name in ("mean_y", "sigma_y", "threshold_y")]
    for i in range(WHISKERS):
        made.add_row(whisker_name(i), *(f"{values[i]:.1f}" for values in figures))
    stdout().print(made)
    stdout().print(f"{calibration.samples / TICK_HZ:g} s of samples", markup=False)
