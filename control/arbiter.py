"""The arbiter owns the eighteen drives and gives them exactly one command per tick.

It is a pure state machine. The sampler tells it of every sample (`on_sample`) and of every command
that arrives (`on_command`) and applies what it returns; what it decides depends on that order only.
Of every tick exactly one of these is true:

    routed   the active controller's command was accepted, and given out slew limited
    built-in the retract controller is active and answered at `on_sample`
    held     nothing acceptable came before the next sample; the drives keep the last command

After `max_misses` held ticks in a row, or as soon as the active controller sends a command that no
drive may get, the built-in retract controller takes over in that same tick and stays until `route`
names another controller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.control.controller import slewed
from vibrissa.control.kinematics import WHISKERS, Float32s, Float64s, per_whisker, whisker_name
from vibrissa.control.retract import Retract
from vibrissa.numerics import compiled

NO_TICK = -1
ADMITTED, NOT_FINITE, OUT_OF_RANGE = 0, 1, 2


class ArbiterError(ValueError):
    """A call that breaks the arbiter's contract: limits, or ticks that do not increase."""


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

    kind: "fallback" (the built-in retract controller took over from `controller`), "refused" (a
    command of `controller` was not applied) or "routed" (`controller` became the active one).
    """

    tick: int
    kind: Literal["fallback", "refused", "routed"]
    controller: ControllerId
    cause: str

    def __str__(self) -> str:
        return f"tick {self.tick}: {self.kind} {self.controller}: {self.cause}"


class Routing(NamedTuple):
    """What to do now: apply the command float32[18] rad, if any; log the decision, if any."""

    command: Float32s | None
    decision: Decision | None


@compiled
def _admit(
    wanted: Float32s, travel: Float32s, last: Float32s, slew_limit: float, out: Float32s
) -> tuple[int, int]:
    """Slew limit `wanted` into `out`: (ADMITTED, 0), or a reason and the whisker."""
    for i in range(wanted.shape[0]):
        if not math.isfinite(wanted[i]):
            return NOT_FINITE, i
        if not 0.0 <= wanted[i] <= travel[i]:
            return OUT_OF_RANGE, i
    for i in range(wanted.shape[0]):
        out[i] = slewed(wanted[i], last[i], slew_limit)
    return ADMITTED, 0


class Arbiter:
    """Routes one controller's commands to the drives; starts with the built-in retract controller.

    travel        float64[18] rad, commands lie in [0, travel] (a head's `swing`)
    slew_limit    rad per tick, largest change of what the drives get, whoever commands it
    max_misses    held ticks in a row that end a controller's rule (20 ticks = 10 ms)
    retract_speed rad per tick, of the built-in retract controller, at most slew_limit
    last_command  float32[18] rad, what the drives hold at the start

    Raises ArbiterError.
    """

    def __init__(
        self,
        travel: Float64s,
        *,
        slew_limit: float = 0.005,
        max_misses: int = 20,
        retract_speed: float = 0.0025,
        last_command: ArrayLike = 0.0,
    ) -> None:
        self._travel = per_whisker(travel, "travel", ArbiterError).astype(np.float32)
        start = per_whisker(last_command, "last_command", ArbiterError).astype(np.float32)
        for i in range(WHISKERS):
            if self._travel[i] <= 0.0:
                raise ArbiterError(
                    f"travel: {whisker_name(i)} is {self._travel[i]} rad, expected > 0"
                )
            if not 0.0 <= start[i] <= self._travel[i]:
                raise ArbiterError(
                    f"last_command: {whisker_name(i)} is {start[i]} rad, "
                    f"expected in [0, {self._travel[i]}]"
                )
        if not 0.0 < slew_limit < math.inf:
            raise ArbiterError(f"slew_limit: {slew_limit} rad per tick, expected finite and > 0")
        if not 0.0 < retract_speed <= slew_limit:
            raise ArbiterError(
                f"retract_speed: {retract_speed} rad per tick, expected in (0, {slew_limit}]"
            )
        if max_misses < 1:
            raise ArbiterError(f"max_misses: {max_misses}, expected >= 1")
        self.active = RETRACT
        self.misses = 0
        self._slew_limit = slew_limit
        self._max_misses = max_misses
        self._last = start
        self._wanted = np.zeros(WHISKERS, dtype=np.float32)
        self._tick = NO_TICK
        self._answered = True
        self._retract = Retract(retract_speed)
        self._retract.activate(NO_TICK, self._last, self._last)
        _admit(self._wanted, self._travel, self._last, slew_limit, self._wanted)  # compiles

    @property
    def last_command(self) -> Float32s:
        """What the drives hold, float32[18] rad (a copy)."""
        return self._last.copy()

    @property
    def tick(self) -> int:
        """The tick of the last sample; -1 before the first."""
        return self._tick

    def on_sample(self, tick: int) -> Routing:
        """Open `tick`; the previous tick, if nothing answered it, is now held.

        Returns the retract command when the built-in controller is or becomes active, else no
        command: the active controller is to answer. Ticks without a sample, between the previous
        and this one, are held and count as nobody's miss. Raises ArbiterError when ticks do not
        increase.
        """
        if tick <= self._tick:
            raise ArbiterError(f"sample of tick {tick} after tick {self._tick}, expected a later")
        if not self._answered:
            self.misses += 1
        self._tick = tick
        self._answered = False
        if self.active == RETRACT:
            return Routing(self._retracted(), None)
        if self.misses >= self._max_misses:
            return self._fall_back(f"no command for {self.misses} ticks")
        return Routing(None, None)

    def on_command(
        self, controller: ControllerId, tick: int, command: NDArray[np.floating]
    ) -> Routing:
        """A command float32[18] rad of `controller` that answers the sample of `tick`.

        Accepted from the active controller alone, for the current tick, once. A wrong length, a
        value that is not finite or one outside the travel ends the controller's rule; anything else
        that is not accepted is refused and changes nothing. Every refused command is a decision:
        commands of controllers in shadow need not come here.
        """
        if controller == RETRACT:
            return self._refuse(controller, "built in, takes no commands from outside")
        if controller != self.active:
            return self._refuse(controller, f"not active, {self.active} is")
        if tick != self._tick:
            age = "stale" if tick < self._tick else "early"
            return self._refuse(controller, f"{age}, answers tick {tick} in tick {self._tick}")
        if self._answered:
            return self._refuse(controller, f"tick {tick} is answered already")
        if command.shape != (WHISKERS,):
            return self._fall_back(f"command of shape {command.shape}, expected ({WHISKERS},)")
        self._wanted[:] = command
        out = np.empty(WHISKERS, dtype=np.float32)
        reason, i = _admit(self._wanted, self._travel, self._last, self._slew_limit, out)
        if reason != ADMITTED:
            what = f"{whisker_name(i)} commanded to {self._wanted[i]:.6g} rad"
            return self._fall_back(f"{what}, expected in [0, {self._travel[i]:.6g}]")
        self.misses = 0
        return Routing(self._give(out), None)

    def on_failure(self, controller: ControllerId, cause: str) -> Routing:
        """`controller` is known to be dead; falls back at once when it is the active one."""
        if controller != self.active or controller == RETRACT:
            return Routing(None, None)
        return self._fall_back(cause)

    def route(self, controller: ControllerId) -> Decision:
        """Make `controller` the active one, from the first tick that is not answered yet.

        The caller has activated it with `last_command`. RETRACT begins at the next sample.
        """
        before = self.active
        self.active = controller
        self.misses = 0
        if controller == RETRACT:
            self._retract.activate(self._tick, self._last, self._last)
        return Decision(self._tick, "routed", controller, f"after {before}")

    def _refuse(self, controller: ControllerId, cause: str) -> Routing:
        return Routing(None, Decision(self._tick, "refused", controller, cause))

    def _fall_back(self, cause: str) -> Routing:
        decision = Decision(self._tick, "fallback", self.active, cause)
        self.active = RETRACT
        self.misses = 0
        self._retract.activate(self._tick, self._last, self._last)
        return Routing(None if self._answered else self._retracted(), decision)

    def _retracted(self) -> Float32s:
        return self._give(self._retract.step(self._tick, self._last, self._last, self._last))

    def _give(self, command: Float32s) -> Float32s:
        self._last[:] = command
        self._answered = True
        return command
