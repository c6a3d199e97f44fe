"""Simulate: the closed loop without real time. One seed, one result, in every executor."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vibrissa.messages.codec import CODECS
from vibrissa.messages.types import TICK_HZ, TICK_NS, Event
from vibrissa.processes import provenance
from vibrissa.processes.config import Experiment
from vibrissa.processes.framelog import FrameLog
from vibrissa.processes.group import Group, Steps
from vibrissa.processes.lockstep import workers
from vibrissa.processes.node import Step, Stepper, counters, timer_frame
from vibrissa.processes.rebuild import make_stepper
from vibrissa.processes.receipts import ReceiptBook
from vibrissa.processes.results import Executor, OnProgress, Progress, RunError, silent
from vibrissa.processes.table import PROCESSES

RECEIPT_BATCH = 400
PROGRESS_TICKS = 1000


class Recording:
    """Logs every step of a group of nodes: outputs as they come, receipts in fixed batches."""

    def __init__(self, log: FrameLog, nodes: Mapping[str, Any]) -> None:
        self.log = log
        self._books = {name: ReceiptBook(name) for name in nodes}
        self.steps = 0
        self.t = 0

    def stepped(self, steps: Steps, _frame: bytes, step: Step) -> None:
        for output in step.outputs:
            self.log.write(output)
        self.steps += 1
        self.t = max(self.t, step.t)
        book = self._books[steps.name]
        book.add(step)
        if len(book) >= RECEIPT_BATCH:
            self.log.write(book.frame(step.t))

    def finish(self, cause: str) -> None:
        for book in self._books.values():
            if len(book):
                self.log.write(book.frame(self.t))
        self.log.close(cause)


@contextlib.contextmanager
def _members(experiment: Experiment, executor: Executor) -> Iterator[dict[str, Steps]]:
    if executor == "lockstep":
        with workers(PROCESSES, experiment, {}) as runners:
            yield dict(runners)
    else:
        yield {name: make_stepper(name, experiment, {}) for name in PROCESSES}


def simulate(
    experiment: Experiment,
    out: Path,
    executor: Executor = "fused",
    on_progress: OnProgress = silent,
) -> dict[str, Any]:
    """Run an experiment in logical time; write out/run.mcap and out/summary.json.

    Raises RunError when the directory exists or can't be made.
    """
    make_directory(out)
    text = experiment.model_dump_json()
    meta = provenance.metadata(text, "simulate")
    run_id = f"simulate-{meta['config_hash'][:16]}"
    log = FrameLog(out / "run.mcap", run_id, meta)
    began = time.monotonic()
    with _members(experiment, executor) as members:
        recording = Recording(log, members)
        group = Group([(members[n], PROCESSES[n].hears) for n in PROCESSES], recording.stepped)
        decide = _Decisions(log, group)
        decide("start", 0, "simulation")
        for tick in range(experiment.ticks):
            group.feed(timer_frame("rig", tick))
            if tick % PROGRESS_TICKS == 0:
                on_progress(Progress("simulating", tick / TICK_HZ, experiment.run.duration))
        decide("stop", experiment.ticks, "completed")
        recording.finish("completed")
        counted = {n: counters(m) for n, m in members.items() if isinstance(m, Stepper)}
    elapsed = time.monotonic() - began
    sampler = counted.get("sampler", {})
    summary = {
        "ok": True,
        "cause": "completed",
        "mode": "simulate",
        "executor": executor,
        "ticks": sampler.get("ticks", experiment.ticks),
        "ticks_answered": sampler.get("answered", 0),
        "cycles": counted.get("whisk", {}).get("cycles", 0),
        "messages": {
            topic: {"sent": n, "received": n, "lost": 0}
            for topic, n in sorted(log.received.items())
        },
        "realtime_factor": round(experiment.run.duration / elapsed, 2),
        "steps": recording.steps,
        "counters": counted,
        "events": decide.events,
        "log": str((out / "run.mcap").absolute()),
        "run_id": run_id,
        "seed": experiment.run.seed,
    }
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    return summary


class _Decisions:
    """What the supervisor of a live run would put on the bus."""

    def __init__(self, log: FrameLog, group: Group) -> None:
        self._log = log
        self._group = group
        self.events: list[dict[str, Any]] = []

    def __call__(self, kind: str, tick: int, cause: str) -> None:
        event = Event(tick=tick, kind=kind, node="supervisor", cause=cause)
        frame = CODECS["run.event"].encode("supervisor", 0, len(self.events), tick * TICK_NS, event)
        self.events.append({"tick": tick, "kind": kind, "node": "supervisor", "cause": cause})
        self._log.write(frame)
        self._group.feed(frame)


def make_directory(out: Path) -> None:
    """Make a run's directory. Raises RunError when it exists or can't be made."""
    try:
        out.mkdir(parents=True)
    except FileExistsError:
        raise RunError(f"{out}: exists; a run never overwrites another") from None
    except OSError as error:
        raise RunError(f"{out}: {error.strerror}") from None
