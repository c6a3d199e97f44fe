"""Who may move, and what must keep coming for that: the one state machine of safety.

    WAITING --start--> RUNNING --stop, or something overdue--> STOPPED

Whatever happens, a stopped watch never runs again: another run needs another start by a person.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping


class Phase(enum.Enum):
    """Where a watch is."""

    WAITING = "waiting for the start"
    RUNNING = "running"
    STOPPED = "stopped"


class Watch:
    """Ages of what must keep coming, in ticks of any clock that does not go back.

    limits: what -> the most ticks between two of it while running. `cause` says why it stopped.
    """

    def __init__(self, limits: Mapping[str, int]) -> None:
        self.phase = Phase.WAITING
        self.cause = ""
        self._limits = dict(limits)
        self._seen: dict[str, int] = {}

    @property
    def may_move(self) -> bool:
        """Whether anything may be asked to move."""
        return self.phase is Phase.RUNNING

    def start(self, now: int) -> bool:
        """The operator's explicit start; False, and no effect, once stopped."""
        if self.phase is Phase.WAITING:
            self.phase = Phase.RUNNING
            self._seen = dict.fromkeys(self._limits, now)
        return self.may_move

    def seen(self, what: str, now: int) -> None:
        """Something that is watched has come."""
        self._seen[what] = max(now, self._seen.get(what, now))

    def stop(self, cause: str) -> bool:
        """Stop for good, also before the start; True if this is what stopped it."""
        if self.phase is Phase.STOPPED:
            return False
        self.phase, self.cause = Phase.STOPPED, cause
        return True

    def look(self, now: int) -> bool:
        """Stop when something is overdue; True if this is what stopped it."""
        if self.phase is not Phase.RUNNING:
            return False
        for what, limit in self._limits.items():
            if now - self._seen[what] > limit:
                return self.stop(f"no {what} for {limit} ticks")
        return False
