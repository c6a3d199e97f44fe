"""A run that drives circuits, and what it says of the odometer: its file for later runs."""

from __future__ import annotations

import datetime
import tempfile
from pathlib import Path

import numpy as np

from vibrissa.processes.arm import make_path
from vibrissa.processes.config import RETRACT_S, Experiment
from vibrissa.processes.odometer_file import to_text
from vibrissa.processes.rebuild import open_log
from vibrissa.processes.results import RunError
from vibrissa.slam.interface import SlamInputError
from vibrissa.slam.odometer import OdometerNoise, calibrated_against
from vibrissa.slam.odometry import odometry_between
from vibrissa.tools.console import log_file, progress_bar, stdout, table
from vibrissa.tools.dataset import load


def driving(experiment: Experiment, circuits: int) -> Experiment:
    """The experiment with circuits there and back alone, as long as they take."""
    arm = experiment.arm.model_copy(update={"sequence": ("CA" * circuits)[:circuits]})
    slam = {"algorithm": "sequence", "parameters": {}, "odometer": "", "odometer_text": ""}
    period = experiment.whisk.period
    calibrating = (experiment.whisk.calibration_cycles + 2) * period
    changed = experiment.model_copy(
        update={
            "arm": arm,
            "slam": experiment.slam.model_copy(update=slam),
            "swap": [],
        }
    )
    duration = calibrating + make_path(changed).duration + period + 2.0 * RETRACT_S
    run = experiment.run.model_copy(update={"duration": duration})
    return changed.model_copy(update={"run": run})


def drive(experiment: Experiment) -> str:
    """Run it, simulated where the rig is, and learn from its log. Raises RunError."""
    from vibrissa.processes.simulate import simulate
    from vibrissa.processes.supervisor import run_live

    with tempfile.TemporaryDirectory(prefix="vibrissa-calibrate-") as scratch, progress_bar() as on:
        folder = Path(scratch) / "run"
        run = simulate if experiment.rig.virtual else run_live
        summary = run(experiment, folder, on_progress=on)
        if not summary["ok"]:
            raise RunError(f"no calibration: {summary['cause']}")
        return from_log(folder)


def from_log(log: Path) -> str:
    """The content of an odometer file from a recorded run, and a table of it for people.

    Raises UnusableLogError and DatasetError for a log without views, RunError for one with too few
    whisks straight ahead or turning in place.
    """
    path = log_file(log)
    seen = load(path)
    felt, true = [], []
    for k in range(1, len(seen)):
        if seen.cycles[k] != seen.cycles[k - 1] + 1:
            continue
        v, w, dt = seen.odometry[k].tolist()
        before, here = seen.truth[k - 1].tolist(), seen.truth[k].tolist()
        exact = odometry_between(before, here, dt)
        felt.append((v * dt, w * dt))
        true.append((exact.v * dt, exact.w * dt))
    shape = (len(felt), 2)
    try:
        found, straights, turns = calibrated_against(
            np.reshape(felt, shape), np.reshape(true, shape)
        )
    except SlamInputError as error:
        raise RunError(f"{log}: {error}") from None
    show(found, straights, turns)
    return to_text(
        found,
        seen.experiment.slam.odometry_noise,
        datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        open_log(path, allow_cut=True).run_id,
        straights,
        turns,
    )


def show(odometer: OdometerNoise, straights: int, turns: int) -> None:
    """Standard deviations of a step, as a table."""
    made = table("standard deviation of a step", ("of", "constant", "share of the motion"))
    made.add_row("distance", f"{odometer.distance * 1e3:.3g} mm", f"{odometer.distance_share:.2%}")
    made.add_row("turn", f"{odometer.turn:.3g} rad", f"{odometer.turn_share:.2%}")
    stdout().print(made)
    stdout().print(f"{straights} whisks straight ahead, {turns} turning in place")
