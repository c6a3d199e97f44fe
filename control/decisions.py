"""The words of the arbiter: whom it knows, what it decides, what it refuses to work with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from vibrissa.control.kinematics import Float32s

NO_TICK = -1


class ArbiterError(ValueError):
    """A call that breaks the contract: limits, ticks that do not increase, an unknown owner."""


class ControllerId(NamedTuple):
    """Who a command comes from: a controller's name and the epoch of this instance of it."""

    name: str
    epoch: int = 0

    def __str__(self) -> str:
        return f"{self.name}#{self.epoch}"


RETRACT = ControllerId("retract")


@dataclass(frozen=True, slots=True)
class Decision:
    """Something the arbiter decided that a log must tell.

    tick is the tick the arbiter was in. kind: "fallback" (the built-in retract controller took over
    from `controller`), "routed" or "switched" (`controller` became the active one, by order or by a
    swap), "armed" (its switch is due), "registered", "forgotten", or "refused" (a command of
    `controller` was not applied, or nothing of what was asked for it was done).
    """

    tick: int
    kind: Literal["fallback", "refused", "routed", "registered", "forgotten", "armed", "switched"]
    controller: ControllerId
    cause: str

    def __str__(self) -> str:
        return f"tick {self.tick}: {self.kind} {self.controller}: {self.cause}"


class Routing(NamedTuple):
    """What to do now: apply the command float32[18] rad, if any; log the decisions."""

    command: Float32s | None
    decisions: tuple[Decision, ...]


class Armed(NamedTuple):
    """The switch that is due: to whom, at which tick, blended in over how many ticks."""

    controller: ControllerId
    at: int
    blend_ticks: int
