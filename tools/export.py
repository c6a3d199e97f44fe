"""`vibrissa export`: trajectories of a recorded run for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vibrissa.tools.console import Log, log_file, stdout


def export(
    log: Log,
    tum: Annotated[
        Path, typer.Option(help="Directory for truth.tum, odometry.tum and estimate.tum.")
    ],
) -> None:
    """Write the true, dead-reckoned and estimated trajectories, one pose per whisk, as TUM files.

    Lines are `time x y z qx qy qz qw` in s and m. The truth is in the maze's frame; odometry and
    estimate are in their own, so align them, or compare relative poses.
    """
    from vibrissa.control.kinematics import NOSE_HEIGHT
    from vibrissa.slam.metrics import to_tum
    from vibrissa.slam.tuning import dead_reckoning
    from vibrissa.tools.dataset import load

    data = load(log_file(log))
    tum.mkdir(parents=True, exist_ok=True)
    for name, poses in (
        ("truth", data.truth),
        ("odometry", dead_reckoning(data.odometry)),
        ("estimate", data.estimate),
    ):
        path = tum / f"{name}.tum"
        path.write_text(to_tum(data.times, poses, NOSE_HEIGHT))
        stdout().print(str(path), markup=False)


VERBS = ((export, "vibrissa export runs/first --tum runs/first/tum"),)
