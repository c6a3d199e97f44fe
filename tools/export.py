"""`vibrissa export`: trajectories of a recorded run for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vibrissa.tools.console import Log, log_file, stdout


def export(
    log: Log,
    tum: Annotated[
        Path | None, typer.Option(help="Directory for truth.tum, odometry.tum and estimate.tum.")
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(help="File for the whiskers' samples, one row per sample.")
    ] = None,
) -> None:
    """Write trajectories as TUM files, or the whiskers' samples as CSV.

    TUM: the true, dead-reckoned and estimated trajectories, one pose per whisk. Lines are `time x y
    z qx qy qz qw` in s and m. The truth is in the maze's frame; odometry and estimate are in their
    own, so align them, or compare relative poses. CSV: docs/devices.md; `vibrissa import` reads it.
    """
    if tum is None and csv is None:
        raise typer.BadParameter("name what to write: --tum DIRECTORY, --csv FILE, or both")
    if tum is not None:
        export_tum(log, tum)
    if csv is not None:
        from vibrissa.tools.recording import of_log

        rows = of_log(log_file(log), csv)
        stdout().print(f"{csv}: {rows} samples", markup=False)


def export_tum(log: Path, tum: Path) -> None:
    """Write the three trajectories of a log into a directory."""
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


def import_(
    csv: Annotated[Path, typer.Argument(help="A whisker recording as docs/devices.md has it.")],
    out: Annotated[
        Path | None, typer.Option(help="New directory for run.mcap. Default: the next.")
    ] = None,
) -> None:
    """Make a log of a whisker recording in CSV: samples, and where they are given the head's poses.

    The log can be looked at, exported, and used in a what-if run; nothing computed is in it.
    """
    from vibrissa.tools.recording import to_log
    from vibrissa.tools.run import next_directory

    out = out or next_directory("import")
    rows = to_log(csv, out)
    stdout().print(f"{out / 'run.mcap'}: {rows} samples", markup=False)


VERBS = (
    (export, "vibrissa export runs/first --tum runs/first/tum"),
    (import_, "vibrissa import recording.csv --out runs/recording"),
)
