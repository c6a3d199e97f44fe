"""The nodes that a process of a live run hosts, whatever else that process does.

They are joined in memory, what they say is published the moment they say it, and every step is
measured and written down in a receipt. Nothing here changes what a node computes.
"""

from __future__ import annotations

import collections
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from vibrissa.messages.codec import CODECS
from vibrissa.messages.types import TICK_NS, Event
from vibrissa.processes.config import Experiment
from vibrissa.processes.group import Group, Steps
from vibrissa.processes.member import telemetry
from vibrissa.processes.node import Step, Stepper, counters
from vibrissa.processes.realtime import Cores
from vibrissa.processes.receipts import ReceiptBook
from vibrissa.processes.stats import Clocking
from vibrissa.processes.table import ROWS, Process, build

LONGEST_WAIT: Final = 8
"""Steps that may wait to be accounted for."""
RECEIPT_BATCH: Final = 400
TELEMETRY_NS: Final = 1_000_000_000


class Seat:
    """What a host keeps of one of its nodes: receipts, clocking, and the reaction probe."""

    def __init__(self, row: Process) -> None:
        self.driver = row.hears[0]
        self.answer = row.answer
        self.book = ReceiptBook(row.name)
        self.clock = Clocking()
        self._out: dict[int, int] = {}

    def probe_went_out(self, t: int, now: int) -> None:
        """Something that awaits an answer was published for time t."""
        if self.answer:
            if len(self._out) > 4000:
                self._out.clear()
            self._out[t] = now

    def probe_came_back(self, t: int, now: int) -> None:
        """The answer to what was published for time t has come."""
        went = self._out.pop(t, None)
        if went is not None:
            self.clock.latency.add((now - went) * 1e-3)


class Hosted:
    """Fresh nodes of the table, ready to be fed; there may be none.

    publish: puts a frame on the bus; noticed: is shown every (input, step) before it is accounted
    for. `t0` (ns, monotonic) is to be set at the go; `t` (ns) is how far in logical time they are.
    """

    def __init__(
        self,
        names: Sequence[str],
        experiment: Experiment,
        publish: Callable[[bytes], None],
        noticed: Callable[[bytes, Step], None],
    ) -> None:
        self.names = names
        self.t0 = self.t = 0
        self._bus = publish
        self._noticed = noticed
        self._steppers = {n: Stepper(n, build(n, experiment), publish=self._publish) for n in names}
        self._seats = {n: Seat(ROWS[n]) for n in names}
        members = [(self._steppers[n], ROWS[n].hears) for n in names]
        self._group = Group(members, self._stepped)
        self._sent: collections.Counter[str] = collections.Counter()
        self._own_seq: collections.Counter[tuple[str, str]] = collections.Counter()
        self._reported = 0
        self._mark = 0
        self._said = 0
        self._unaccounted: list[tuple[Seat, Step, int, int, int]] = []

    @property
    def steps(self) -> int:
        """Steps of all of them so far."""
        return sum(s.steps for s in self._steppers.values())

    def feed(self, frame: bytes) -> None:
        """Have those who hear its topic take a frame, and each other what follows from it."""
        self._mark = time.monotonic_ns()
        self._said = 0
        self._group.feed(frame)

    def inject(self, kind: str, cause: str) -> None:
        """Make a decision of the host an input of its nodes that look out for such, recorded like
        any other."""
        for node in (n for n in self.names if "host.event" in ROWS[n].hears):
            event = Event(tick=self.t // TICK_NS, kind=kind, node=node, cause=cause)
            frame = self._own_frame("host.event", node, event)
            self._publish_own(frame)
            self._mark, self._said = time.monotonic_ns(), 0
            self._group.tell(node, frame)

    def hand_in(self, *, final: bool) -> None:
        """Publish the receipts so far, so that a crash costs few, and every second telemetry."""
        self._account()
        for seat in self._seats.values():
            if len(seat.book):
                self._publish_own(seat.book.frame(self.t))
        now = time.monotonic_ns()
        if final or now - self._reported > TELEMETRY_NS:
            self._reported = now
            for node in self.names:
                body = telemetry(self._seats[node].clock, self._steppers[node].steps)
                self._publish_own(self._own_frame("node.telemetry", node, body))

    def sent(self) -> collections.Counter[str]:
        """Messages published so far, by topic."""
        found = self._sent.copy()
        for stepper in self._steppers.values():
            found.update(stepper.sent)
        return found

    def stats(self) -> dict[str, Any]:
        """What was measured of each node."""
        return {n: seat.clock.summary() for n, seat in self._seats.items()}

    def counters(self) -> dict[str, dict[str, int]]:
        """What each node counted."""
        return {n: counters(s) for n, s in self._steppers.items()}

    def _publish(self, frame: bytes) -> None:
        """Send what a node says the moment it says it."""
        self._bus(frame)
        if not self._said:
            self._said = time.monotonic_ns()

    def _stepped(self, steps: Steps, frame: bytes, step: Step) -> None:
        """Measure a step and write its receipt.

        A step that others are waiting for is accounted for when their answer is there: until then
        the core belongs to them.
        """
        end = time.monotonic_ns()
        start, self._mark = self._mark, end
        said, self._said = self._said, 0
        seat = self._seats[steps.name]
        self._unaccounted.append((seat, step, start, said, end))
        self._noticed(frame, step)
        awaited = seat.answer and step.stream[0] == seat.driver
        if not awaited or len(self._unaccounted) > LONGEST_WAIT:
            self._account()

    def _account(self) -> None:
        for seat, step, start, said, end in self._unaccounted:
            topic = step.stream[0]
            if topic == seat.driver:
                self.t = step.t
                seat.clock.tick(self.t0 + step.t, start, end)
                if said:
                    seat.probe_went_out(step.t, said)
            elif topic == seat.answer:
                seat.probe_came_back(step.t, start)
            seat.book.add(step)
            if len(seat.book) >= RECEIPT_BATCH:
                self._publish_own(seat.book.frame(step.t))
        self._unaccounted.clear()

    def _publish_own(self, frame: bytes) -> None:
        self._bus(frame)
        self._sent[frame[: frame.find(b"\0")].decode()] += 1

    def _own_frame(self, topic: str, node: str, body: Any) -> bytes:
        seq = self._own_seq[topic, node]
        self._own_seq[topic, node] = seq + 1
        return CODECS[topic].encode(node, 0, seq, self.t, body)


def wanted(rows: Iterable[Process]) -> tuple[int, Cores]:
    """(SCHED_FIFO priority, cores) of a process that all these share: those of the most urgent."""
    found = list(rows)
    cores = next((r.cores for r in found if r.cores == "reflex"), found[0].cores)
    return max(r.priority for r in found), cores
