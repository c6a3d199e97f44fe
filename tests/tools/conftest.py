"""A short simulated run, and the command line called as a person would."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.tools.mapping import write_log
from vibrissa.messages.codec import decode, encode
from vibrissa.messages.log import LogWriter
from vibrissa.messages.log_format import Record
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes.framelog import frame_of
from vibrissa.tools.cli import main

EXPERIMENT = """\
[run]
duration = 3
[whisk]
calibration_cycles = 1
"""


@dataclasses.dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str


def vibrissa(*arguments: object) -> Outcome:
    """Call the command line in this process; a traceback would come through as an exception."""
    out, err = io.StringIO(), io.StringIO()
    before, sys.argv = sys.argv, ["vibrissa", *map(str, arguments)]
    code = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as leaving:
        code = int(leaving.code or 0)
    finally:
        sys.argv = before
    return Outcome(code, out.getvalue(), err.getvalue())


def refused(outcome: Outcome, *words: str) -> bool:
    """Exit code 2, nothing on stdout, one line on stderr that holds the words."""
    lines = outcome.err.splitlines()
    return (
        outcome.code == 2
        and outcome.out == ""
        and len(lines) == 1
        and all(word in lines[0] for word in words)
    )


def rewrite(log: Path, out: Path, change: Callable[[Record], Record | None]) -> Path:
    """A whole, closed log with the records changed, or left out where `change` gives None."""
    reader = LogReader(log)
    index = {(c.topic, c.source): i for i, c in enumerate(reader.channels)}
    with LogWriter(
        out, run_id=reader.run_id, channels=reader.channels, metadata=reader.metadata
    ) as writer:
        for record in reader:
            kept = change(record)
            if kept is not None:
                writer.write(index[kept.topic, kept.source], kept.seq, kept.t, kept.data)
    return out


def with_body(record: Record, **fields: object) -> Record:
    """A record whose message has other field values."""
    message = decode(frame_of(record))
    body = dataclasses.replace(message.body, **fields)
    return record._replace(data=encode(message._replace(body=body))[len(record.topic) + 1 :])


@pytest.fixture(scope="session")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("experiment") / "short.toml"
    path.write_text(EXPERIMENT)
    return path


@pytest.fixture(scope="session")
def simulated(experiment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a simulated run of 3 s."""
    out = tmp_path_factory.mktemp("runs") / "simulated"
    outcome = vibrissa("simulate", experiment, "--out", out, "--json")
    assert outcome.code == 0, outcome.err
    return out


@pytest.fixture(scope="session")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a log of three laps: two anticlockwise, one clockwise."""
    out = tmp_path_factory.mktemp("runs") / "mapped"
    out.mkdir()
    write_log(out / "run.mcap")
    return out
