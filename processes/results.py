"""What runs and re-runs report: plain values that the command line prints and writes as JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

Executor = Literal["fused", "lockstep"]


@dataclasses.dataclass(frozen=True, slots=True)
class Progress:
    """How far a run or re-run has come. `note` is one line for people."""

    phase: str
    done_s: float
    total_s: float
    note: str = ""


OnProgress = Callable[[Progress], None]


def silent(_progress: Progress) -> None:
    """Report to nobody."""


@dataclasses.dataclass(frozen=True, slots=True)
class Difference:
    """The first place where a re-run departs from its log, in causal order."""

    node: str
    step: int
    topic: str
    field: str
    recorded: str
    recomputed: str
    t_s: float

    def __str__(self) -> str:
        return (
            f"node {self.node}, step {self.step} (t = {self.t_s:.4f} s), "
            f"{self.topic}.{self.field}: recorded {self.recorded}, re-run gives {self.recomputed}"
        )


@dataclasses.dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome of `verify`. realtime_factor is recorded seconds per second of re-run."""

    identical: bool
    executor: Executor
    steps: int
    compared_bytes: int
    compared_messages: int
    duration_s: float
    realtime_factor: float
    first_difference: Difference | None
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def one_line(text: str) -> str:
    """A cause as it travels: one line of printable ASCII, at most 400 characters."""
    return " ".join(text.encode("ascii", "replace").decode().split())[:400]


class RunError(Exception):
    """A run or re-run that can't be done: one line that says what, where and why."""


class UnusableLogError(RunError):
    """A log that can't be re-run: cut off, altered, incomplete, or of another kind."""
