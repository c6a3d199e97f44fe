"""Verify: re-run every node of a log from its receipts and compare all outputs byte for byte.

Each node gets the recorded messages it consumed, in the order of its receipts. Its outputs must be
the recorded ones, and the running digest in every receipt must come out the same. As every node
is fed what was recorded, a difference stays where it arose, and if no node differs the whole run is
identical by induction. The log is read as a stream: memory does not grow with its length.
"""

from __future__ import annotations

import contextlib
import gc
import importlib.util
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from vibrissa.messages.codec import decode, epoch_of, header
from vibrissa.messages.errors import MessageError
from vibrissa.messages.log_format import LogError, Record
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.topics import TOPICS
from vibrissa.messages.types import TICK_NS, Event, Order
from vibrissa.processes import controllers, provenance, slams
from vibrissa.processes.config import Experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.lockstep import LocalRunner, RemoteRunner, Workers
from vibrissa.processes.node_check import NodeCheck, first_cause
from vibrissa.processes.rebuild import (
    Replacements,
    check_replacements,
    experiment_of,
    make_stepper,
    open_log,
)
from vibrissa.processes.results import (
    Executor,
    OnProgress,
    Progress,
    UnusableLogError,
    Verdict,
    silent,
)
from vibrissa.processes.table import ALL_SLOTS, PROCESSES, ROWS, SLAM_SLOTS

PUMP_RECORDS: Final = 4000
AFTERMATH_NS: Final = 500_000_000
"""How far to read on after a difference, so that its cause is found before its consequences, and
after the loss of a process, so that what it said last has been read."""


def verify(
    path: Path,
    executor: Executor = "fused",
    on_progress: OnProgress = silent,
    replacements: Replacements | None = None,
) -> Verdict:
    """Re-run a log and compare. Raises UnusableLogError when it can't be re-run at all."""
    replacements = replacements or {}
    check_replacements(replacements)
    reader = open_log(path, allow_cut=True)
    experiment = experiment_of(reader)
    made_with = reader.metadata.get("replacements", "")
    if made_with and not replacements:
        raise UnusableLogError(
            f"{path}: a what-if run with {made_with}; name the same with --replace to verify it"
        )
    names = reader.metadata.get("nodes", ",".join(PROCESSES)).split(",")
    notes = provenance.mismatches(reader.metadata)
    if not experiment.rig.virtual:
        rig = experiment.rig
        notes.append(f"rig: recorded inputs, not re-run (head {rig.head}, arm {rig.arm})")
    with _runners(executor, experiment, replacements) as start, _no_collections():
        checks = Checks(start, names, experiment, path)
        return _verify(reader, experiment, executor, checks, notes, on_progress)


