"""The contract of a whisk controller, and the shell that turns a compiled control law into one.

A control *law* is a compiled pure function

    law(tick, theta, x, y, parameters, state, command) -> None

    tick        int, 2 kHz ticks since the run's start
    theta       float32[18] rad, measured protraction
    x, y        float32[18] N m, base bending moments
    parameters  float64[P, 18], read only
    state       float64[S, 18], updated in place; row LAST holds the last command; all zero but that
                row is the valid state of a controller that has just been activated
    command     float32[18] rad, written

Every law has this one signature, so a simulator calls it a tick at a time inside its own compiled
loop and gets the same bits as the live controller, which calls it once per message.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from vibrissa.control.calibration import Calibration
from vibrissa.control.kinematics import WHISKERS, Float32s, Float64s
from vibrissa.numerics import compiled

LAST = 0  # state row: the last command, rad


class SignalShapeError(ValueError):
    """An array handed to a controller does not hold one value per whisker."""


class Controller(Protocol):
    """What every whisk controller does; third parties need nothing else."""

    @property
    def needs_calibration(self) -> bool:
        """True while the law lacks the thresholds that `calibrate` brings."""

    def activate(self, tick: int, last_command: Float32s, theta: Float32s) -> None:
        """Take over at `tick`, bumplessly.

        last_command float32[18] rad is what the drives hold, theta float32[18] rad what the
        encoders read. The next `step` starts from the last command and converges to the
        controller's own law within its slew limit. Everything felt before is forgotten.
        """

    def calibrate(self, calibration: Calibration) -> None:
        """Take the thresholds found in free whisking; laws that need none ignore them."""

    def step(self, tick: int, theta: Float32s, x: Float32s, y: Float32s) -> Float32s:
        """The command float32[18] rad that answers the sample of `tick` (theta rad, x y N m)."""


class Law(Protocol):
    """The compiled function of the module docstring."""

    def __call__(
        self,
        tick: int,
        theta: Float32s,
        x: Float32s,
        y: Float32s,
        parameters: Float64s,
        state: Float64s,
        command: Float32s,
    ) -> None: ...


@compiled
def slewed(desired: float, last: float, limit: float) -> float:
    """`desired`, but no further than `limit` from `last` (rad)."""
    if desired > last + limit:
        return last + limit
    if desired < last - limit:
        return last - limit
    return desired


class LawController:
    """A controller made of one law, its parameters and its state.

    `law`, `parameters` and `state` are public: a simulator hands them to its compiled loop. The
    arrays handed to `step` are copied first, so read-only or strided ones do not make the law
    compile anew in the middle of a run.
    """

    def __init__(self, law: Law, parameters: Float64s, state_rows: int) -> None:
        self.law = law
        self.parameters = np.ascontiguousarray(parameters, dtype=np.float64)
        self.state = np.zeros((state_rows, WHISKERS), dtype=np.float64)
        self._theta, self._x, self._y = np.zeros((3, WHISKERS), dtype=np.float32)
        scratch = np.empty(WHISKERS, dtype=np.float32)  # the first call compiles: before tick 0
        law(0, self._theta, self._x, self._y, self.parameters, self.state.copy(), scratch)

    @property
    def needs_calibration(self) -> bool:
        return False

    def activate(self, tick: int, last_command: Float32s, theta: Float32s) -> None:
        _check("last_command", last_command)
        self.state[:] = 0.0
        self.state[LAST] = last_command

    def calibrate(self, calibration: Calibration) -> None:
        """A law without thresholds has nothing to take from a calibration."""

    def step(self, tick: int, theta: Float32s, x: Float32s, y: Float32s) -> Float32s:
        _check("theta", theta)
        _check("x", x)
        _check("y", y)
        self._theta[:] = theta
        self._x[:] = x
        self._y[:] = y
        command = np.empty(WHISKERS, dtype=np.float32)
        self.law(tick, self._theta, self._x, self._y, self.parameters, self.state, command)
        return command


def _check(name: str, values: Float32s) -> None:
    if values.shape != (WHISKERS,):
        raise SignalShapeError(f"{name}: expected shape ({WHISKERS},), found {values.shape}")
