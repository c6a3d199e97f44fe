"""`vibrissa verify` and `vibrissa replay`: a recorded run, run again."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated, Any

import typer

from vibrissa.tools.console import Json, Log, fail, log_file, print_json, progress_bar, stdout
from vibrissa.tools.run import next_directory


class ExecutorName(enum.StrEnum):
    """How a re-run is executed."""

    fused = "fused"
    lockstep = "lockstep"


def verify(
    log: Log,
    executor: Annotated[
        ExecutorName,
        typer.Option(help="fused: one process; lockstep: the real processes over real sockets."),
    ] = ExecutorName.fused,
    replace: Annotated[
        list[str] | None,
        typer.Option(metavar="NODE=module:Class", help="The replacements of a what-if run."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Re-run a log and compare every output byte for byte.

    Exit code 0 when identical; 1 when it diverged, naming node, step, topic, field and both
    values; 2 when the log can't be used, saying why.
    """
    from vibrissa.processes.verify import verify as verify_log

    with progress_bar() as on_progress:
        verdict = verify_log(
            log_file(log), executor.value, on_progress, _replacements(replace or [])
        )
    if as_json:
        print_json(verdict.to_json())
    else:
        console = stdout()
        what = "[green]identical[/green]" if verdict.identical else "[red]diverged[/red]"
        console.print(
            f"{what}: {verdict.steps} steps, {verdict.compared_messages} messages, "
            f"{verdict.compared_bytes / 1e6:.1f} MB compared, {verdict.executor}, "
            f"{verdict.duration_s:.1f} s of run at {verdict.realtime_factor:.1f} times real time"
        )
        for line in verdict.notes:
            console.print(line, markup=False)
        if verdict.first_difference is not None:
            fail(f"{log}: {verdict.first_difference}")
    if not verdict.identical:
        raise typer.Exit(1)


def replay(
    log: Log,
    paced: Annotated[
        bool,
        typer.Option("--paced", help="Re-publish at the recorded times, for looking; the default."),
    ] = False,
    replace: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NODE=module:Class",
            help="What if this node had been another? May be given several times.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="New directory for the what-if run. Default: the next runs/what-if-N."),
    ] = None,
    endpoint: Annotated[
        str,
        typer.Option(help="Where to publish what is played, e.g. ipc:///tmp/played. Default: any."),
    ] = "",
    as_json: Json = False,
) -> None:
    """Play a log for looking, or re-run it with a node replaced (what-if).

    In a what-if run the recorded sensors do not react to the new node. It is deterministic against
    itself. Exit code 2 when the log or a replacement can't be used.
    """
    from vibrissa.processes.replay import play, what_if

    if paced and replace:
        raise typer.BadParameter("--paced plays a log as it is; it can't go with --replace")
    if not replace:
        with progress_bar() as on_progress:
            played = play(log_file(log), on_progress, endpoint)
        _report(played, as_json)
        return
    out = out or next_directory("what-if")
    with progress_bar() as on_progress:
        summary = what_if(log_file(log), _replacements(replace), out, on_progress)
    _report(summary, as_json)


VERBS = (
    (verify, "vibrissa verify runs/first --executor lockstep"),
    (replay, "vibrissa replay runs/first --replace whisk=mylab.whisking:Node --out runs/if"),
)


def _report(found: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(found)
        return
    for key, value in found.items():
        stdout().print(f"{key}: {value}", markup=False)


def _replacements(texts: list[str]) -> dict[str, str]:
    """NODE=module:Class as typed. What is wrong behind the "=" is said where it is imported."""
    replacements = {}
    for text in texts:
        node, equals, target = text.partition("=")
        if not equals:
            raise typer.BadParameter(f"--replace: expected NODE=module:Class, found {text!r}")
        replacements[node] = target
    return replacements
