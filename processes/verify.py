"""Verify: re-run every node of a log from its receipts and compare all outputs byte for byte.

Each node gets the recorded messages it consumed, in the order of its receipts. Its outputs must be
the recorded ones, and the running digest in every receipt must come out the same. As every node
is fed what was recorded, a difference stays where it arose, and if no node differs the whole run is
identical by induction. The log is read as a stream: memory does not grow with its length.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import gc
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from vibrissa.messages.codec import decode, epoch_of, header
from vibrissa.messages.errors import MessageError
from vibrissa.messages.log_format import LogError, Record
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.topics import TOPICS
from vibrissa.messages.types import Order
from vibrissa.processes import provenance
from vibrissa.processes.config import Experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.lockstep import LocalRunner, RemoteRunner, Result, Workers
from vibrissa.processes.node import timer_frame
from vibrissa.processes.rebuild import (
    Replacements,
    check_replacements,
    experiment_of,
    make_stepper,
    open_log,
)
from vibrissa.processes.receipts import Entry, Stream, entries
from vibrissa.processes.results import (
    Difference,
    Executor,
    OnProgress,
    Progress,
    UnusableLogError,
    Verdict,
    silent,
)
from vibrissa.processes.table import PROCESSES, ROWS, SLOTS

PUMP_RECORDS: Final = 4000
AFTERMATH_NS: Final = 500_000_000
"""How far to read on after a difference, so that its cause is found before its consequences."""


@dataclasses.dataclass(slots=True)
class Finding:
    """A difference, the message that differs and the message whose consumption showed it."""

    difference: Difference
    t: int
    output: tuple[Stream, int] | None
    consumed: tuple[Stream, int]


class NodeCheck:
    """The re-run of one node against its receipts and recorded outputs."""

    def __init__(self, runner: LocalRunner | RemoteRunner) -> None:
        self.name = runner.name
        self._runner = runner
        self._entries: collections.deque[Entry] = collections.deque()
        self._inbox: dict[Stream, dict[int, bytes]] = collections.defaultdict(dict)
        self._expected: dict[str, collections.deque[bytes]] = collections.defaultdict(
            collections.deque
        )
        self._batch: list[Entry] = []
        self._frames: list[bytes] = []
        self._next_step = 0
        self._decided = -1
        self.steps = 0
        self.messages = 0
        self.bytes = 0
        self.finding: Finding | None = None

    def add_receipts(self, frame: bytes) -> None:
        """Raises UnusableLogError when receipts are missing or contradict themselves."""
        try:
            found = list(entries(decode(frame)))
        except ValueError as error:
            raise UnusableLogError(f"a receipt of {self.name} can't be read: {error}") from None
        if found and found[0].step != self._next_step:
            raise UnusableLogError(
                f"receipts of {self.name} are missing: expected step {self._next_step}, "
                f"found {found[0].step}"
            )
        self._next_step += len(found)
        if self.finding is None:
            self._entries.extend(found)

    def add_input(self, stream: Stream, seq: int, frame: bytes) -> None:
        if self.finding is None:
            self._inbox[stream][seq] = frame

    def add_output(self, topic: str, frame: bytes) -> None:
        if self.finding is None:
            self._expected[topic].append(frame)

    def submit(self) -> None:
        """Hand every step whose input is there to the runner."""
        while self._entries and self.finding is None:
            entry = self._entries[0]
            topic, source, epoch = entry.stream
            if topic == "host.timer" and source == self.name and epoch == 0:
                frame = timer_frame(self.name, entry.seq)
            else:
                found = self._inbox[entry.stream].pop(entry.seq, None)
                if found is None:
                    break
                frame = found
            if topic == "run.event":
                self._decided = entry.seq
            self._batch.append(self._entries.popleft())
            self._frames.append(frame)
        self._runner.submit(self._frames)

    def collect(self) -> None:
        """Compare what came out with what was recorded."""
        results = self._runner.collect()
        for entry, frame, result in zip(self._batch, self._frames, results, strict=True):
            self.finding = self._compare(entry, frame, result)
            if self.finding is not None:
                break
            self.steps += 1
        self._batch.clear()
        self._frames = []

    def leftovers(self, last_decision: int) -> str | None:
        """What a complete log should not leave: a receipt without its message, or the reverse."""
        if self.finding is not None:
            return None
        if self._entries:
            entry = self._entries[0]
            topic, source, epoch = entry.stream
            return (
                f"{self.name}, step {entry.step}: consumed {topic} #{entry.seq} of {source} "
                f"(epoch {epoch}), which is not in the log"
            )
        for topic, frames in self._expected.items():
            if frames:
                seq = header(frames[0])[3]
                return f"{self.name}: no receipt accounts for its {topic} #{seq}"
        if self.name in PROCESSES and self._decided < last_decision:
            return (
                f"{self.name}: its receipts end at step {self._next_step}, before it consumed "
                f"run.event #{last_decision}"
            )
        return None

    def _compare(self, entry: Entry, frame: bytes, result: Result) -> Finding | None:
        digest, outputs, error = result
        if error:
            return self._broken(entry, frame, "step", f"digest {entry.digest:08x}", error)
        for output in outputs:
            topic = output[: output.find(b"\0")].decode()
            if not TOPICS[topic].recorded:
                continue
            expected = self._expected[topic]
            recorded = expected.popleft() if expected else None
            if recorded != output:
                field, then, now = differing_field(recorded, output)
                _, source, epoch, seq, t = header(output)
                difference = Difference(self.name, entry.step, topic, field, then, now, t * 1e-9)
                altered = ((topic, source, epoch), seq)
                return Finding(difference, t, altered, (entry.stream, entry.seq))
            self.messages += 1
            self.bytes += len(output)
        if digest != entry.digest:
            now = f"digest {digest:08x} (the order of receipts or an input was altered)"
            return self._broken(entry, frame, "receipt", f"digest {entry.digest:08x}", now)
        return None

    def _broken(self, entry: Entry, frame: bytes, field: str, then: str, now: str) -> Finding:
        """A step that went otherwise than its receipt says, whatever was said in it."""
        t = header(frame)[4]
        topic = entry.stream[0]
        difference = Difference(self.name, entry.step, topic, field, then, now, t * 1e-9)
        return Finding(difference, t, None, (entry.stream, entry.seq))


def differing_field(recorded: bytes | None, recomputed: bytes) -> tuple[str, str, str]:
    """(field, recorded value, recomputed value) of the first field that differs."""
    now = decode(recomputed)
    if recorded is None:
        return "message", "no message", f"#{now.seq}"
    try:
        then = decode(recorded)
    except MessageError as error:
        return "message", f"unreadable ({error})", f"#{now.seq}"
    for name in ("source", "epoch", "seq", "t"):
        if getattr(then, name) != getattr(now, name):
            return name, str(getattr(then, name)), str(getattr(now, name))
    for field in dataclasses.fields(now.body):
        a, b = getattr(then.body, field.name), getattr(now.body, field.name)
        if isinstance(b, np.ndarray):
            if a.tobytes() != b.tobytes():
                return _differing_element(field.name, a, b)
        elif repr(a) != repr(b):
            return field.name, repr(a), repr(b)
    return "encoding", f"{len(recorded)} bytes", f"{len(recomputed)} bytes"


def _differing_element(name: str, a: Any, b: Any) -> tuple[str, str, str]:
    if a.shape != b.shape:
        return name, f"shape {a.shape}", f"shape {b.shape}"
    width = a.dtype.itemsize
    one = np.frombuffer(a.tobytes(), np.uint8).reshape(-1, width)
    two = np.frombuffer(b.tobytes(), np.uint8).reshape(-1, width)
    index = int(np.flatnonzero((one != two).any(axis=1))[0])
    return f"{name}[{index}]", repr(a.reshape(-1)[index].item()), repr(b.reshape(-1)[index].item())


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
        checks = Checks(start, names)
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
                on_progress(Progress(f"{executor} re-run", t * 1e-9, experiment.run.duration))
                if stop_at is None and any(c.finding for c in checks.all):
                    stop_at = t + AFTERMATH_NS
                if stop_at is not None and t > stop_at:
                    break
        checks.pump()
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


def first_cause(findings: Sequence[Finding]) -> Difference | None:
    """The earliest difference that is not merely the consequence of consuming another one."""
    altered = {f.output for f in findings if f.output is not None}
    roots = [f for f in findings if f.consumed not in altered] or list(findings)
    return min(roots, key=lambda f: f.t).difference if roots else None


class Checks:
    """The checks of all nodes; every record goes to those that said or heard it."""

    def __init__(self, start: Start, names: Sequence[str]) -> None:
        self._start = start
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
            self.last_decision = seq
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

    def _open_slot(self, frame: bytes) -> None:
        """A controller was loaded into a slot: from here on the slot's node is re-run, too."""
        order: Order = decode(frame).body
        if order.kind == "open" and order.node in SLOTS and order.node not in self._by_name:
            self._add([order.node])

    def _add(self, names: Sequence[str]) -> None:
        for runner in self._start(names):
            check = self._by_name[runner.name] = NodeCheck(runner)
            for topic in ROWS[runner.name].hears:
                if topic in self._hearers:
                    self._hearers[topic].append(check)
