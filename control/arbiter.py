"""The arbiter owns the eighteen drives and gives them exactly one command per tick.

It is a pure state machine. The sampler tells it of every sample (`on_sample`) and of every command
that arrives (`on_command`) and applies what it returns; what it decides depends on that order only.
Of every tick exactly one of these is true:

    routed   the active controller's command was accepted, and given out slew limited
    built-in the retract controller is active and answered at `on_sample`
    held     nothing acceptable came before the next sample; the drives keep the last command

After `max_misses` held ticks in a row, or as soon as the active controller sends a command that no
drive may get, the built-in retract controller takes over in that same tick and stays until another
controller is routed or switched to.

A swap goes `register` (in shadow: noted, never routed), `request` (checked, then armed) and, inside
`on_sample` of the armed tick, after a second check, the switch: from that tick on the newcomer
answers, blended in from the last command over the ticks asked for. The replaced one stays in
shadow, ready for `rollback`, until `forget`. A refusal names its reason and changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.control.decisions import (
    NO_TICK,
    RETRACT,
    ArbiterError,
    Armed,
    ControllerId,
    Decision,
    Routing,
)
from vibrissa.control.drives import ADMITTED, WRONG_LENGTH, Drives, Violation
from vibrissa.control.kinematics import WHISKERS, Float32s, Float64s, whisker_name
from vibrissa.control.retract import Retract
from vibrissa.control.shadow import Shadow, ShadowStatus

__all__ = [
    "NO_TICK",
    "RETRACT",
    "Arbiter",
    "ArbiterError",
    "Armed",
    "ControllerId",
    "Decision",
    "Owners",
    "Routing",
]

MOST_CONTROLLERS = 8
"""Registered at once, the active one among them."""
MOST_STRANGERS = 8
"""Unregistered controllers whose commands are decisions, until owner or register change."""
LEAD = 2
"""Ticks from a request to its switch unless it says when, so that the newcomer hears of it."""
LONGEST_BLEND = 2000
"""Ticks."""


@dataclass(frozen=True, slots=True, eq=False)
class Owners:
    """Who has, had and will have the drives; the record of everyone registered, in that order.

    strangers: how many commands of unregistered controllers were refused.
    """

    tick: int
    active: ControllerId
    previous: ControllerId | None
    armed: Armed | None
    strangers: int
    shadows: dict[ControllerId, ShadowStatus]


NOTHING = Routing(None, ())


class Arbiter:
    """Routes one controller's commands to the drives; starts with the built-in retract controller.

    travel        float64[18] rad, commands lie in [0, travel] (a head's `swing`)
    slew_limit    rad per tick, largest change of what the drives get, whoever commands it
    max_misses    held ticks in a row that end a controller's rule (20 ticks = 10 ms), and the ticks
                  within which the slew limit must bring the drives to where a newcomer wants them
    fresh_ticks   samples of which a newcomer in shadow must have answered nine in ten on time
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
        fresh_ticks: int = 40,
        retract_speed: float = 0.0025,
        last_command: ArrayLike = 0.0,
    ) -> None:
        self._drives = Drives(travel, slew_limit, last_command)
        if not 0.0 < retract_speed <= slew_limit:
            raise ArbiterError(
                f"retract_speed: {retract_speed} rad per tick, expected in (0, {slew_limit}]"
            )
        if max_misses < 1:
            raise ArbiterError(f"max_misses: {max_misses}, expected >= 1")
        if fresh_ticks < 1:
            raise ArbiterError(f"fresh_ticks: {fresh_ticks}, expected >= 1")
        self.active = RETRACT
        self.previous: ControllerId | None = None
        self.armed: Armed | None = None
        self.misses = 0
        self._max_misses = max_misses
        self._fresh_ticks = fresh_ticks
        self._tick = NO_TICK
        self._sample = 0
        self._answered = True
        self._fallen = False  # RETRACT is active because of a fault, not by order
        self._records: dict[ControllerId, Shadow] = {}
        self._told: list[ControllerId] = []  # strangers whose refusal is a decision already
        self._strangers = 0
        self._built_in = self._owner = Shadow(fresh_ticks)
        self._retract = Retract(retract_speed)
        last = self._drives.last
        self._retract.activate(NO_TICK, last, last)
        Shadow(fresh_ticks).note(1, 0, 0, last, self._drives.travel, self._owner)  # compiles

    @property
    def last_command(self) -> Float32s:
        """What the drives hold, float32[18] rad (a copy)."""
        return self._drives.last.copy()

    @property
    def tick(self) -> int:
        """The tick of the last sample; -1 before the first."""
        return self._tick

    def on_sample(self, tick: int) -> Routing:
        """Open `tick`; the previous tick, if nothing answered it, is now held.

        A switch armed for this tick, or for one that got no sample, happens now unless the newcomer
        has lapsed or moved too far. Returns the retract command when the built-in controller is or
        becomes active, else no command: the active controller is to answer. Ticks without a sample,
        between the previous and this one, are held and count as nobody's miss. Raises ArbiterError
        when ticks do not increase.
        """
        if tick <= self._tick:
            raise ArbiterError(f"sample of tick {tick} after tick {self._tick}, expected a later")
        if not self._answered:
            self.misses += 1
        self._tick = tick
        self._sample += 1
        self._answered = False
        decisions: tuple[Decision, ...] = ()
        if self.armed is not None and tick >= self.armed.at:
            decisions = (self._switch(self.armed),)
        if self.active == RETRACT:
            return Routing(self._retracted(), decisions)
        if self.misses >= self._max_misses:
            return self._fall_back(f"no command for {self.misses} ticks", decisions)
        return Routing(None, decisions) if decisions else NOTHING

    def on_command(
        self, controller: ControllerId, tick: int, command: NDArray[np.floating]
    ) -> Routing:
        """A command float32[18] rad of `controller` that answers the sample of `tick`.

        Accepted from the active controller alone, for the current tick, once. A wrong length, a
        value that is not finite or one outside the travel ends the controller's rule; anything else
        of it that is not accepted is refused and changes nothing. A registered controller in shadow
        is noted and never routed or refused. One that is not registered is refused, but only its
        first such command is a decision, for at most MOST_STRANGERS of them, until the active
        controller or the register changes: a flood of commands is no flood of decisions.
        """
        record = self._records.get(controller)
        if record is None:
            return self._refuse_stranger(controller)
        if record is not self._owner:
            self._note(record, tick, command)
            return NOTHING
        if record.untimely(self._tick, tick):
            age = "stale" if tick < self._tick else "early"
            cause = f"{age}, answers tick {tick} in tick {self._tick}"
            return Routing(None, (self._refused(controller, cause),))
        if self._answered:
            self._note(record, tick, command)  # somebody else may have answered
            cause = f"tick {tick} is answered already"
            return Routing(None, (self._refused(controller, cause),))
        if command.shape != (WHISKERS,):
            return self._violated(Violation(tick, WRONG_LENGTH, 0, command.shape, 0.0))
        row = record.rows[self._sample & 1]
        row[:] = command
        out = np.empty(WHISKERS, dtype=np.float32)
        reason, i = self._drives.admit(tick, row, out)
        if reason != ADMITTED:
            found, limit = float(row[i]), float(self._drives.travel[i])
            return self._violated(Violation(tick, reason, i, found, limit))
        record.fresh(self._sample, tick)
        self.misses = 0
        return Routing(self._give(out), ())

    def on_failure(self, controller: ControllerId, cause: str) -> Routing:
        """`controller` is known to be dead; falls back at once when it is the active one.

        A switch armed for it is off. It stays registered, its fresh answers count from zero again.
        """
        record = self._records.get(controller)
        if record is None:
            return NOTHING
        record.interrupted()
        if record is self._owner:
            return self._fall_back(cause)
        if self.armed is None or self.armed.controller != controller:
            return NOTHING
        self.armed = None
        return Routing(None, (self._refused(controller, f"died before its tick: {cause}"),))

    def register(self, controller: ControllerId) -> Decision:
        """Know `controller` from now on; it is in shadow: its commands are noted, never routed."""
        if controller.name == RETRACT.name:
            return self._refused(controller, "built in, nobody else can be registered as retract")
        if controller in self._records:
            return self._refused(controller, "registered already")
        if len(self._records) >= MOST_CONTROLLERS:
            cause = f"full: {MOST_CONTROLLERS} controllers are registered, forget one first"
            return self._refused(controller, cause)
        self._records[controller] = Shadow(self._fresh_ticks)
        self._told.clear()
        return Decision(self._tick, "registered", controller, "in shadow")

    def forget(self, controller: ControllerId) -> Decision:
        """Know `controller` no longer, unless it is active or armed."""
        if controller not in self._records:
            return self._refused(controller, "unknown: not registered")
        if controller == self.active:
            return self._refused(controller, "active: it has the drives")
        if self.armed is not None and controller == self.armed.controller:
            return self._refused(controller, f"armed: takes over at tick {self.armed.at}")
        del self._records[controller]
        self._told.clear()
        return Decision(self._tick, "forgotten", controller, "no longer registered")

    def request(
        self, controller: ControllerId, tick: int, *, at: int | None = None, blend_ticks: int = 0
    ) -> Decision:
        """Arm a switch to `controller` at tick `at`, LEAD ticks after `tick` if that is not given.

        Refused, in this order: built in, unknown, already switching, in the past, blend (not within
        [0, LONGEST_BLEND]), active already, retracting (by order; a fallback can be ended so), not
        finite / out of range / wrong length (a command in the last `fresh_ticks` samples), stale
        (no fresh answer for LAPSE samples), not ready (more than one in TOLERANCE of the last
        `fresh_ticks` samples without a fresh answer), jump too large (from the last command to the
        newcomer's last one, beyond what the slew limit allows in `max_misses` or, if that is
        longer, `blend_ticks` ticks).
        """
        at = tick + LEAD if at is None else at
        cause = ""
        if controller.name == RETRACT.name:
            cause = "built in: takes over by a fault or by order, not by a swap"
        elif controller not in self._records:
            cause = "unknown: not registered"
        elif self.armed is not None:
            cause = f"already switching: to {self.armed.controller} at tick {self.armed.at}"
        elif at <= self._tick:
            cause = f"in the past: tick {at} in tick {self._tick}"
        elif not 0 <= blend_ticks <= LONGEST_BLEND:
            cause = f"blend: {blend_ticks} ticks, expected 0 to {LONGEST_BLEND}"
        cause = cause or self._objection(controller, blend_ticks)
        if cause:
            return self._refused(controller, cause)
        self.armed = Armed(controller, at, blend_ticks)
        cause = f"at tick {at}, after {self.active}, blended over {blend_ticks} ticks"
        return Decision(self._tick, "armed", controller, cause)

    def rollback(self, tick: int) -> Decision:
        """Request the controller that the last switch replaced; refused as `request` refuses."""
        if self.previous is None:
            return self._refused(self.active, "no previous owner: nothing was switched")
        return self.request(self.previous, tick)

    def route(self, controller: ControllerId) -> Decision:
        """Make `controller` the active one by order, from the first tick not answered yet.

        No check is made: it was activated with `last_command` just now. RETRACT begins at the next
        sample. `previous` and an armed switch stay. Raises ArbiterError unless it is registered.
        """
        if controller != RETRACT and controller not in self._records:
            raise ArbiterError(f"route: {controller} is not registered")
        before = self.active
        self._hand_over(controller)
        return Decision(self._tick, "routed", controller, f"after {before}")

    def owners(self) -> Owners:
        """A snapshot for reports."""
        shadows = {name: record.status(self._sample) for name, record in self._records.items()}
        return Owners(self._tick, self.active, self.previous, self.armed, self._strangers, shadows)

    def _note(self, record: Shadow, tick: int, command: NDArray[np.floating]) -> None:
        record.note(self._sample, self._tick, tick, command, self._drives.travel, self._owner)

    def _switch(self, armed: Armed) -> Decision:
        controller, _, blend_ticks = armed
        self.armed = None
        cause = self._objection(controller, blend_ticks, due=True)
        if cause:
            return self._refused(controller, cause)
        before = self.active
        self._hand_over(controller)
        self._drives.blend(self._tick, blend_ticks)
        if before != RETRACT:
            self.previous = before
        elif self.previous == controller:
            self.previous = None
        return Decision(self._tick, "switched", controller, f"after {before}")

    def _objection(self, controller: ControllerId, blend_ticks: int, *, due: bool = False) -> str:
        """Why a registered `controller` can't take over now; empty when it can."""
        if controller == self.active:
            return "active already: it has the drives"
        if self.active == RETRACT and not self._fallen:
            return "retracting: by order, no controller has the drives"
        record = self._records[controller]
        if due and (cause := record.lapsed(self._sample)):
            return f"went stale before its tick: {cause}"
        if not due and (cause := record.unfit(self._sample)):
            return cause
        limit = self._drives.slew_limit * max(self._max_misses, blend_ticks)
        jump, i = self._drives.jump(record.command)
        if jump > limit:
            where = f"{whisker_name(i)} {jump:.6g} rad from the last command"
            return f"jump too large: {where}, expected at most {limit:.6g}"
        return ""

    def _hand_over(self, controller: ControllerId) -> None:
        self.active = controller
        self.misses = 0
        self._fallen = False
        self._drives.blend(self._tick, 0)
        self._told.clear()
        for record in self._records.values():
            record.compare_anew()
        if controller == RETRACT:
            self._owner = self._built_in
            self._retract.activate(self._tick, self._drives.last, self._drives.last)
        else:
            self._owner = self._records[controller]

    def _refused(self, controller: ControllerId, cause: str) -> Decision:
        return Decision(self._tick, "refused", controller, cause)

    def _refuse_stranger(self, controller: ControllerId) -> Routing:
        self._strangers += 1
        if len(self._told) >= MOST_STRANGERS or controller in self._told:
            return NOTHING
        self._told.append(controller)
        if controller.name == RETRACT.name:
            cause = "built in, takes no commands from outside"
        else:
            cause = f"unknown, not registered while {self.active} is active"
        return Routing(None, (self._refused(controller, cause),))

    def _violated(self, violation: Violation) -> Routing:
        self._owner.violated(self._sample, violation)
        return self._fall_back(str(violation))

    def _fall_back(self, cause: str, earlier: tuple[Decision, ...] = ()) -> Routing:
        decision = Decision(self._tick, "fallback", self.active, cause)
        self._hand_over(RETRACT)
        self._fallen = True
        command = None if self._answered else self._retracted()
        return Routing(command, (*earlier, decision))

    def _retracted(self) -> Float32s:
        last = self._drives.last  # the law looks at none of the signals
        command = self._retract.step(self._tick, last, last, last)
        self._built_in.rows[self._sample & 1][:] = command
        self._built_in.fresh(self._sample, self._tick)
        return self._give(command)

    def _give(self, command: Float32s) -> Float32s:
        self._drives.last[:] = command
        self._answered = True
        return command
