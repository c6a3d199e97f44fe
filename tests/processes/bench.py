"""A single node on the bench: messages in, outputs out, no host around it."""

from __future__ import annotations

import collections
from typing import Any

import numpy as np

from vibrissa.messages import types
from vibrissa.messages.codec import Message
from vibrissa.processes.node import Node

ZEROS = np.zeros(18, np.float32)


class Bench:
    """Feeds one node and numbers its inputs."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._numbers: collections.Counter[tuple[str, str]] = collections.Counter()

    def hear(self, topic: str, source: str, t_tick: int, body: Any) -> list[tuple[str, Any]]:
        """What the node says to a message of this tick."""
        seq = self._numbers[topic, source]
        self._numbers[topic, source] += 1
        t = t_tick * types.TICK_NS
        return list(self.node.step(Message(topic, source, 0, seq, t, body)))

    def decide(self, kind: str, tick: int = 0, topic: str = "run.event") -> list[tuple[str, Any]]:
        source = "supervisor" if topic == "run.event" else "sampler"
        return self.hear(topic, source, tick, types.Event(tick, kind, source, "because"))


def of(outputs: list[tuple[str, Any]], topic: str) -> list[Any]:
    """The bodies of one topic."""
    return [body for name, body in outputs if name == topic]
