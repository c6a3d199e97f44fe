"""The command `vibrissa`: its verbs, and what an error looks like to whoever typed it."""

from __future__ import annotations

import errno
import sys
from typing import Annotated

import typer

from vibrissa import __version__
from vibrissa.tools import (
    bench,
    calibrate,
    control,
    doctor,
    export,
    logs,
    new_controller,
    rerun,
    run,
    tune,
)
from vibrissa.tools.console import fail
from vibrissa.tools.experiment import command as experiment

FAILED = 1
"""Exit code of a run that ended early, a re-run that diverged, a log that lost something."""
UNUSABLE = 2
"""Exit code for input that can't be used: bad file, bad option, occupied directory or port."""

app = typer.Typer(
    name="vibrissa",
    help="Closed-loop active touch: run whisker experiments at 2 kHz, record them, and re-run "
    "them to the same bytes.",
    epilog="First steps: `vibrissa doctor`, `vibrissa run --duration 30 --out runs/first`, "
    "`vibrissa verify runs/first`, `vibrissa plot runs/first`",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"vibrissa {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


for room in (
    run,
    calibrate,
    control,
    new_controller,
    rerun,
    logs,
    tune,
    export,
    experiment,
    bench,
    doctor,
):
    for verb, example in room.VERBS:
        app.command(example.split()[1], epilog=f"Example: `{example}`")(verb)


def main() -> None:
    """Run the command line; what its user can mend becomes one line, a bug shows its traceback."""
    try:
        app()
    except Exception as error:
        line = explain(error)
        if line is None:
            raise
        fail(line)
        sys.exit(UNUSABLE)


def explain(error: Exception) -> str | None:
    """The one line for an error that its reader can mend, None for a bug.

    Errors that this project defines are made for readers: one line with what, where, and why.
    """
    if type(error).__module__.startswith("vibrissa."):
        return str(error)
    if isinstance(error, OSError) and (error.filename or error.errno == errno.ENOSPC):
        return f"{error.filename or 'output'}: {error.strerror}"
    return None
