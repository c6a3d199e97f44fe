"""The eighteen drives as the arbiter sees them: what they hold, and what they may get next."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.control.controller import slewed
from vibrissa.control.decisions import NO_TICK, ArbiterError
from vibrissa.control.kinematics import WHISKERS, Float32s, Float64s, per_whisker, whisker_name
from vibrissa.numerics import compiled

ADMITTED, NOT_FINITE, OUT_OF_RANGE, WRONG_LENGTH = 0, 1, 2, 3
REASONS = ("", "not finite", "out of range", "wrong length")


class Violation(NamedTuple):
    """A command that no drive may get: which whisker was sent where, or of what shape it was."""

    tick: int
    reason: int
    whisker: int
    found: float | tuple[int, ...]
    limit: float

    def __str__(self) -> str:
        if self.reason == WRONG_LENGTH:
            return f"command of shape {self.found}, expected ({WHISKERS},)"
        what = f"{whisker_name(self.whisker)} commanded to {self.found:.6g} rad"
        return f"{what}, expected in [0, {self.limit:.6g}]"


@compiled
def check_command(command: Float32s, travel: Float32s) -> tuple[int, int]:
    """(ADMITTED, 0), or why no drive may get `command` (rad) and the first whisker concerned."""
    bad = 0
    for i in range(command.shape[0]):
        bad += 0 if 0.0 <= command[i] <= travel[i] else 1
    if bad == 0:
        return ADMITTED, 0
    for i in range(command.shape[0]):
        if not math.isfinite(command[i]):
            return NOT_FINITE, i
        if not 0.0 <= command[i] <= travel[i]:
            return OUT_OF_RANGE, i
    return ADMITTED, 0


@compiled
def _largest_difference(one: Float32s, other: Float32s) -> tuple[float, int]:
    largest, whisker = 0.0, 0
    for i in range(one.shape[0]):
        difference = abs(np.float64(one[i]) - np.float64(other[i]))
        if difference > largest:
            largest, whisker = difference, i
    return largest, whisker


@compiled
def _admit(
    wanted: Float32s,
    travel: Float32s,
    last: Float32s,
    slew_limit: float,
    base: Float32s,
    weight: float,
    out: Float32s,
) -> tuple[int, int]:
    """Blend `wanted` into `base` and slew limit it into `out`, if `check_command` admits it."""
    reason, whisker = check_command(wanted, travel)
    if reason != ADMITTED:
        return reason, whisker
    for i in range(wanted.shape[0]):
        goal = np.float64(wanted[i])
        if weight < 1.0:
            goal = base[i] + (goal - base[i]) * weight
        out[i] = slewed(goal, last[i], slew_limit)
    return ADMITTED, 0


class Drives:
    """Limits, last command and blend.

    travel       float64[18] rad, commands lie in [0, travel]
    slew_limit   rad per tick, largest change of what the drives get
    last_command float32[18] rad, what they hold at the start

    `travel` and `last` (rad, what they hold now) are float32[18]. Raises ArbiterError.
    """

    def __init__(self, travel: Float64s, slew_limit: float, last_command: ArrayLike) -> None:
        self.travel = per_whisker(travel, "travel", ArbiterError).astype(np.float32)
        self.last = per_whisker(last_command, "last_command", ArbiterError).astype(np.float32)
        for i in range(WHISKERS):
            if self.travel[i] <= 0.0:
                raise ArbiterError(
                    f"travel: {whisker_name(i)} is {self.travel[i]} rad, expected > 0"
                )
            if not 0.0 <= self.last[i] <= self.travel[i]:
                raise ArbiterError(
                    f"last_command: {whisker_name(i)} is {self.last[i]} rad, "
                    f"expected in [0, {self.travel[i]}]"
                )
        if not 0.0 < slew_limit < math.inf:
            raise ArbiterError(f"slew_limit: {slew_limit} rad per tick, expected finite and > 0")
        self.slew_limit = slew_limit
        self._base = self.last.copy()
        self._blend_start = NO_TICK
        self._blend_ticks = 0
        self.admit(0, self.last, self.last.copy())  # compiles
        self.jump(self.last)

    def blend(self, tick: int, ticks: int) -> None:
        """From `tick` on, over `ticks`, go linearly from what the drives hold to the commands.

        The share of the command is 1/ticks at `tick` and 1 from the last of them on. 0: no blend.
        """
        self._base[:] = self.last
        self._blend_start = tick
        self._blend_ticks = ticks

    def admit(self, tick: int, wanted: Float32s, out: Float32s) -> tuple[int, int]:
        """What the drives may get at `tick` of `wanted` (rad): blended and slew limited in `out`.

        Returns (ADMITTED, 0), or the reason why they may get nothing of it and the whisker.
        """
        weight = 1.0
        if self._blend_ticks > 0:
            weight = (tick - self._blend_start + 1) / self._blend_ticks
        return _admit(wanted, self.travel, self.last, self.slew_limit, self._base, weight, out)

    def jump(self, command: Float32s) -> tuple[float, int]:
        """Largest |command - what the drives hold| in rad, and its whisker."""
        return _largest_difference(command, self.last)