@contextlib.contextmanager
def _no_collections() -> Iterator[None]:
    """Without the cyclic garbage collector: a re-run holds many objects and makes no cycles."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


Start = Callable[[Sequence[str]], Sequence[LocalRunner | RemoteRunner]]
"""Makes runners for nodes."""


@contextlib.contextmanager
def _runners(
    executor: Executor, experiment: Experiment, replacements: Replacements
) -> Iterator[Start]:
    if executor == "lockstep":
        with Workers(experiment, replacements) as workers:
            yield workers.start
    else:
        yield lambda names: [LocalRunner(make_stepper(n, experiment, replacements)) for n in names]


def _verify(
    reader: LogReader,
    experiment: Experiment,
    executor: Executor,
    checks: Checks,
    notes: list[str],
    on_progress: OnProgress,
) -> Verdict:
    began = time.monotonic()
    t, stop_at = 0, None
    try:
        for count, record in enumerate(reader):
            checks.take(record)
            t = max(t, record.t)
            if count % PUMP_RECORDS == 0:
                checks.pump()
                checks.settle(t - AFTERMATH_NS)
                on_progress(Progress(f"{executor} re-run", t * 1e-9, experiment.run.duration))
                if stop_at is None and any(c.finding for c in checks.all):
                    stop_at = t + AFTERMATH_NS
                if stop_at is not None and t > stop_at:
                    break
        checks.pump()
        checks.settle(t)
    except LogError as error:
        raise UnusableLogError(str(error)) from None
    except MessageError as error:
        raise UnusableLogError(f"{reader.path}: a message can't be replayed: {error}") from None
    elapsed = time.monotonic() - began
    first = first_cause([c.finding for c in checks.all if c.finding is not None])
    cut = "recovered" in reader.extra or reader.complete is False
    died = reader.extra.get("died", {}).get("processes", "")
    if first is None:
        lacking = [why for c in checks.all if (why := c.leftovers(checks.last_decision))]
        if lacking and not (cut or died):
            raise UnusableLogError(f"{reader.path}: {lacking[0]}")
        if not any(c.steps for c in checks.all):
            raise UnusableLogError(f"{reader.path}: it has no receipts, so nothing can be re-run")
        if cut or (died and lacking):
            why = f"{died} died during the run" if died else "the log is cut off"
            ends = ", ".join(f"{c.name} {c.steps}" for c in checks.all)
            notes.append(f"{why}; verified to the last complete steps: {ends}")
        notes += checks.recalled
    return Verdict(
        identical=first is None,
        executor=executor,
        steps=sum(c.steps for c in checks.all),
        compared_bytes=sum(c.bytes for c in checks.all),
        compared_messages=sum(c.messages for c in checks.all),
        duration_s=t * 1e-9,
        realtime_factor=round(t * 1e-9 / max(elapsed, 1e-9), 2),
        first_difference=first,
        notes=tuple(notes),
    )


class Checks:
    """The checks of all nodes; every record goes to those that said or heard it."""

    def __init__(
        self, start: Start, names: Sequence[str], experiment: Experiment, path: Path
    ) -> None:
        self._start = start
        self._path = path
        self._installed = controllers.available(experiment) | slams.available(experiment)
        self._named = {*experiment.controllers.values(), *experiment.slams.values()}
        self._lost: dict[str, int] = {}
        self.recalled: list[str] = []
        """What was computed that is not in the log, one line per process that was killed."""
        self._by_name: dict[str, NodeCheck] = {}
        self._hearers: dict[str, list[NodeCheck]] = {topic: [] for topic in TOPICS}
        self.last_decision = -1
        """Number of the last run.event: a log that was closed shows that every node took it."""
        self._add(names)

    @property
    def all(self) -> list[NodeCheck]:
        return list(self._by_name.values())

    def take(self, record: Record) -> None:
        """Raises UnusableLogError for receipts and DecodeError for messages that can't be read."""
        topic, source, seq, _, _ = record
        producer = self._by_name.get(source)
        if topic == "node.receipt" and producer is not None:
            producer.add_receipts(frame_of(record))
        row = TOPICS.get(topic)
        if row is None or topic in ("node.receipt", "node.telemetry"):
            return
        frame = frame_of(record)
        if topic == "run.order":
            self._open_slot(frame)
        elif topic == "run.event":
            self._decided(frame, seq)
        if producer is not None and row.compared:
            producer.add_output(topic, frame)
        hearers = self._hearers[topic]
        if hearers:
            stream = (topic, source, epoch_of(frame, topic, source))
            for check in hearers:
                if topic != "host.event" or check is producer:
                    check.add_input(stream, seq, frame)

    def pump(self) -> None:
        """Let every node take all steps it can, and compare."""
        for check in self._by_name.values():
            check.submit()
        for check in self._by_name.values():
            check.collect()

    def settle(self, t: int) -> None:
        """Recall the last words of processes that were killed up to `t` ns."""
        for name, killed in list(self._lost.items()):
            if killed <= t:
                del self._lost[name]
                self._recall(self._by_name[name])

    def _recall(self, check: NodeCheck) -> None:
        """Re-compute what a killed process said, as far as it was recorded or anybody heard it.

        The digests of those who heard it tell whether it is what they heard.
        """
        ticks: list[int] = []
        steps = check.recall()
        while check.unaccounted() or any(c.waits_for() == check.name for c in self.all):
            outputs = next(steps, None)
            if outputs is None:
                break
            for output in outputs:
                topic, source, epoch, seq, t = header(output)
                ticks.append(t // TICK_NS)
                for hearer in self._hearers[topic]:
                    hearer.add_input((topic, source, epoch), seq, output)
            self.pump()
        check.end()
        if ticks:
            self.recalled.append(
                f"{check.name} was killed; what it said in ticks {ticks[0]} to {ticks[-1]} is not "
                "in the log and was computed again from what it heard"
            )

    def _decided(self, frame: bytes, seq: int) -> None:
        event: Event = decode(frame).body
        self.last_decision = seq
        if event.kind == "lost" and event.node in self._by_name:
            self._lost[event.node] = event.tick * TICK_NS

    def _open_slot(self, frame: bytes) -> None:
        """A controller was loaded into a slot: from here on the slot's node is re-run, too."""
        order: Order = decode(frame).body
        if order.kind == "open" and order.name not in self._installed:
            raise UnusableLogError(
                f"{self._path}: {_word(order.node)} {order.name} is not installed and the run "
                f"loaded it into {order.node}; installed are {', '.join(self._installed)}"
            )
        target = self._installed.get(order.name, "") if order.kind == "assign" else ""
        module = target.partition(":")[0] if target in self._named else ""
        if module and not _findable(module):
            raise UnusableLogError(
                f"{self._path}: {_word(order.node)} {order.name} ({target}) is not installed: "
                f"there is no module {module} here"
            )
        if order.kind == "open" and order.node in ALL_SLOTS and order.node not in self._by_name:
            self._add([order.node])

    def _add(self, names: Sequence[str]) -> None:
        for runner in self._start(names):
            check = self._by_name[runner.name] = NodeCheck(runner)
            for topic in ROWS[runner.name].hears:
                if topic in self._hearers:
                    self._hearers[topic].append(check)


def _word(slot: str) -> str:
    return "slam" if slot in SLAM_SLOTS else "controller"


def _findable(module: str) -> bool:
    """Whether there is a module of this name; it may still raise an error when imported."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False
