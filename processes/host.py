"""The live host: a process that runs nodes of the table against the clock and the bus.

It consumes messages in arrival order, lets each node step, publishes what they say, and writes a
receipt for every step. Everything is imported, compiled, allocated and rehearsed before tick 0; the
garbage collector is off on hot nodes. Nothing here changes what a node computes.
"""

from __future__ import annotations

import collections
import os
import signal
import time
import traceback
from collections.abc import Callable, Generator
from typing import Any, Final

from vibrissa.messages.codec import CODECS, header
from vibrissa.messages.errors import DecodeError, MessageError
from vibrissa.messages.types import TICK_NS, Event, Order, Ownership
from vibrissa.processes import realtime
from vibrissa.processes.config import Experiment
from vibrissa.processes.group import Group, Steps
from vibrissa.processes.layout import Layout
from vibrissa.processes.member import Member, telemetry
from vibrissa.processes.node import Step, Stepper, counters, timer_frame
from vibrissa.processes.receipts import ReceiptBook
from vibrissa.processes.rehearsal import rehearse
from vibrissa.processes.stats import Clocking
from vibrissa.processes.table import ROWS, SLOTS, Process, build

HEEDED: Final = ("run.event", "run.order")
LONGEST_WAIT: Final = 8
"""Steps that may wait to be accounted for."""
RECEIPT_BATCH: Final = 400
DRAIN_S: Final = 0.005
PREPARED_TICKS: Final = 400
"""Ticks for which a slot that is asked to get ready has the priority of a reflex."""


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


