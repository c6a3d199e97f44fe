"""Several nodes in one process, joined by the in-memory transport under the node contract."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol

from vibrissa.messages.transport import Hub, MemoryPort
from vibrissa.processes.node import Step


class Steps(Protocol):
    """Anything that steps a node by frames: a `Stepper` here, or a stand-in for a remote one."""

    name: str

    def step(self, frame: bytes) -> Step: ...


OnStep = Callable[[Steps, bytes, Step], None]


class Group:
    """Nodes that hear each other directly.

    A frame that is fed in reaches every member that hears its topic; what they say is delivered in
    turn until nobody has anything left to do. Members are served in their given order, one message
    at a time, so the same feeds always give the same order of steps.
    """

    def __init__(self, members: Iterable[tuple[Steps, Iterable[str]]], on_step: OnStep) -> None:
        self._hub = Hub()
        self._publish = self._hub.port().publish
        self._members: list[tuple[Steps, MemoryPort]] = [
            (steps, self._hub.port(hears)) for steps, hears in members
        ]
        self._on_step = on_step

    def feed(self, frame: bytes) -> None:
        """Deliver a frame and everything that follows from it."""
        self._publish(frame)
        busy = True
        while busy:
            busy = False
            for steps, port in self._members:
                heard = port.receive(0)
                if heard is None:
                    continue
                busy = True
                step = steps.step(heard)
                for output in step.outputs:
                    self._publish(output)
                self._on_step(steps, heard, step)
