"""Several nodes under one roof, joined in memory under the node contract."""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterable
from typing import Protocol

from vibrissa.processes.node import Step


class Steps(Protocol):
    """Anything that steps a node by frames: a `Stepper` here, or a stand-in for a remote one."""

    name: str

    def step(self, frame: bytes) -> Step: ...


OnStep = Callable[[Steps, bytes, Step], None]


class Group:
    """Nodes that hear each other directly.

    A frame that is fed in reaches every member that hears its topic, in the members' order; what
    they say in turn queues up behind it, until nobody has anything left to do. The same feeds
    always give the same order of steps.
    """

    def __init__(self, members: Iterable[tuple[Steps, Iterable[str]]], on_step: OnStep) -> None:
        self._hearers: dict[bytes, list[Steps]] = {}
        self._members: dict[str, Steps] = {}
        for steps, hears in members:
            self._members[steps.name] = steps
            for topic in hears:
                self._hearers.setdefault(topic.encode(), []).append(steps)
        self._on_step = on_step

    def tell(self, name: str, frame: bytes) -> None:
        """Deliver a frame to one member alone, and everything that follows from it."""
        steps = self._members[name]
        step = steps.step(frame)
        self._on_step(steps, frame, step)
        for output in step.outputs:
            self.feed(output)

    def feed(self, frame: bytes) -> None:
        """Deliver a frame and everything that follows from it."""
        queue = collections.deque((frame,))
        hearers = self._hearers
        while queue:
            heard = queue.popleft()
            for steps in hearers.get(heard[: heard.find(b"\0")], ()):
                step = steps.step(heard)
                queue.extend(step.outputs)
                self._on_step(steps, heard, step)
