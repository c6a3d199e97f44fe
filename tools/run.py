"""`vibrissa run` and `vibrissa simulate`: experiments, live or as fast as they go."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from vibrissa.tools.console import Json, print_json, progress_bar, stdout, table

ExperimentFile = Annotated[
    Path | None, typer.Argument(help="Experiment file (TOML); without one, the defaults.")
]
Duration = Annotated[
    float | None, typer.Option(help="Seconds of logical time, instead of the file's.")
]
Controller = Annotated[str | None, typer.Option(help="Whisk controller, instead of the file's.")]
Seed = Annotated[int | None, typer.Option(help="Seed, instead of the file's.")]
Out = Annotated[
    Path | None,
    typer.Option(
        help="New directory for run.mcap and summary.json. Default: the next runs/NAME-N."
    ),
]


def run(
    file: ExperimentFile = None,
    *,
    duration: Duration = None,
    controller: Controller = None,
    seed: Seed = None,
    out: Out = None,
    start: Annotated[
        bool,
        typer.Option(
            "--start", help="Real devices: give the start now, do not wait for vibrissa start."
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Run an experiment live at 2 kHz: real processes, real sockets, one log.

    With real devices everything is made ready, then waits for `vibrissa start`: nothing moves
    before. A virtual or emulated rig starts at once.

    Ctrl-C ends the run in an orderly way: whiskers retract, the log closes. Exit code 1 when the
    run ended before its time, 2 when it could not start.
    """
    from vibrissa.processes.config import load_experiment
    from vibrissa.processes.supervisor import run_live

    experiment = load_experiment(file, duration=duration, controller=controller, seed=seed)
    out = out or next_directory("run")
    with progress_bar() as on_progress:
        summary = run_live(experiment, out, on_progress, start=start)
    report(summary, out, as_json)


def simulate(
    file: ExperimentFile = None,
    *,
    duration: Duration = None,
    controller: Controller = None,
    seed: Seed = None,
    out: Out = None,
    as_json: Json = False,
) -> None:
    """Run an experiment in closed loop without real time: one seed, one result.

    Writes the same kind of log as `run`. Exit code 1 when it ended before its time, 2 when it
    could not start.
    """
    from vibrissa.processes.config import load_experiment
    from vibrissa.processes.simulate import simulate as simulate_run

    experiment = load_experiment(file, duration=duration, controller=controller, seed=seed)
    out = out or next_directory("simulate")
    with progress_bar() as on_progress:
        summary = simulate_run(experiment, out, on_progress=on_progress)
    report(summary, out, as_json)


VERBS = (
    (run, "vibrissa run --duration 30 --controller rcp --out runs/first"),
    (simulate, "vibrissa simulate --seed 7 --duration 60 --out runs/seed-7"),
)

LINE = 120
"""Characters shown of an event."""


def next_directory(name: str, under: Path = Path("runs")) -> Path:
    """The first of NAME-1, NAME-2, ... that does not exist."""
    number = 1
    while (under / f"{name}-{number}").exists():
        number += 1
    return under / f"{name}-{number}"


def report(summary: dict[str, Any], out: Path, as_json: bool) -> None:
    """Print a summary and leave with 1 if the run was not what was asked for."""
    if as_json:
        print_json(summary)
    else:
        print_summary(summary, out)
    if not summary["ok"]:
        raise typer.Exit(1)


def print_summary(summary: dict[str, Any], out: Path) -> None:
    """A summary as tables for people; summary.json has every event in full."""
    from rich.text import Text

    console = stdout()
    ticks, answered = summary["ticks"], summary["ticks_answered"]
    share = f", {answered / ticks:.2%} answered within one period" if ticks else ""
    obeyed = summary.get("counters", {}).get("sampler", {}).get("obeyed")
    if ticks and obeyed is not None:
        share += f", {obeyed / ticks:.2%} obeyed by the drives at the next sample"
    cause = Text(summary["cause"], style="green" if summary["ok"] else "red")
    console.print(cause + Text(f": {ticks} ticks{share}"))

    traffic = table("messages", ("topic", "sent", "received", "lost"))
    for topic, counts in sorted(summary["messages"].items()):
        lost = counts["lost"]
        traffic.add_row(
            topic,
            str(counts["sent"]),
            str(counts["received"]),
            f"[red]{lost}[/red]" if lost else "0",
        )
    console.print(traffic)

    times = table("times in us", ("what", "process", "p50", "p99", "p99.9", "max"), text_columns=2)
    for figure in ("latency_us", "lateness_us", "work_us", "period_us"):
        for process, values in summary.get(figure, {}).items():
            times.add_row(
                figure.removesuffix("_us"),
                process,
                *(f"{values[key]:.0f}" if values else "-" for key in ("p50", "p99", "p999", "max")),
            )
    if times.row_count:
        console.print(times)
    if "cpu_cores" in summary:
        console.print(f"processor: {cores(summary['cpu_cores']):.2f} cores")
    for event in summary["events"]:
        line = f"tick {event['tick']}: {event['kind']} {event['node']} {event['cause']}".rstrip()
        console.print(line if len(line) <= LINE else line[:LINE] + "...", markup=False)
    console.print(f"log {out / 'run.mcap'}, summary {out / 'summary.json'}", markup=False)


def cores(value: float | dict[str, float]) -> float:
    """Processor use of a run in cores, over all its processes."""
    return sum(value.values()) if isinstance(value, dict) else value
