"""What every process of a live run but the recorder owes the others, whatever it does.

It says hello and bye to the supervisor, tells it twenty times a second how far it is, serves
bundled listeners, reports whom it would not listen to, and ends by itself, in order, when the
supervisor is gone.
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from typing import Final

import numpy as np
import zmq

from vibrissa.messages.transport import ZmqPort
from vibrissa.messages.types import TICK_NS, Telemetry
from vibrissa.processes import realtime
from vibrissa.processes.control import ControlLine
from vibrissa.processes.gate import Gate
from vibrissa.processes.layout import Layout
from vibrissa.processes.stats import Clocking

HOUSEKEEPING_NS: Final = 50_000_000
BUNDLE_NS: Final = 10_000_000
"""How often bundled listeners are served: what a crash of this process may take from the log."""
PARTING_TICKS: Final = 600
"""Ticks it goes on for after its supervisor is gone, so that what moves can stop."""


class Member(ABC):
    """A process of a live run: its end of the control channel, its port, its housekeeping.

    priority: of SCHED_FIFO, 0 for an ordinary process; cores as in `realtime.choose_cores`.
    """

    def __init__(self, name: str, layout: Layout, priority: int, cores: realtime.Cores) -> None:
        self.name = name
        self.layout = layout
        self.missing = realtime.prepare(priority, cores)
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.control = ControlLine(self.context, layout.endpoints["control"], name)
        self.control.say("hello", pid=os.getpid(), missing=self.missing)
        self.port = ZmqPort(
            self.context,
            layout.endpoints[name],
            layout.hears(name),
            layout.connections(name),
            bundled=layout.bundled(name),
        )
        self.gate = Gate(own=layout.hosts.get(name, [name]))
        self.t0 = 0
        self.stopping = False
        self.done = False
        self.parent = os.getppid()
        self._leave_at = 0
        self._flushed = self._housekept = 0

    @abstractmethod
    def progress(self) -> tuple[int, int]:
        """(ns since t0 it has come to, steps taken)."""

    @abstractmethod
    def look_after(self) -> None:
        """What is to be done some twenty times a second, before listeners are served."""

    @abstractmethod
    def orphaned(self) -> None:
        """The supervisor is gone: have everything that moves stop."""

    def housekeep(self) -> None:
        """To be called at every turn; costs a look at the clock unless something is due."""
        now = time.monotonic_ns()
        if now - self._flushed < BUNDLE_NS:
            return
        self._flushed = now
        if now - self._housekept < HOUSEKEEPING_NS:
            self.port.flush()
            return
        self._housekept = now
        self.look_after()
        self.port.subscribers()
        self.port.flush()
        t, steps = self.progress()
        self.control.say("beat", t=t, steps=steps, done=self.done)
        for source, (count, cause) in self.gate.take_refused().items():
            self.control.say("refused", source=source, count=count, cause=cause)
        if self._leave_at:
            self.stopping |= now >= self._leave_at
        elif os.getppid() != self.parent:
            self._leave_at = now + PARTING_TICKS * TICK_NS
            self.orphaned()

    def leave(self) -> None:
        """Close everything."""
        self.control.close()
        self.port.close()
        self.context.term()


def telemetry(clock: Clocking, steps: int) -> Telemetry:
    """How a node or device did in the last second."""
    return Telemetry(
        steps=steps,
        lateness_us=np.array(clock.lateness.recent(), np.float32),
        work_us=np.array(clock.work.recent(), np.float32),
        latency_us=np.array(clock.latency.recent(), np.float32),
        cpu_s=time.process_time(),
    )
