"""The node contract: a process is a step function, and everything that can change it is an input.

A node sees one message at a time and answers with the messages that follow from it. It reads no
clock, no file, no environment and no global state, so that the same inputs in the same order always
give the same bytes. Whatever hosts it (live, fused, lockstep) drives it through a `Stepper`, which
gives outputs their identity and keeps the running digest that receipts are made of.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol

from vibrissa.messages.codec import CODECS, Message, decode
from vibrissa.messages.types import TICK_NS, TimerTick

Output = tuple[str, Any]
"""(topic, body): the host adds source, epoch, seq, and the t of the input that caused it."""


class Node(Protocol):
    """A step function with its state."""

    def step(self, message: Message) -> Iterable[Output]:
        """Consume one message; give what follows from it, in order, the most urgent first.

        A live host publishes each output as it comes, so a generator that yields what others wait
        for before it does the rest of its work lets them start at once.
        """


class Step(NamedTuple):
    """What one step consumed and what came of it."""

    stream: tuple[str, str, int]
    """(topic, source, epoch) of the input."""
    seq: int
    t: int
    outputs: Sequence[bytes]
    digest: int
    """Running CRC-32 over every input and output frame of the node so far."""


class Stepper:
    """Drives one node by frames: decodes, steps, identifies and encodes, keeps the digest."""

    def __init__(
        self,
        name: str,
        node: Node,
        epoch: int = 0,
        publish: Callable[[bytes], None] | None = None,
    ) -> None:
        self.name = name
        self.node = node
        self.epoch = epoch
        self._publish = publish
        self.steps = 0
        self.digest = 0
        self.sent: dict[str, int] = {}
        """topic -> messages said so far"""

    def step(self, frame: bytes) -> Step:
        """Feed one frame; publish every output as it comes.

        Raises DecodeError or EncodeError before the digest moves.
        """
        message = decode(frame)
        publish = self._publish
        outputs = []
        for topic, body in self.node.step(message):
            output = self._frame(topic, message.t, body)
            if publish is not None:
                publish(output)
            outputs.append(output)
        digest = zlib.crc32(frame, self.digest)
        for output in outputs:
            digest = zlib.crc32(output, digest)
        self.digest = digest
        self.steps += 1
        return Step(message[:3], message.seq, message.t, outputs, digest)

    def _frame(self, topic: str, t: int, body: Any) -> bytes:
        seq = self.sent.get(topic, 0)
        self.sent[topic] = seq + 1
        return CODECS[topic].encode(self.name, self.epoch, seq, t, body)


def counters(stepper: Stepper) -> dict[str, int]:
    """What a node counted for the summary, if it counts anything."""
    found: dict[str, int] = getattr(stepper.node, "counters", dict)()
    return found


def timer_frame(node: str, tick: int) -> bytes:
    """The input that a host's timer makes at a tick; a re-run rebuilds it from its receipt."""
    return CODECS["host.timer"].encode(node, 0, tick, tick * TICK_NS, TimerTick(tick))
