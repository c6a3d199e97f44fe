"""What the arbiter knows of one registered controller: how punctual, sound and different it is.

A controller in *shadow* gets the live samples and answers them; its commands are noted here and go
nowhere. Samples are counted from 1 (`sample`); an answer is *fresh* when it comes before the next
sample and holds what a drive may get. Everything a command costs is constant: two rows hold the
answers to the current and the previous sample, so that a shadow is compared with the active
controller over the same sample, whichever of the two was quicker.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.decisions import NO_TICK
from vibrissa.control.drives import ADMITTED, REASONS, WRONG_LENGTH, Violation, check_command
from vibrissa.control.kinematics import WHISKERS, Float32s, Float64s
from vibrissa.numerics import compiled

LARGEST, SUM = 0, 1  # of the divergence figures, rad
LAPSE = 10
"""Samples after which a controller without a fresh answer is stale."""
TOLERANCE = 10
"""One in so many samples may go unanswered while a controller gets ready."""


@dataclass(frozen=True, slots=True, eq=False)
class ShadowStatus:
    """A registered controller in figures.

    fresh_ticks  fresh answers in a row up to now
    last_tick    the last tick it answered on time, -1 if none
    command      float32[18] rad, that answer
    on_time      answers before the next sample; late: after it; unasked: early or repeated
    violations   answers on time that no drive may get
    compared     ticks of this stretch of fresh answers in which the active controller answered too
    divergence_max, divergence_mean  |command - active controller's| rad over those and all whiskers
    """

    fresh_ticks: int
    last_tick: int
    command: Float32s
    on_time: int
    late: int
    unasked: int
    violations: int
    compared: int
    divergence_max: float
    divergence_mean: float


@compiled
def _note(
    command: Float32s,
    travel: Float32s,
    mine: Float32s,
    theirs: Float32s,
    figures: Float64s,
    compare: bool,
) -> tuple[int, int]:
    """Check `command`; add the difference of the previous answers to `figures`."""
    if compare:
        for i in range(mine.shape[0]):
            difference = abs(np.float64(mine[i]) - np.float64(theirs[i]))
            figures[LARGEST] = max(figures[LARGEST], difference)
            figures[SUM] += difference
    return check_command(command, travel)


def _broken(violation: Violation) -> str:
    return f"{REASONS[violation.reason]}: {violation}, at tick {violation.tick}"


class Shadow:
    """The record of one controller, active or in shadow.

    need: how many samples tell whether it is ready.
    """

    __slots__ = (
        "_compared",
        "_figures",
        "_heard",
        "_last_tick",
        "_late",
        "_need",
        "_on_time",
        "_sound",
        "_streak",
        "_unasked",
        "_violated",
        "_violation",
        "_violations",
        "_window",
        "rows",
    )

    def __init__(self, need: int) -> None:
        self.rows = (np.zeros(WHISKERS, np.float32), np.zeros(WHISKERS, np.float32))
        """float32[18] rad each: the answers to samples of even and of odd number."""
        self._heard = 0  # the last sample answered on time, soundly or not
        self._streak = 0  # the fresh answers in a row that end with it
        self._sound = 0  # the last sample with a fresh answer
        self._need = need
        self._window = 0  # a bit for each of `need` samples up to the last heard: 1 for fresh
        self._last_tick = NO_TICK
        self._on_time = self._late = self._unasked = self._violations = 0
        self._violated = 0  # the last sample with an answer that no drive may get ...
        self._violation: Violation | None = None  # ... and what was wrong with it
        self._figures = np.zeros(2, np.float64)
        self._compared = 0

    @property
    def command(self) -> Float32s:
        """The last answer on time, float32[18] rad (not a copy)."""
        return self.rows[self._heard & 1]

    def answered(self, sample: int) -> bool:
        """Whether `sample` lies in the current stretch of fresh answers."""
        return self._heard - self._streak < sample <= self._heard

    def unfit(self, sample: int) -> str:
        """Why this controller can't be armed in `sample`; empty when it can.

        It can when of the last `need` samples (the present one counts once it is answered) all but
        one in TOLERANCE got a fresh answer, none of them before an answer that no drive may get.
        """
        end = sample if self._heard == sample else sample - 1
        behind = min(end - self._heard, self._need)
        fresh = (self._window << behind & (1 << self._need) - 1).bit_count()
        expected = self._need - self._need // TOLERANCE
        if fresh >= expected:
            return self.lapsed(sample)
        count = f"{fresh} fresh answers to {self._need} samples, expected {expected}"
        if self._violation is not None and end - self._violated < self._need:
            return f"{_broken(self._violation)}, since then {count}"
        if 0 < self._sound < sample - LAPSE:
            return self._stale()
        return f"not ready: {count}"

    def lapsed(self, sample: int) -> str:
        """Why this controller, once armed, can't take over in `sample`; empty when it can.

        It can when within the last LAPSE samples it gave a fresh answer and none that no drive may
        get: one that was ready is not given up for a few late answers.
        """
        if self._violation is not None and self._violated >= sample - LAPSE:
            return _broken(self._violation)
        return "" if self._sound >= sample - LAPSE else self._stale()

    def _stale(self) -> str:
        return f"stale: no fresh answer for {LAPSE} ticks, last answer to tick {self._last_tick}"

    def note(
        self,
        sample: int,
        now: int,
        tick: int,
        command: NDArray[np.floating],
        travel: Float32s,
        active: Shadow,
    ) -> None:
        """A command for `tick` that came in `sample`, of tick `now`, while `active` rules."""
        if self.untimely(now, tick):
            return
        if self._heard == sample:
            self._unasked += 1
            return
        if command.shape != (WHISKERS,):
            self.violated(sample, Violation(tick, WRONG_LENGTH, 0, command.shape, 0.0))
            return
        row, before = self.rows[sample & 1], ~sample & 1
        row[:] = command
        compare = self.answered(sample - 1) and active.answered(sample - 1)
        mine, theirs = self.rows[before], active.rows[before]
        reason, i = _note(row, travel, mine, theirs, self._figures, compare)
        if reason != ADMITTED:
            self.violated(sample, Violation(tick, reason, i, float(row[i]), float(travel[i])))
            return
        self._compared += compare
        self.fresh(sample, tick)

    def untimely(self, now: int, tick: int) -> bool:
        """Count a command for `tick` that came in tick `now` if that is too late or too early."""
        if tick == now:
            return False
        if tick < now:
            self._late += 1
        else:
            self._unasked += 1
        return True

    def fresh(self, sample: int, tick: int) -> None:
        """A sound answer to `sample` came on time."""
        if self._heard == sample:
            return
        after = sample - self._heard
        if after > 1:
            self._streak = 0
            self.compare_anew()
        self._streak += 1
        self._window = (self._window << min(after, self._need) | 1) & (1 << self._need) - 1
        self._heard = self._sound = sample
        self._last_tick = tick
        self._on_time += 1

    def violated(self, sample: int, violation: Violation) -> None:
        """An answer to `sample` came on time that no drive may get."""
        self.interrupted()
        self._violation = violation
        self._heard = self._violated = sample
        self._last_tick = violation.tick
        self._on_time += 1
        self._violations += 1

    def interrupted(self) -> None:
        """No answer so far counts any more."""
        self._streak = self._window = self._sound = 0
        self.compare_anew()

    def compare_anew(self) -> None:
        """Forget the divergence: another controller is the active one now."""
        self._figures[:] = 0.0
        self._compared = 0

    def status(self, sample: int) -> ShadowStatus:
        """The figures as of `sample`."""
        n = max(self._compared * WHISKERS, 1)
        return ShadowStatus(
            fresh_ticks=self._streak if self._heard >= sample - 1 else 0,
            last_tick=self._last_tick,
            command=self.command.copy(),
            on_time=self._on_time,
            late=self._late,
            unasked=self._unasked,
            violations=self._violations,
            compared=self._compared,
            divergence_max=float(self._figures[LARGEST]),
            divergence_mean=float(self._figures[SUM]) / n,
        )
