"""Simulate: the closed loop without real time. One seed, one result, in every executor."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from vibrissa.messages.codec import CODECS
from vibrissa.messages.types import TICK_HZ, TICK_NS, Event, Order, WhiskCalibration
from vibrissa.processes import provenance
from vibrissa.processes.config import Experiment
from vibrissa.processes.framelog import FrameLog
from vibrissa.processes.group import Group, Steps
from vibrissa.processes.kinds import scheduled_slots
from vibrissa.processes.layout import SUPERVISOR_HEARS
from vibrissa.processes.lockstep import Workers
from vibrissa.processes.node import Step, Stepper, counters, timer_frame
from vibrissa.processes.rebuild import make_stepper
from vibrissa.processes.receipts import ReceiptBook
from vibrissa.processes.requests import Requests
from vibrissa.processes.results import Executor, OnProgress, Progress, RunError, silent
from vibrissa.processes.table import PROCESSES, ROWS

RECEIPT_BATCH = 400
PROGRESS_TICKS = 1000
COMPLETED = "completed"


class Recording:
    """Logs every step of a group of nodes: outputs as they come, receipts in fixed batches."""

    def __init__(self, log: FrameLog, nodes: Mapping[str, Any]) -> None:
        self.log = log
        self._books = {name: ReceiptBook(name) for name in nodes}
        self.on_output: Callable[[bytes], None] = lambda _frame: None
        self.steps = 0
        self.t = 0

    def stepped(self, steps: Steps, _frame: bytes, step: Step) -> None:
        for output in step.outputs:
            self.log.write(output)
            self.on_output(output)
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
def _members(
    names: Sequence[str], experiment: Experiment, executor: Executor
) -> Iterator[dict[str, Steps]]:
    if executor == "lockstep":
        with Workers(experiment, {}) as workers:
            yield {runner.name: runner for runner in workers.start(names)}
    else:
        yield {name: make_stepper(name, experiment, {}) for name in names}


def simulate(
    experiment: Experiment,
    out: Path,
    executor: Executor = "fused",
    on_progress: OnProgress = silent,
) -> dict[str, Any]:
    """Run an experiment in logical time; write out/run.mcap and out/summary.json.

    Raises RunError when the rig is not virtual, and when the directory exists or can't be made.
    """
    if not experiment.rig.virtual:
        rig = experiment.rig
        raise RunError(
            f"rig.head {rig.head!r}, rig.arm {rig.arm!r}: only a virtual rig can be simulated"
        )
    make_directory(out)
    text = experiment.model_dump_json()
    names = [*PROCESSES, *scheduled_slots(experiment)]
    meta = provenance.metadata(text, "simulate") | {"nodes": ",".join(names)}
    run_id = f"simulate-{meta['config_hash'][:16]}"
    log = FrameLog(out / "run.mcap", run_id, meta)
    began = time.monotonic()
    with _members(names, experiment, executor) as members:
        recording = Recording(log, members)
        desk = _Desk(experiment, log)
        group = Group([(members[n], ROWS[n].hears) for n in names], recording.stepped)
        desk.group = group
        recording.on_output = desk.heard
        desk.decide("start", "simulation")
        for swap in experiment.swap:
            desk.requests.schedule(swap)
        for tick in range(experiment.ticks):
            desk.tick = tick
            group.feed(timer_frame("rig", tick))
            desk.requests.poll()
            if desk.cause != COMPLETED:
                break
            if tick % PROGRESS_TICKS == 0:
                on_progress(Progress("simulating", tick / TICK_HZ, experiment.run.duration))
        else:
            desk.tick = experiment.ticks
        desk.decide("stop", desk.cause)
        recording.finish(desk.cause)
        counted = {n: counters(m) for n, m in members.items() if isinstance(m, Stepper)}
    elapsed = time.monotonic() - began
    sampler = counted.get("sampler", {})
    summary = {
        "ok": desk.cause == COMPLETED,
        "cause": desk.cause,
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
        "events": desk.events,
        "log": str((out / "run.mcap").absolute()),
        "run_id": run_id,
        "seed": experiment.run.seed,
    }
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    return summary


class _Desk:
    """What the supervisor of a live run puts on the bus, and the requests it serves."""

    def __init__(self, experiment: Experiment, log: FrameLog) -> None:
        self.experiment = experiment
        self.tick = 0
        self.group: Group
        self.events: list[dict[str, Any]] = []
        self.cause = COMPLETED
        self.requests = Requests(self)
        self._log = log
        self._seq: collections.Counter[str] = collections.Counter()
        self._calibration: WhiskCalibration | None = None

    def decide(self, kind: str, cause: str) -> None:
        """A decision that every node takes as an input."""
        self.events.append({"tick": self.tick, "kind": kind, "node": "supervisor", "cause": cause})
        self._publish("run.event", Event(self.tick, kind, "supervisor", cause))

    def heard(self, frame: bytes) -> None:
        """Take what nodes say to a supervisor."""
        topic = frame[: frame.find(b"\0")].decode()
        if topic not in SUPERVISOR_HEARS:
            return
        message = CODECS[topic].decode(frame)
        self.requests.heard(message)
        if topic == "whisk.calibration":
            self._calibration = message.body
        elif topic in ("node.event", "whisk.failure"):
            event: Event = message.body
            self.events.append(dataclasses.asdict(event))
        if topic == "whisk.failure":
            self.requests.lost(message.source)
            if not self.requests.slots:
                self.cause = f"no controller left: {message.body.cause}"

    def order(self, order: Order) -> None:
        """Put an order on the bus."""
        self._publish("run.order", order)

    def start_slot(self, slot: str, controller: str) -> None:
        """Slots of the schedule are there from the start."""

    def slot_ready(self, slot: str) -> bool:
        """A slot of the simulation is always ready."""
        return True

    def hand_over_calibration(self) -> bool:
        """Repeat the calibration for newcomers; False when there is none yet."""
        if self._calibration is None:
            return False
        self._publish("run.calibration", self._calibration)
        return True

    def _publish(self, topic: str, body: Any) -> None:
        seq = self._seq[topic]
        self._seq[topic] += 1
        frame = CODECS[topic].encode("supervisor", 0, seq, self.tick * TICK_NS, body)
        self._log.write(frame)
        self.group.feed(frame)


def make_directory(out: Path) -> None:
    """Make a run's directory. Raises RunError when it exists or can't be made."""
    try:
        out.mkdir(parents=True)
    except FileExistsError:
        raise RunError(f"{out}: exists; a run never overwrites another") from None
    except OSError as error:
        raise RunError(f"{out}: {error.strerror}") from None
