"""Whiskers that answer to each other's touch: spread reduction and contralateral protraction.

Rats that touch something not only stop the touching whisker (RCP) but bring more whiskers to bear
on it, "minimal impingement, maximal contact" (Mitchinson, Martin, Grant, Prescott, Proc. R. Soc. B
2007; Grant, Mitchinson, Fox, Prescott, J. Neurophysiol. 2009):

    spread reduction            the whiskers of one row protract to more nearly the same degree
    contralateral protraction   whiskers on the side away from the touch protract further

On the head a row is the three whiskers (front, mid, rear) of one azimuth, and the contralateral row
is the one opposite, three sixths of the way round. Per whisker i of row r, with a_i the amplitude
that RCP leaves it and t_i how far a touch has reduced it,

    t_i = 1 - a_i / A_i                       0 untouched .. 1 stopped at the start angle
    s_i = a_i / A_i
    S_r = sum_{i in r} t_i s_i / sum t_i      where the row's touching whiskers stand
    p_r = min(1, spread sum_{i in r} t_i)     how strongly the others follow them
    amplitude_i = A_i (s_i + (1 - t_i) p_r (S_r - s_i))
                + reserve_i min(1, contralateral max_{i in opposite r} t_i) (1 - t_i)

`reserve` is travel that the whisk itself leaves unused. Without touch, and with both gains at 0,
the law is RCP to the bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

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
from vibrissa.control.rcp import (
    CEILING,
    FLOOR,
    GAIN,
    MEAN,
    RCP_ROWS,
    SUM,
    THRESHOLD,
    WINDOW,
    RcpParams,
    normalised_gain,
    rcp_command,
)
from vibrissa.control.whisk_pattern import (
    AMPLITUDE,
    MINIMUM,
    PERIOD,
    SLEW,
    WhiskParams,
    desired_angle,
    protraction_at,
)
from vibrissa.messages.types import TICK_HZ
from vibrissa.numerics import compiled

# parameter rows after those of RCP
SPREAD, CONTRALATERAL, RESERVE = range(RCP_ROWS, RCP_ROWS + 3)
SOCIAL_ROWS = RCP_ROWS + 3
# state rows: the last command, amplitude and touch of every whisker; RCP's own state follows
LEFT, TOUCHED, RCP_STATE = 1, 2, 3


class SocialParameterError(ValueError):
    """Gains or a reserve out of range."""


@dataclass(frozen=True, eq=False)
class SocialParams:
    """RCP, and what the whiskers do about each other's touch.

    rcp            the whisk and how touch reduces it
    spread         >= 0, gain of spread reduction; 0: off
    contralateral  >= 0, gain of contralateral protraction; 0: off
    reserve        float64[18] rad (or one number), >= 0: how much further than the whisk's own
                   amplitude a whisker may protract

    Raises SocialParameterError.
    """

    rcp: RcpParams
    spread: float = 0.0
    contralateral: float = 0.0
    reserve: Float64s | float = 0.0

    def __post_init__(self) -> None:
        for name in ("spread", "contralateral"):
            gain = getattr(self, name)
            if not 0.0 <= gain < math.inf:
                raise SocialParameterError(f"{name}: {gain}, expected finite and >= 0")
        reserve = per_whisker(self.reserve, "reserve", SocialParameterError)
        object.__setattr__(self, "reserve", reserve)
        for i in range(WHISKERS):
            if reserve[i] < 0.0:
                raise SocialParameterError(
                    f"reserve: {whisker_name(i)} is {reserve[i]}, expected >= 0"
                )

    def rows(self) -> Float64s:
        """The law's parameters, float64[SOCIAL_ROWS, 18]."""
        rows = np.empty((SOCIAL_ROWS, WHISKERS), dtype=np.float64)
        rows[:RCP_ROWS] = self.rcp.rows()
        rows[SPREAD] = self.spread
        rows[CONTRALATERAL] = self.contralateral
        rows[RESERVE] = self.reserve
        return rows


