"""One short experiment, simulated once and run live once, for every test that needs a log."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from vibrissa.messages.log_format import Record
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.simulate import simulate
from vibrissa.processes.supervisor import run_live

# The first call of a compiled function compiles it, however long that takes.
settings.register_profile("vibrissa", deadline=None)
settings.load_profile("vibrissa")

SHORT = """\
[run]
duration = {duration}
seed = {seed}
together = {together}
transport = "{transport}"
tcp_port = {tcp_port}
[whisk]
period = 0.4
calibration_cycles = 1
[arm]
speed = 0.2
lift = 0.05
"""
"""Calibrated after 0.4 s, lowered after 1.5 s, travelling from then on, retracting from 2.5 s."""


def short_experiment(
    folder: Path,
    *,
    duration: float = 3.0,
    seed: int = 7,
    together: list[list[str]] | None = None,
    transport: str = "ipc",
    tcp_port: int = 5790,
) -> Experiment:
    """The short experiment, read from a file as a person would write it."""
    path = folder / f"short-{len(list(folder.glob('short-*.toml')))}.toml"
    path.write_text(
        SHORT.format(
            duration=duration,
            seed=seed,
            together=together or [],
            transport=transport,
            tcp_port=tcp_port,
        )
    )
    return load_experiment(path)


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A finished run: its log, its records in the order of the file, its summary."""

    log: Path
    summary: dict[str, Any]
    records: list[Record]

    @classmethod
    def of(cls, out: Path, summary: dict[str, Any]) -> Recorded:
        return cls(out / "run.mcap", summary, list(LogReader(out / "run.mcap")))


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """The short experiment."""
    return short_experiment(tmp_path_factory.mktemp("experiment"))


@pytest.fixture(scope="session")
def simulated_run(short: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The short experiment, simulated."""
    out = tmp_path_factory.mktemp("runs") / "simulated"
    return Recorded.of(out, simulate(short, out))


@pytest.fixture(scope="session")
def live_run(short: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The short experiment, run live, every node in a process of its own."""
    out = tmp_path_factory.mktemp("runs") / "live"
    return Recorded.of(out, run_live(short, out))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What needs a live run's log needs a live run."""
    for item in items:
        if "live_run" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.live)
