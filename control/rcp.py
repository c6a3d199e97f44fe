"""Rapid cessation of protraction (RCP): a whisker that feels a touch protracts less far.

Salman and Pearson III E. Per whisker i, without neighbours:

    e_i(t) = max(0, |y_i(t) - mu_i| - threshold_i)           threshold_i = 20 sigma_i, free whisking
    a_i(t) = clamp(A0_i - k_i mean_window(e_i), A_min_i, A0_i)
    command_i(t) = minimum_i + a_i(t) (1 - cos(2 pi phase)) / 2

The start angle `minimum` stays constant. The paper leaves the gain k, the averaging window and the
reset rule open; they are parameters here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vibrissa.control.calibration import Calibration
from vibrissa.control.controller import LAST, LawController, slewed
from vibrissa.control.kinematics import (
    PER_RING,
    RINGS,
    WHISKERS,
    Float32s,
    Float64s,
    per_whisker,
    whisker_name,
)
from vibrissa.control.whisk_pattern import (
    AMPLITUDE,
    MINIMUM,
    PERIOD,
    SLEW,
    WHISK_ROWS,
    WhiskParams,
    desired_angle,
    protraction_at,
)
from vibrissa.numerics import compiled

# parameter rows after the whisk's own
MEAN, THRESHOLD, GAIN, FLOOR, RESET = range(WHISK_ROWS, WHISK_ROWS + 5)
RCP_ROWS = WHISK_ROWS + 5
# state rows after the last command; the averaging window fills the rest
SUM, CEILING, CYCLE, WINDOW = 1, 2, 3, 4

ResetRule = Literal["cycle", "latch", "never"]
RESET_CODES: dict[ResetRule, int] = {"cycle": 0, "latch": 1, "never": 2}
LATCH, NEVER = RESET_CODES["latch"], RESET_CODES["never"]

# Base moment per rad of impingement of the head's tapered whiskers touched at 3/4 of their length
# (small-angle cantilever, E = 3 GPa, 0.8-0.3, 1.3-0.4 and 1.6-0.4 mm), N m per rad, front mid rear.
CONTACT_STIFFNESS = (0.0026, 0.0074, 0.0106)


class RcpParameterError(ValueError):
    """RCP parameters out of range."""


def normalised_gain(g: float) -> tuple[float, float, float]:
    """Gain per ring, rad per N m: g over the contact stiffness of the ring (g = 3: the default)."""
    front, mid, rear = CONTACT_STIFFNESS
    return g / front, g / mid, g / rear


@dataclass(frozen=True, eq=False)
class RcpParams:
    """The whisk and how touch reduces it.

    whisk              the unperturbed whisk
    gain               rad per N m per ring (front, mid, rear), >= 0
    window_ticks       length of the averaging window, >= 1. The default, 10 ms, keeps the loop
                       through a 10 Hz motor stable on contacts down to half the whisker, 2.2 times
                       stiffer than the normalisation assumes; 20 ms or more chatter there
    amplitude_minimum  float64[18] rad (or one number), A_min, in [0, whisk.amplitude]
    reset              "cycle": the window is emptied at each cycle start;
                       "latch": the same, and within a cycle the amplitude never grows again;
                       "never": the window slides on over the cycle start

    Raises RcpParameterError.
    """

    whisk: WhiskParams
    gain: tuple[float, float, float] = normalised_gain(3.0)
    window_ticks: int = 20
    amplitude_minimum: Float64s | float = 0.0
    reset: ResetRule = "cycle"

    def __post_init__(self) -> None:
        if len(self.gain) != len(RINGS):
            raise RcpParameterError(f"gain: {len(self.gain)} values, expected one per ring, 3")
        for ring, gain in zip(RINGS, self.gain, strict=True):
            if not 0.0 <= gain < math.inf:
                raise RcpParameterError(f"gain: {ring} ring is {gain}, expected finite and >= 0")
        if self.window_ticks < 1:
            raise RcpParameterError(f"window_ticks: {self.window_ticks}, expected >= 1")
        if self.reset not in RESET_CODES:
            raise RcpParameterError(f"reset: {self.reset!r}, expected one of {list(RESET_CODES)}")
        floor = per_whisker(self.amplitude_minimum, "amplitude_minimum", RcpParameterError)
        object.__setattr__(self, "amplitude_minimum", floor)
        for i in range(WHISKERS):
            if not 0.0 <= floor[i] <= self.whisk.amplitude[i]:
                raise RcpParameterError(
                    f"amplitude_minimum: {whisker_name(i)} is {floor[i]}, "
                    f"expected in [0, {self.whisk.amplitude[i]}]"
                )

    def rows(self) -> Float64s:
        """The law's parameters, float64[RCP_ROWS, 18], with thresholds that nothing exceeds."""
        rows = np.empty((RCP_ROWS, WHISKERS), dtype=np.float64)
        rows[:WHISK_ROWS] = self.whisk.rows()
        rows[MEAN] = 0.0
        rows[THRESHOLD] = math.inf
        rows[GAIN] = np.repeat(np.array(self.gain, dtype=np.float64), PER_RING)
        rows[FLOOR] = self.amplitude_minimum
        rows[RESET] = RESET_CODES[self.reset]
        return rows


