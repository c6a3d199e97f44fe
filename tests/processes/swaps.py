"""Runs with controllers that come and go, simulated and live, and what their logs tell."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from vibrissa.messages.codec import decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.types import TICK_HZ
from vibrissa.processes.client import Client
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.supervisor import Supervisor
from vibrissa.processes.verify import verify

FAULTS = "tests.controllers_for_tests"
EXPERIMENT = """\
[run]
duration = {duration}
[whisk]
period = 0.4
controller = "{controller}"
calibration_cycles = 1
[controllers]
{controllers}
{swaps}
"""


def experiment(
    folder: Path,
    *,
    duration: float,
    swaps: tuple[tuple[int, str], ...] = (),
    controller: str = "open_loop",
    **controllers: str,
) -> Experiment:
    """Short cycles, named controllers ("module:Class"), swaps (cycle, name)."""
    named = "\n".join(f'{name} = "{target}"' for name, target in controllers.items())
    listed = "\n".join(f'[[swap]]\nat_cycle = {cycle}\nto = "{name}"' for cycle, name in swaps)
    path = folder / "experiment.toml"
    path.write_text(
        EXPERIMENT.format(duration=duration, controller=controller, controllers=named, swaps=listed)
    )
    return load_experiment(path)


def faulty(name: str) -> str:
    """A controller of `controllers_for_tests` as the experiment names it."""
    return f"{FAULTS}:{name}"


class Live:
    """A live run in a thread of its own, and clients of it."""

    def __init__(self, experiment: Experiment, out: Path) -> None:
        self.supervisor = Supervisor(experiment, out, lambda _progress: None)
        self.summary: dict[str, Any] = {}
        self.out = out
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        self.summary = self.supervisor.run()

    def until(self, done: Callable[[], bool], seconds: float = 120.0) -> None:
        """Wait for something to happen."""
        deadline = time.monotonic() + seconds
        while not done():
            assert self._thread.is_alive(), f"the run has ended: {self.supervisor.cause}"
            assert time.monotonic() < deadline, "it did not happen"
            time.sleep(0.02)

    def calibrated(self) -> None:
        """Wait until the first controller has the drives and calibration is over."""
        self.until(lambda: any(e["kind"] == "start" for e in self.supervisor.events))
        self.until(lambda: self.supervisor.calibration is not None)

    def told(self, kind: str, *words: str) -> dict[str, Any]:
        """Wait for an event that holds all the words."""
        found: list[dict[str, Any]] = []

        def happened() -> bool:
            found.extend(
                e
                for e in self.supervisor.events
                if e["kind"] == kind and all(w in f"{e['node']} {e['cause']}" for w in words)
            )
            return bool(found)

        self.until(happened)
        return found[0]

    def ticks_from_now(self, ticks: int) -> None:
        at = self.supervisor.tick + ticks
        self.until(lambda: self.supervisor.tick >= at)

    def client(self) -> Client:
        return Client(self.out)

    def finish(self) -> dict[str, Any]:
        """End the run as its operator would."""
        self.supervisor.interrupt()
        self._thread.join(60)
        assert not self._thread.is_alive()
        return self.summary


@contextlib.contextmanager
def live(made: Experiment, out: Path) -> Iterator[Live]:
    run = Live(made, out)
    try:
        run.calibrated()
        yield run
    finally:
        run.finish()


def swap(client: Client, name: str, patience: float = 20.0) -> str:
    """Swap, again and again while a busy machine makes the newcomer late."""
    deadline = time.monotonic() + patience
    while True:
        try:
            return client.swap(name)
        except Exception as error:
            late = any(w in str(error) for w in ("not ready", "stale", "jump"))
            if not late or time.monotonic() > deadline:
                raise


def events(out: Path) -> list[tuple[int, str, str]]:
    """(tick, kind, cause) of every event and decision in a log, in its order."""
    found = []
    for record in LogReader(out / "run.mcap"):
        if record.topic in ("node.event", "run.event", "whisk.failure"):
            body = decode(frame_of(record)).body
            found.append((body.tick, body.kind, f"{body.node} {body.cause}"))
    return found


def owners(out: Path) -> dict[int, str]:
    """tick -> who commanded the drives."""
    found: dict[int, str] = {}
    for record in LogReader(out / "run.mcap"):
        if record.topic == "head.command":
            body = decode(frame_of(record)).body
            assert body.tick not in found, "two commands in one tick"
            found[body.tick] = body.controller
    return found


def samples(out: Path) -> list[int]:
    """The ticks of all samples in a log."""
    return [
        decode(frame_of(record)).body.tick
        for record in LogReader(out / "run.mcap")
        if record.topic == "head.sample"
    ]


def identical(out: Path) -> bool:
    """Whether the log re-runs to the same bytes."""
    verdict = verify(out / "run.mcap")
    return verdict.identical


def seconds(ticks: int) -> float:
    return ticks / TICK_HZ