class Host(Member):
    """One process of a live run, with one node or several."""

    def __init__(self, name: str, layout: Layout) -> None:
        self.nodes = layout.hosts.get(name, [name])
        rows = [ROWS[n] for n in self.nodes]
        self.pacing = rows[0].pacing
        experiment = Experiment.model_validate_json(layout.experiment)
        self.last_tick = experiment.ticks
        for row in rows:
            rehearse(row.name, experiment, layout.controllers.get(row.name))
        priority = max(r.priority for r in rows) if experiment.run.realtime else 0
        cores = next((r.cores for r in rows if r.cores == "reflex"), rows[0].cores)
        super().__init__(name, layout, priority, cores)
        granted = experiment.run.realtime and "SCHED_FIFO" not in self.missing
        self._shadow = name in SLOTS and granted
        self.steppers = {
            n: Stepper(n, build(n, experiment), publish=self._publish) for n in self.nodes
        }
        self.seats = {row.name: Seat(row) for row in rows}
        self.group = Group([(self.steppers[r.name], r.hears) for r in rows], self._stepped)
        self.t = 0
        self._own_seq: collections.Counter[tuple[str, str]] = collections.Counter()
        self._reported = 0
        self._mark = 0
        self._said = 0
        self._unaccounted: list[tuple[Seat, Step, int, int, int]] = []
        self._rules = False
        self._prepared_until = self._priority = 0
        self._cores = os.sched_getaffinity(0)
        if self._shadow:
            self._favour(0)

    def run(self) -> None:
        """Barrier, loop, farewell."""
        for _ in self._wait_for_go():
            pass
        loop: dict[str, Callable[[], None]] = {
            "timer": self._timer_loop,
            "arrival": self._arrival_loop,
            "drain": self._drain_loop,
        }
        cpu = time.process_time()
        try:
            loop[self.pacing]()
        except MessageError as error:
            self.control.say("fault", cause=str(error)[:400])
        except Exception as error:
            traceback.print_exc()
            self.control.say("fault", cause=f"{type(error).__name__}: {error}"[:400])
        self._hand_in(final=True)
        self.port.flush()
        for stepper in self.steppers.values():
            self.sent.update(stepper.sent)
        self.control.say(
            "bye",
            sent=dict(self.sent),
            stats={n: seat.clock.summary() for n, seat in self.seats.items()},
            cpu_s=time.process_time() - cpu,
            counters={n: counters(s) for n, s in self.steppers.items()},
        )
        self.control.wait_to_leave(self.parent)
        self.leave()

    def _wait_for_go(self) -> Generator[None, None, None]:
        wanted = self.layout.audience(self.name)
        self.t0 = yield from self.control.wait_for_go(self.parent, self.port.subscribers, wanted)

    def _timer_loop(self) -> None:
        tick = 0
        while not self.stopping:
            if tick >= self.last_tick:
                self.done = True
                frame = self.port.receive(0.02)
                if frame is not None:
                    self._hear(frame)
            else:
                realtime.sleep_until(self.t0 + tick * TICK_NS)
                while (frame := self.port.receive(0)) is not None:
                    self._hear(frame)
                if self.stopping:
                    break
                self._feed(timer_frame(self.nodes[0], tick))
                tick += 1
            self.housekeep()

    def _arrival_loop(self) -> None:
        while not self.stopping:
            frame = self.port.receive(0.05)
            if frame is not None:
                self._hear(frame)
            self.housekeep()

    def _drain_loop(self) -> None:
        while not self.stopping:
            try:
                frame = self.port.receive(0)
            except DecodeError as error:  # a bundle that is none
                self.gate.refuse("?", str(error))
                continue
            if frame is None:
                time.sleep(DRAIN_S)
            else:
                self._hear(frame)
            self.housekeep()

    def _hear(self, frame: bytes) -> None:
        """Take a frame from the bus, unless it is none that this process may hear."""
        if self.gate.admits(frame):
            try:
                self._feed(frame)
            except DecodeError as error:
                self.gate.refuse(header(frame)[1], str(error))

    def _feed(self, frame: bytes) -> None:
        self._mark = time.monotonic_ns()
        self._said = 0
        self.group.feed(frame)

    def _publish(self, frame: bytes) -> None:
        """Send what a node says the moment it says it."""
        self.port.publish(frame)
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
        seat = self.seats[steps.name]
        self._unaccounted.append((seat, step, start, said, end))
        topic = step.stream[0]
        if topic in HEEDED:
            self._heed(CODECS[topic].decode(frame).body)
        elif topic == "head.owner" and self._shadow:
            self._rule(CODECS[topic].decode(frame).body)
        if not (seat.answer and topic == seat.driver) or len(self._unaccounted) > LONGEST_WAIT:
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

    def _rule(self, ownership: Ownership) -> None:
        """Note who has the drives, or is about to."""
        ruled, self._rules = self._rules, ownership.controller == self.name
        if ruled and not self._rules:  # a rollback may follow
            self._prepared_until = self.t + PREPARED_TICKS * TICK_NS
        self._schedule()

    def _schedule(self) -> None:
        """A slot runs with the priority of a reflex while it has the drives, is about to, or is to
        show whether it could: who is judged as an ordinary process is judged for the machine's
        load. It then leaves the core of the reflex loop alone; a shadow is too slow to matter."""
        wanted = ROWS[self.name].priority if self._rules or self.t < self._prepared_until else 0
        if wanted != self._priority:
            self._favour(wanted)

    def _favour(self, priority: int) -> None:
        self._priority = priority
        cores = realtime.choose_cores(self._cores, "others" if priority else "any")
        realtime.set_threads(priority, cores)

    def _heed(self, body: Event | Order) -> None:
        """A stop is for everybody, what else a host obeys is for the slot it names."""
        named = body.node in self.nodes
        if body.kind == "stop" or (body.kind == "close" and named):
            self.stopping = True
        elif body.kind == "prepare" and named and self._shadow:
            self._prepared_until = self.t + PREPARED_TICKS * TICK_NS
            self._schedule()

    def _publish_own(self, frame: bytes) -> None:
        self.port.publish(frame)
        self.sent[frame[: frame.find(b"\0")].decode()] += 1

    def progress(self) -> tuple[int, int]:
        return self.t, sum(s.steps for s in self.steppers.values())

    def look_after(self) -> None:
        self._hand_in(final=False)
        if self._shadow:
            self._schedule()

    def orphaned(self) -> None:
        self._inject("stop", "supervisor gone")

    def _hand_in(self, *, final: bool) -> None:
        """Publish the receipts so far, so that a crash costs few, and every second telemetry."""
        self._account()
        for seat in self.seats.values():
            if len(seat.book):
                self._publish_own(seat.book.frame(self.t))
        now = time.monotonic_ns()
        if final or now - self._reported > 1_000_000_000:
            self._reported = now
            for node in self.nodes:
                body = telemetry(self.seats[node].clock, self.steppers[node].steps)
                self._publish_own(self._own_frame("node.telemetry", node, body))

    def _own_frame(self, topic: str, node: str, body: Any) -> bytes:
        seq = self._own_seq[topic, node]
        self._own_seq[topic, node] = seq + 1
        return CODECS[topic].encode(node, 0, seq, self.t, body)

    def _inject(self, kind: str, cause: str) -> None:
        """Make a decision of the host an input of its nodes that look out for such, recorded like
        any other."""
        for node in (n for n in self.nodes if "host.event" in ROWS[n].hears):
            event = Event(tick=self.t // TICK_NS, kind=kind, node=node, cause=cause)
            frame = self._own_frame("host.event", node, event)
            self._publish_own(frame)
            self._mark, self._said = time.monotonic_ns(), 0
            self.group.tell(node, frame)


def main(name: str, layout: Layout) -> None:
    """Entry point of a host process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Host(name, layout).run()
