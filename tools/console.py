"""How the command line talks: results to stdout, progress and errors to stderr."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

if TYPE_CHECKING:
    from rich.table import Table

    from vibrissa.processes.results import OnProgress, Progress

Json = Annotated[bool, typer.Option("--json", help="Print pure JSON on stdout.")]
Log = Annotated[Path, typer.Argument(help="A recorded run: run.mcap, or the directory it is in.")]

REFRESH_S = 0.2
FILE_WIDTH = 120
"""Columns of a table that goes to a file or a pipe."""


def stdout() -> Console:
    """Where results go. Made when needed, so that a redirected stdout is respected."""
    width = None if sys.stdout.isatty() else FILE_WIDTH
    return Console(highlight=False, soft_wrap=True, width=width)


def stderr() -> Console:
    """Where progress and errors go."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


def fail(message: str) -> None:
    """One red line on stderr."""
    line = " ".join(part.strip() for part in message.splitlines() if part.strip())
    stderr().print(f"vibrissa: {line}", style="red", markup=False)


def note(message: str) -> None:
    """One line on stderr for the person who waits."""
    stderr().print(message, markup=False)


def log_file(path: Path) -> Path:
    """The log a person means by a path: the file itself, or run.mcap of a run directory."""
    return path / "run.mcap" if path.is_dir() else path


def print_json(value: Any) -> None:
    """Write a result as JSON; what JSON has no word for (NaN, infinity) becomes null."""
    sys.stdout.write(json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def write_json(path: Path, value: Any) -> None:
    """Write a result to a file, as `print_json` does."""
    path.write_text(json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """A value as JSON has it: numpy scalars and arrays, paths and tuples made ordinary."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return os.fspath(value)
    return value


def table(title: str, columns: tuple[str, ...], *, text_columns: int = 1) -> Table:
    """A table whose first `text_columns` columns are words and whose others are numbers."""
    from rich import box
    from rich.table import Table

    made = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for index, column in enumerate(columns):
        made.add_column(column, justify="left" if index < text_columns else "right")
    return made


@contextlib.contextmanager
def busy(what: str) -> Iterator[None]:
    """A sign of life on stderr for work of unknown length; nothing where stderr is no terminal."""
    console = stderr()
    with console.status(what) if console.is_terminal else contextlib.nullcontext():
        yield


@contextlib.contextmanager
def progress_bar() -> Iterator[OnProgress]:
    """A bar on stderr for what takes long; nothing where stderr is no terminal."""
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bars

    console = stderr()
    if not console.is_terminal:
        yield lambda progress: None
        return
    bars = Bars(
        TextColumn("{task.description:<15}"),
        BarColumn(),
        TextColumn("{task.fields[time]}"),
        TextColumn("{task.fields[note]}", style="dim"),
        console=console,
        auto_refresh=False,  # a refreshing thread would take time from the run it reports on
        transient=True,
    )
    tasks: dict[str, Any] = {}
    shown = 0.0

    def show(progress: Progress) -> None:
        nonlocal shown
        phase, done, total = progress.phase, progress.done_s, progress.total_s
        new = phase not in tasks
        if new:
            tasks[phase] = bars.add_task(phase, total=total or None, time="", note="")
        now = time.monotonic()
        if new or now - shown >= REFRESH_S:
            shown = now
            told = f"{done:.1f} of {total:.1f} s" if total else f"{done:.1f} s"
            bars.update(tasks[phase], completed=done, time=told, note=progress.note)
            bars.refresh()

    with bars:
        yield show
