"""`vibrissa experiment`: run the paper's experiment and write its results and report."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from vibrissa.tools.console import Json, print_json, stdout

SHOWN = ("arr", "em_experience_interval")


def experiment(
    name: Annotated[
        str, typer.Argument(help="`paper`: Salman and Pearson's experiment; `slam`: SLAM by touch.")
    ],
    seeds: Annotated[
        int, typer.Option(min=1, max=1000, help="Runs of the whole (slam: in two mazes each).")
    ] = 5,
    jobs: Annotated[int, typer.Option(min=0, help="Processes; 0: one per core.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="Directory for results.json, report.html and the cache: runs/NAME."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A fast head and fewer circuits: a look, no claim.")
    ] = False,
    group: Annotated[
        list[str] | None,
        typer.Option(help="slam: only this group of data sets; may be repeated. [default: all]"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Reproduce the paper (open loop against RCP, max angle against contact angle, with controls),
    or set SLAMs by touch against their own odometry.

    An interrupted run goes on where it stopped; what is in the cache is not run again.
    """
    if name not in ("paper", "slam"):
        raise typer.BadParameter(f"no experiment {name!r}; there are `paper` and `slam`")
    folder = out or Path("runs") / name
    if name == "slam":
        _slam(seeds, quick, group or [], jobs or len(os.sched_getaffinity(0)), folder, as_json)
        return
    from vibrissa.tools.experiment.design import NOISE, scale
    from vibrissa.tools.experiment.paper import run_paper

    results = run_paper(scale(seeds, quick), jobs or len(os.sched_getaffinity(0)), folder)
    if as_json:
        print_json(results)
        return
    console = stdout()
    for row in results["effects"]:
        if row["noise"] == NOISE and row["score"] in SHOWN:
            console.print(
                f"{row['effect']}: {row['score']} {row['a']:.4g} -> {row['b']:.4g} "
                f"({row['up']} up, {row['down']} down of {row['n']}): {row['reading']}"
            )
    console.print(f"{folder / 'report.html'}  {results['timing']['wall_s']:.0f} s")


def _slam(seeds: int, quick: bool, groups: list[str], jobs: int, out: Path, as_json: bool) -> None:
    from vibrissa.tools.experiment.scores import RELATIONS
    from vibrissa.tools.experiment.slam_report import SHOWN, run_slam
    from vibrissa.tools.experiment.slam_runs import VARIANTS

    for name in groups:
        if name not in VARIANTS:
            raise typer.BadParameter(f"no group {name!r}; there are {', '.join(VARIANTS)}")
    results = run_slam(seeds, quick, groups, jobs, out)
    if as_json:
        print_json(results)
        return
    console = stdout()
    for cell in results["table"]:
        if cell["group"] == "plain" and cell["row"] in SHOWN:
            found = [f"{cell[r]['ratio']:.3g} ({cell[r]['wins']})" for r in RELATIONS]
            console.print(f"{cell['row']}, {cell['noise']}: {', '.join(found)} of {cell['n']}")
    console.print(str(out / "report.html"))


VERBS = ((experiment, "vibrissa experiment paper --quick --out runs/quick"),)
