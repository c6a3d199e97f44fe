"""What a process takes from the bus: whole frames of the table, each stream in its order.

Whoever may write to a socket of a run may write anything into it: bytes that are no frame, frames
in somebody else's name, more of them than anybody can read. None of that may reach a node or end a
process. The check costs about a microsecond a frame; what is refused is counted by source.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Final

from vibrissa.messages.codec import header, stream_of
from vibrissa.messages.errors import DecodeError
from vibrissa.processes.table import SLOTS, producers

BURST: Final = 400
RATE_HZ: Final = 8000
"""A slot says a command per tick. Beyond a burst, more than this per second and stream is not
listened to, so that a flood costs the loop little before its source is ended."""


class Gate:
    """Admits frames; a stream is heard from its first frame on without repeats, gaps or forgeries.

    own: nodes of this very process, which hear each other in memory; limited: whether slots may say
    no more than `RATE_HZ`.
    """

    def __init__(self, own: Iterable[str] = (), *, limited: bool = True) -> None:
        self._own = frozenset(own)
        self._limited = limited
        self._next: dict[bytes, int] = {}
        self._credit: dict[bytes, tuple[float, int]] = {}
        self.refused: dict[str, tuple[int, str]] = {}
        """source -> (number of refused frames, why the last one was)"""

    def admits(self, frame: bytes) -> bool:
        """Whether to take a frame; it may still turn out to be unreadable further in."""
        try:
            stream, seq = stream_of(frame)
            expected = self._next.get(stream)
            if expected is None:
                source = header(frame)[1]
                if source in self._own:
                    self.refuse(source, f"expected no {_title(stream)} from the bus, found #{seq}")
                    return False
                self._meet(frame, stream)
            elif seq != expected:
                source = header(frame)[1]
                self.refuse(source, f"expected #{expected} of {_title(stream)}, found #{seq}")
                return False
        except DecodeError as error:
            self.refuse("?", str(error))
            return False
        self._next[stream] = seq + 1
        if stream not in self._credit:
            return True
        return self._within_rate(stream)

    def refuse(self, source: str, cause: str) -> None:
        """Count a refused frame."""
        self.refused[source] = (self.refused.get(source, (0, ""))[0] + 1, cause)

    def take_refused(self) -> dict[str, tuple[int, str]]:
        """What was refused since the last call."""
        refused, self.refused = self.refused, {}
        return refused

    def _meet(self, frame: bytes, stream: bytes) -> None:
        topic, source, *_ = header(frame)
        if source not in producers(topic):
            raise DecodeError(
                f"{topic} from {source}: expected one of {', '.join(producers(topic))}"
            )
        if self._limited and source in SLOTS:
            self._credit[stream] = (BURST, time.monotonic_ns())

    def _within_rate(self, stream: bytes) -> bool:
        credit, then = self._credit[stream]
        now = time.monotonic_ns()
        credit = min(credit + (now - then) * (RATE_HZ * 1e-9), BURST) - 1.0
        if credit < 0.0:
            source = _title(stream).partition(" ")[2]
            self.refuse(source, f"more than {RATE_HZ} messages a second")
            return False
        self._credit[stream] = (credit, now)
        return True


def _title(stream: bytes) -> str:
    """A stream for people: topic and source."""
    topic, _, rest = stream.partition(b"\0")
    return f"{topic.decode()} {rest[3:-1].decode()}"
