"""What the front end knows of SLAMs in shadow: it hands over the past and names the run's SLAM."""

from __future__ import annotations

import numpy as np

from vibrissa.messages.types import Answer, Event, Order, Ownership, SlamHistory
from vibrissa.processes.mapping import Image, Sight
from vibrissa.processes.node import Output

FIRST = "slam"
PART = 200
"""Cycles per message."""
SILENT_CYCLES = 5
"""A SLAM is not ready, or no longer the run's, when it has not told its pose for more than these.
Its answer to a cycle arrives while the next one goes on."""


class Others:
    """The images and odometry so far, who has kept up with them, and whose map is the run's."""

    def __init__(self, kind: str, period_ticks: int) -> None:
        self._kind = kind
        self._period = period_ticks
        self._seen: list[tuple[int, Image, tuple[float, float, float], list[float]]] = []
        self._last: dict[str, int] = {}
        self.owner = FIRST
        self._due: Ownership | None = None

    def heard(self, source: str, cycle: int) -> None:
        """A SLAM in shadow told its pose after a cycle."""
        if source in self._last:
            self._last[source] = cycle

    def saw(self, sight: Sight) -> list[Output]:
        """Keep what was seen in a cycle; the owner that is silent is replaced by the first SLAM."""
        odometry = sight.odometry
        row = (odometry.v, odometry.w, odometry.dt)
        self._seen.append((sight.cycle, sight.images[self._kind], row, sight.truth.tolist()))
        if self.owner == FIRST or self._kept_up(self.owner):
            return []
        tick = (sight.cycle + 1) * self._period
        why = f"{self.owner}: no pose since cycle {self._last.get(self.owner, -1)}"
        return [("node.event", Event(tick, "fallback", FIRST, why)), self._owned(tick, FIRST)]

    def obey(self, order: Order, tick: int) -> list[Output]:
        """register: hand over the past; swap: between two cycles; forget."""
        name = order.name
        refusal = ""
        outputs: list[Output] = []
        if order.kind == "register":
            self._last.setdefault(name, self._seen[-1][0] if self._seen else -1)
            text = f"{len(self._seen)} cycles are handed over"
            outputs = self._history(order)
        elif order.kind == "forget":
            refusal = self._forget(name)
            text = f"{name} is forgotten"
        elif order.kind == "swap":
            seen = self._seen[-1][0] if self._seen else -1
            at = max(order.at, (max(tick // self._period, seen) + 1) * self._period)
            refusal = self._objection(name)
            text = f"is the run's SLAM from cycle {at // self._period} on, after {self.owner}"
            outputs = [] if refusal else [self._owned(at, name)]
        else:
            refusal = f"can't {order.kind}"
        answer = Answer(order.request, tick, int(not refusal), FIRST, refusal or text)
        return [("node.answer", answer), *outputs]

    def _objection(self, name: str) -> str:
        if name == self.owner:
            return "active already: it is the run's SLAM"
        if name == FIRST:
            return ""
        if name not in self._last:
            return "unknown: not registered"
        if not self._kept_up(name):
            last, now = self._last[name], self._seen[-1][0]
            return f"not ready: its last pose is of cycle {last}, the last cycle seen is {now}"
        return ""

    def _kept_up(self, name: str) -> bool:
        behind = [cycle for cycle, *_ in self._seen[-SILENT_CYCLES - 1 :]]
        return len(behind) <= SILENT_CYCLES or self._last.get(name, -1) >= behind[0]

    def _forget(self, name: str) -> str:
        if name == self.owner:
            return "active: it is the run's SLAM"
        return "" if self._last.pop(name, None) is not None else "unknown: not registered"

    def _owned(self, tick: int, name: str) -> Output:
        self.owner = name
        return "slam.owner", Ownership(tick, name, 0)

    def _history(self, order: Order) -> list[Output]:
        total = len(self._seen)
        return [self._part(order, first, total) for first in range(0, max(total, 1), PART)]

    def _part(self, order: Order, first: int, total: int) -> Output:
        rows = self._seen[first : first + PART]
        history = SlamHistory(
            request=order.request,
            node=order.name,
            first=first,
            total=total,
            cycles=np.array([row[0] for row in rows], np.int32),
            images=np.array([row[1] for row in rows], np.uint8).reshape(-1, 18),
            odometry=np.array([row[2] for row in rows], np.float64).reshape(-1, 3),
            truth=np.array([row[3] for row in rows], np.float64).reshape(-1, 4),
        )
        return "slam.history", history
