"""`vibrissa info`, `recover` and `plot`: what a log holds, what is left of it, how it looks."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.tools.console import Json, Log, busy, fail, log_file, note, print_json, stdout, table

if TYPE_CHECKING:
    from vibrissa.messages.recover import LogSummary


def info(log: Log, as_json: Json = False) -> None:
    """Show what a log holds: run, experiment, channels, gaps, how it ended.

    Exit code 1 when it was cut off, damaged or has gaps; 2 when it is no log.
    """
    from vibrissa.messages.recover import summarise

    path = log_file(log)
    with busy("reading the log"):
        summary = summarise(path)
    fault = what_is_wrong(summary)
    if as_json:
        metadata = {key: _parsed(value) for key, value in summary.metadata.items()}
        print_json({**dataclasses.asdict(summary), "metadata": metadata, "fault": fault})
    else:
        print_info(path, summary)
    if fault:
        fail(f"{path}: {fault}")
        raise typer.Exit(1)


def recover(
    log: Log,
    out: Annotated[
        Path | None,
        typer.Option(
            help="New file for what is left. Default: NAME-recovered.mcap beside the log."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Copy every readable record of a cut-off or damaged log into a new, closed one.

    `verify` re-runs what was recovered up to each node's last complete step. The original is never
    changed. Exit code 2 when nothing can be saved.
    """
    from vibrissa.messages.recover import recover as recover_log

    path = log_file(log)
    out = out or path.with_name(f"{path.stem}-recovered.mcap")
    with busy("copying what can be read"):
        found = recover_log(path, out)
    if as_json:
        print_json({"out": out, "lossless": found.lossless, **dataclasses.asdict(found)})
        return
    stdout().print(
        f"{out}: {found.kept} of {found.readable} readable records kept, "
        f"{found.lost_bytes} bytes of an incomplete end left out",
        markup=False,
    )
    for line in found.damage:
        note(line)


def plot(
    log: Log,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Directory for the pictures, or a file (png, pdf, svg) for the overview alone. "
            "Default: beside the log."
        ),
    ] = None,
) -> None:
    """Draw what happened: an overview of the run, and the paper's figures of the mapping.

    run.png: path and map in the maze, a whisk cycle, contacts, timing. odometry.png: the true path
    and the odometry. experiences.png: experiences over time and their re-localisations. map.png:
    the map, by direction of travel.
    """
    from vibrissa.tools.picture import draw

    path = log_file(log)
    if out is not None and out.suffix:
        with busy("drawing"):
            draw(path).savefig(out, dpi=130)
        stdout().print(str(out), markup=False)
        return
    folder = out or path.parent
    folder.mkdir(parents=True, exist_ok=True)
    overview = folder / f"{path.stem}.png"
    with busy("drawing"):
        draw(path).savefig(overview, dpi=130)
        stdout().print(str(overview), markup=False)
        draw_mapping(path, folder)


def draw_mapping(path: Path, folder: Path) -> None:
    """The figures of the mapping into a directory; a line when the log has none to draw."""
    from vibrissa.tools.dataset import DatasetError, load
    from vibrissa.tools.figures import FIGURES

    try:
        data = load(path)
    except DatasetError as error:
        note(f"no figures of the mapping: {error}")
        return
    for name, draw_figure in FIGURES.items():
        draw_figure(data).savefig(folder / f"{name}.png", dpi=130)
        stdout().print(str(folder / f"{name}.png"), markup=False)


VERBS = (
    (info, "vibrissa info runs/first --json"),
    (recover, "vibrissa recover runs/crashed --out runs/crashed/usable.mcap"),
    (plot, "vibrissa plot runs/first --out pictures"),
)


def what_is_wrong(summary: LogSummary) -> str:
    """One line on what a log lacks, empty for a whole one."""
    if summary.damage:
        more = f" and {len(summary.damage) - 1} more" if len(summary.damage) > 1 else ""
        return summary.damage[0] + more
    if not summary.complete:
        return f"cut off at byte {summary.cut_at}; 'vibrissa recover' saves what is usable"
    gaps = [c for c in summary.channels if c.missing or c.restarts]
    if gaps:
        first = gaps[0]
        return f"{first.topic} of {first.source}: {first.missing} messages missing"
    return ""


def print_info(path: Path, summary: LogSummary) -> None:
    """What a log holds, for people."""
    console = stdout()
    state = (summary.end or {}).get("cause", "unknown") if summary.complete else "not closed"
    console.print(
        f"{path}: run {summary.run_id}, {summary.duration * 1e-9:.2f} s, "
        f"{summary.records} messages, {summary.size / 1e6:.1f} MB, ended: {state}",
        markup=False,
    )
    for key, value in {**summary.metadata, **_flat(summary.extra)}.items():
        text = " ".join(value.split())
        console.print(f"  {key}: {text[:160]}{'...' if len(text) > 160 else ''}", markup=False)
    channels = table("channels", ("topic", "source", "messages", "Hz", "missing"), text_columns=2)
    for channel in summary.channels:
        span = (channel.last_t or 0) - (channel.first_t or 0)
        rate = f"{(channel.count - 1) / span * 1e9:.1f}" if span else "-"
        channels.add_row(
            channel.topic, channel.source, str(channel.count), rate, str(channel.missing)
        )
    console.print(channels)


def _flat(extra: dict[str, dict[str, str]]) -> dict[str, str]:
    return {f"{name}.{key}": value for name, data in extra.items() for key, value in data.items()}


def _parsed(value: str) -> Any:
    try:
        return json.loads(value)
    except ValueError:
        return value