@compiled
def social_command(
    tick: int,
    theta: Float32s,
    x: Float32s,
    y: Float32s,
    parameters: Float64s,
    state: Float64s,
    command: Float32s,
) -> None:
    """Law: the equations of the module docstring, slew limited.

    parameters: `SocialParams.rows()`; state: float64[RCP_STATE + WINDOW + window_ticks, 18].
    """
    rcp_state = state[RCP_STATE:]
    rcp_command(tick, theta, x, y, parameters, rcp_state, command)
    window = rcp_state.shape[0] - WINDOW
    whiskers = command.shape[0]
    for i in range(whiskers):
        amplitude = parameters[AMPLITUDE, i] - parameters[GAIN, i] * (rcp_state[SUM, i] / window)
        amplitude = min(max(amplitude, parameters[FLOOR, i]), rcp_state[CEILING, i])
        state[LEFT, i] = amplitude
        full = parameters[AMPLITUDE, i]
        state[TOUCHED, i] = 1.0 - amplitude / full if amplitude < full else 0.0
    share = protraction_at(tick, int(parameters[PERIOD, 0]))
    rows = whiskers // len(RINGS)
    for i in range(whiskers):
        row = i % PER_RING
        opposite = (row + rows // 2) % rows
        touch, standing, across = 0.0, 0.0, 0.0
        for ring in range(len(RINGS)):
            j = ring * PER_RING + row
            t = state[TOUCHED, j]
            if t > 0.0:
                touch += t
                standing += t * (state[LEFT, j] / parameters[AMPLITUDE, j])
            across = max(across, state[TOUCHED, ring * PER_RING + opposite])
        amplitude = state[LEFT, i]
        free = 1.0 - state[TOUCHED, i]
        if touch > 0.0:
            follow = free * min(parameters[SPREAD, i] * touch, 1.0)
            amplitude += follow * (standing / touch * parameters[AMPLITUDE, i] - amplitude)
        reach = min(parameters[CONTRALATERAL, i] * across, 1.0)
        amplitude += free * reach * parameters[RESERVE, i]
        desired = desired_angle(parameters[MINIMUM, i], amplitude, share)
        command[i] = slewed(desired, state[LAST, i], parameters[SLEW, i])
        state[LAST, i] = command[i]


class Social(LawController):
    """RCP with spread reduction and contralateral protraction; open loop until calibrated."""

    def __init__(self, params: SocialParams) -> None:
        self.params = params
        self._calibrated = False
        rows = RCP_STATE + WINDOW + params.rcp.window_ticks
        super().__init__(social_command, params.rows(), state_rows=rows)

    @property
    def needs_calibration(self) -> bool:
        return not self._calibrated

    def calibrate(self, calibration: Calibration) -> None:
        """Take mean and threshold of y; what was felt before counts no more."""
        self.parameters[MEAN] = calibration.mean_y
        self.parameters[THRESHOLD] = calibration.threshold_y
        self.state[RCP_STATE + SUM :] = 0.0
        self._calibrated = True


def mimc(
    whisk: WhiskParams,
    gain: float = 3.0,
    window: float = 0.01,
    spread: float = 1.0,
    contralateral: float = 1.0,
    reserve: float = 0.15,
) -> Social:
    """Minimal impingement, maximal contact: RCP and both answers to other whiskers' touch.

    whisk: its amplitude is the whole travel, of which the share `reserve` is kept for contralateral
    protraction; gain: of RCP, in contact stiffnesses; window: s, RCP's averaging window.
    Raises SocialParameterError, WhiskParameterError or RcpParameterError.
    """
    if not 0.0 <= reserve < 1.0:
        raise SocialParameterError(f"reserve: {reserve}, expected at least 0 and below 1")
    kept = reserve * whisk.amplitude
    ticks = max(round(window * TICK_HZ), 1)
    rcp = RcpParams(replace(whisk, amplitude=whisk.amplitude - kept), normalised_gain(gain), ticks)
    return Social(SocialParams(rcp, spread, contralateral, kept))


def spread_reduction(
    whisk: WhiskParams, gain: float = 3.0, window: float = 0.01, spread: float = 1.0
) -> Social:
    """RCP with spread reduction alone; parameters as for `mimc`."""
    return mimc(whisk, gain, window, spread, 0.0, 0.0)


def contralateral_protraction(
    whisk: WhiskParams,
    gain: float = 3.0,
    window: float = 0.01,
    contralateral: float = 1.0,
    reserve: float = 0.15,
) -> Social:
    """RCP with contralateral protraction alone; parameters as for `mimc`."""
    return mimc(whisk, gain, window, 0.0, contralateral, reserve)
