"""The live host: a process that runs nodes of the table against the clock and the bus.

It consumes messages in arrival order and has its nodes (`hosted.py`) hear them. Everything is
imported, compiled, allocated and rehearsed before tick 0; the garbage collector is off on hot
nodes. Nothing here changes what a node computes.
"""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections.abc import Callable, Generator
from typing import Final

from vibrissa.messages.codec import CODECS, header
from vibrissa.messages.errors import DecodeError, MessageError
from vibrissa.messages.types import TICK_NS, Event, Order, Ownership
from vibrissa.processes import realtime
from vibrissa.processes.config import Experiment
from vibrissa.processes.hosted import Hosted, wanted
from vibrissa.processes.layout import Layout
from vibrissa.processes.member import Member
from vibrissa.processes.node import Step, timer_frame
from vibrissa.processes.rehearsal import rehearse
from vibrissa.processes.table import ROWS, SLOTS

HEEDED: Final = ("run.event", "run.order")
DRAIN_S: Final = 0.005
PREPARED_TICKS: Final = 400
"""Ticks for which a slot that is asked to get ready has the priority of a reflex."""


class Host(Member):
    """One process of a live run, with one node or several."""

    def __init__(self, name: str, layout: Layout) -> None:
        names = layout.hosts.get(name, [name])
        rows = [ROWS[n] for n in names]
        self.pacing = rows[0].pacing
        experiment = Experiment.model_validate_json(layout.experiment)
        self.last_tick = experiment.ticks
        for row in rows:
            rehearse(row.name, experiment, layout.controllers.get(row.name))
        priority, cores = wanted(rows)
        super().__init__(name, layout, priority if experiment.run.realtime else 0, cores)
        granted = experiment.run.realtime and "SCHED_FIFO" not in self.missing
        self._shadow = name in SLOTS and granted
        self.nodes = Hosted(names, experiment, self.port.publish, self._noticed)
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
        self.nodes.hand_in(final=True)
        self.port.flush()
        self.control.say(
            "bye",
            sent=dict(self.nodes.sent()),
            stats=self.nodes.stats(),
            cpu_s=time.process_time() - cpu,
            counters=self.nodes.counters(),
        )
        self.control.wait_to_leave(self.parent)
        self.leave()

    def _wait_for_go(self) -> Generator[None, None, None]:
        heard = self.layout.audience(self.name)
        self.t0 = yield from self.control.wait_for_go(self.parent, self.port.subscribers, heard)
        self.nodes.t0 = self.t0

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
                self.nodes.feed(timer_frame(self.nodes.names[0], tick))
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
                self.nodes.feed(frame)
            except DecodeError as error:
                self.gate.refuse(header(frame)[1], str(error))

    def _noticed(self, frame: bytes, step: Step) -> None:
        """Obey what nodes of this process were just told, as far as it is for their host."""
        topic = step.stream[0]
        if topic in HEEDED:
            self._heed(CODECS[topic].decode(frame).body)
        elif topic == "head.owner" and self._shadow:
            self._rule(CODECS[topic].decode(frame).body)

    def _rule(self, ownership: Ownership) -> None:
        """Note who has the drives, or is about to."""
        ruled, self._rules = self._rules, ownership.controller == self.name
        if ruled and not self._rules:  # a rollback may follow
            self._prepared_until = self.nodes.t + PREPARED_TICKS * TICK_NS
        self._schedule()

    def _schedule(self) -> None:
        """A slot runs with the priority of a reflex while it has the drives, is about to, or is to
        show whether it could: who is judged as an ordinary process is judged for the machine's
        load. It then leaves the core of the reflex loop alone; a shadow is too slow to matter."""
        favoured = self._rules or self.nodes.t < self._prepared_until
        priority = ROWS[self.name].priority if favoured else 0
        if priority != self._priority:
            self._favour(priority)

    def _favour(self, priority: int) -> None:
        self._priority = priority
        cores = realtime.choose_cores(self._cores, "others" if priority else "any")
        realtime.set_threads(priority, cores)

    def _heed(self, body: Event | Order) -> None:
        """A stop is for everybody, what else a host obeys is for the slot it names."""
        named = body.node in self.nodes.names
        if body.kind == "stop" or (body.kind == "close" and named):
            self.stopping = True
        elif body.kind == "prepare" and named and self._shadow:
            self._prepared_until = self.nodes.t + PREPARED_TICKS * TICK_NS
            self._schedule()

    def progress(self) -> tuple[int, int]:
        return self.nodes.t, self.nodes.steps

    def look_after(self) -> None:
        self.nodes.hand_in(final=False)
        if self._shadow:
            self._schedule()

    def orphaned(self) -> None:
        self.nodes.inject("stop", "supervisor gone")


def main(name: str, layout: Layout) -> None:
    """Entry point of a host process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Host(name, layout).run()
