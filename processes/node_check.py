"""The re-run of one node of a log: its receipts, its inputs, and what it said against what it says.

A process that was killed takes its last receipts and messages with it, 60 ms of them at most. What
the others consumed of those is told by the others' receipts, digests included; `NodeCheck.recall`
gives it back from the inputs the process was sent.
"""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from vibrissa.messages.codec import decode, header
from vibrissa.messages.errors import MessageError
from vibrissa.messages.topics import TOPICS
from vibrissa.processes.lockstep import LocalRunner, RemoteRunner, Result
from vibrissa.processes.node import timer_frame
from vibrissa.processes.receipts import Entry, Stream, entries
from vibrissa.processes.results import Difference, UnusableLogError
from vibrissa.processes.table import PROCESSES


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
        self._inbox: dict[tuple[Stream, int], tuple[int, bytes]] = {}
        """(stream, seq) -> (its place among all inputs in the order of the log, frame)"""
        self._heard = 0
        self._consumed: dict[str, int] = {}
        """source -> place of its last input that was consumed"""
        self.over = False
        """It was killed, and what could be told of its last steps has been."""
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
        if self.finding is None and not self.over:
            self._heard += 1
            self._inbox[stream, seq] = self._heard, frame

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
                found = self._inbox.pop((entry.stream, entry.seq), None)
                if found is None:
                    break
                self._consumed[source], frame = found
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

    def waits_for(self) -> str:
        """Who said the message that the next step consumed and that is not there; may be empty."""
        if not self._entries or self.finding is not None:
            return ""
        entry = self._entries[0]
        there = (entry.stream, entry.seq) in self._inbox or entry.stream[0] == "host.timer"
        return "" if there else entry.stream[1]

    def unaccounted(self) -> bool:
        """Whether something it said is recorded whose receipt is not."""
        return self.finding is None and any(self._expected.values())

    def recall(self) -> Iterator[list[bytes]]:
        """Step on beyond the last receipt; gives, step by step, what was said and not recorded.

        Messages of one source are consumed in the order in which that source sent them, which is
        that of the log. Across sources the order is open, and ends at a message for which it could
        matter: an order to this node.
        """
        after = self._consumed
        pending = sorted(
            (place, stream, seq, frame)
            for (stream, seq), (place, frame) in self._inbox.items()
            if place > after.get(stream[1], self._heard)
        )
        for _, stream, seq, frame in pending:
            if stream[0] == "run.order" and decode(frame).body.node == self.name:
                return
            self._runner.submit([frame])
            ((_, outputs, error),) = self._runner.collect()
            if error:
                return
            recorded = [output for output in outputs if TOPICS[_topic(output)].recorded]
            said = [output for output in recorded if self._expected[_topic(output)]]
            self.finding = self._compare_outputs(Entry(self._next_step, stream, seq, 0), said)
            if self.finding is not None:
                return
            self._next_step += 1
            self.steps += 1
            yield [output for output in recorded if output not in said]

    def end(self) -> None:
        """Expect nothing more of it: its process was killed."""
        self.over = True
        self._inbox.clear()

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
        if self.name in PROCESSES and not self.over and self._decided < last_decision:
            return (
                f"{self.name}: its receipts end at step {self._next_step}, before it consumed "
                f"run.event #{last_decision}"
            )
        return None

    def _compare(self, entry: Entry, frame: bytes, result: Result) -> Finding | None:
        digest, outputs, error = result
        if error:
            return self._broken(entry, frame, "step", f"digest {entry.digest:08x}", error)
        finding = self._compare_outputs(entry, outputs)
        if finding is not None:
            return finding
        if digest != entry.digest:
            now = f"digest {digest:08x} (the order of receipts or an input was altered)"
            return self._broken(entry, frame, "receipt", f"digest {entry.digest:08x}", now)
        return None

    def _compare_outputs(self, entry: Entry, outputs: Sequence[bytes]) -> Finding | None:
        for output in outputs:
            topic = _topic(output)
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
        return None

    def _broken(self, entry: Entry, frame: bytes, field: str, then: str, now: str) -> Finding:
        """A step that went otherwise than its receipt says, whatever was said in it."""
        t = header(frame)[4]
        topic = entry.stream[0]
        difference = Difference(self.name, entry.step, topic, field, then, now, t * 1e-9)
        return Finding(difference, t, None, (entry.stream, entry.seq))


def _topic(frame: bytes) -> str:
    return frame[: frame.find(b"\0")].decode()


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


def first_cause(findings: Sequence[Finding]) -> Difference | None:
    """The earliest difference that is not merely the consequence of consuming another one."""
    altered = {f.output for f in findings if f.output is not None}
    roots = [f for f in findings if f.consumed not in altered] or list(findings)
    return min(roots, key=lambda f: f.t).difference if roots else None