@compiled
def rcp_command(
    tick: int,
    theta: Float32s,
    x: Float32s,
    y: Float32s,
    parameters: Float64s,
    state: Float64s,
    command: Float32s,
) -> None:
    """Law: the equation of the module docstring, slew limited.

    parameters: `RcpParams.rows()`; state: float64[WINDOW + window_ticks, 18]. A reading that is not
    finite counts as no touch.
    """
    window = state.shape[0] - WINDOW
    period = int(parameters[PERIOD, 0])
    reset = int(parameters[RESET, 0])
    cycle = tick // period + 1.0  # 0 in the state: no tick seen since activation
    if state[CYCLE, 0] != cycle:
        if state[CYCLE, 0] == 0.0 or reset != NEVER:
            state[WINDOW:] = 0.0
            state[SUM] = 0.0
            state[CEILING] = parameters[AMPLITUDE]
        state[CYCLE] = cycle
    slot = WINDOW + tick % window
    share = protraction_at(tick, period)
    for i in range(WHISKERS):
        excess = abs(y[i] - parameters[MEAN, i]) - parameters[THRESHOLD, i]
        excess = excess if 0.0 < excess < math.inf else 0.0
        state[SUM, i] += excess - state[slot, i]
        state[slot, i] = excess
    if slot == WINDOW:  # sum afresh once per window: rounding can't pile up
        for i in range(WHISKERS):
            state[SUM, i] = 0.0
            for j in range(WINDOW, state.shape[0]):
                state[SUM, i] += state[j, i]
    for i in range(WHISKERS):
        amplitude = parameters[AMPLITUDE, i] - parameters[GAIN, i] * (state[SUM, i] / window)
        amplitude = min(max(amplitude, parameters[FLOOR, i]), state[CEILING, i])
        state[CEILING, i] = amplitude if reset == LATCH else state[CEILING, i]
        desired = desired_angle(parameters[MINIMUM, i], amplitude, share)
        command[i] = slewed(desired, state[LAST, i], parameters[SLEW, i])
        state[LAST, i] = command[i]


@compiled
def rcp_block(
    first_tick: int,
    theta: Float32s,
    x: Float32s,
    y: Float32s,
    parameters: Float64s,
    state: Float64s,
    commands: Float32s,
) -> None:
    """The law over consecutive ticks; signals and commands are float32[n, 18]."""
    for j in range(commands.shape[0]):
        rcp_command(first_tick + j, theta[j], x[j], y[j], parameters, state, commands[j])


class Rcp(LawController):
    """RCP whisk controller; whisks in open loop until it is calibrated."""

    def __init__(self, params: RcpParams) -> None:
        self.params = params
        self._calibrated = False
        super().__init__(rcp_command, params.rows(), state_rows=WINDOW + params.window_ticks)

    @property
    def needs_calibration(self) -> bool:
        return not self._calibrated

    def calibrate(self, calibration: Calibration) -> None:
        """Take mean and threshold of y; what was felt before counts no more."""
        self.parameters[MEAN] = calibration.mean_y
        self.parameters[THRESHOLD] = calibration.threshold_y
        self.state[SUM:] = 0.0
        self._calibrated = True

    def set_parameter(self, name: str, value: object) -> None:
        """Change `gain` (in contact stiffnesses, 0 to 1000) from the next step on.

        Raises RcpParameterError for another name or a value out of range.
        """
        if name != "gain":
            raise RcpParameterError(f"{name}: expected gain, nothing else can be changed")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= 1000:
            raise RcpParameterError(f"gain: found {value!r}, expected 0 to 1000")
        self.parameters[GAIN] = np.repeat(np.array(normalised_gain(float(value))), PER_RING)
