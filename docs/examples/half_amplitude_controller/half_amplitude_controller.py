"""Whisks with a share of the full amplitude; a whisker that feels a touch goes no further out."""

from __future__ import annotations

import math

import numpy as np

from vibrissa.control.calibration import Calibration
from vibrissa.control.controller import LAST, LawController, slewed
from vibrissa.control.kinematics import Float32s, Float64s
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

# Rows of the parameter array after the whisk's own.
SHARE, MEAN, THRESHOLD = range(WHISK_ROWS, WHISK_ROWS + 3)


@compiled
def law(
    tick: int,
    theta: Float32s,
    x: Float32s,
    y: Float32s,
    parameters: Float64s,
    state: Float64s,
    command: Float32s,
) -> None:
    """The control law: it answers one sample, and is the only thing that runs at 2 kHz.

    It sees nothing but its arguments: no clock, no file, no global, or a recorded run could not be
    run again. theta (rad), x and y (N m) are what 18 whiskers measured; whisker i = ring * 6 + k.
    What it must remember it keeps in `state`, whose row LAST holds the last command and whose other
    rows are zero when it gets the drives. What it decides it writes into `command`, rad.
    """
    share = protraction_at(tick, int(parameters[PERIOD, 0]))
    for i in range(command.shape[0]):
        amplitude = parameters[SHARE, i] * parameters[AMPLITUDE, i]
        desired = desired_angle(parameters[MINIMUM, i], amplitude, share)
        if abs(y[i] - parameters[MEAN, i]) > parameters[THRESHOLD, i]:
            desired = min(desired, state[LAST, i])
        command[i] = slewed(desired, state[LAST, i], parameters[SLEW, i])
        state[LAST, i] = command[i]


class HalfAmplitude(LawController):
    """The controller that runs and experiments know as "half_amplitude".

    whisk is the experiment's; every other argument is a parameter of the controller, which comes
    from `--param` or from [whisk.parameters]. Raises ValueError for one that is out of range.
    """

    def __init__(self, whisk: WhiskParams, share: float = 0.5) -> None:
        parameters = np.zeros((WHISK_ROWS + 3, 18))
        parameters[:WHISK_ROWS] = whisk.rows()
        parameters[THRESHOLD] = math.inf  # feels nothing until it is calibrated
        super().__init__(law, parameters, state_rows=1)
        self.set_parameter("share", share)

    @property
    def needs_calibration(self) -> bool:
        return bool(self.parameters[THRESHOLD, 0] == math.inf)

    def calibrate(self, calibration: Calibration) -> None:
        """Take from free whisking what y is without a touch, and how far noise carries it."""
        self.parameters[MEAN] = calibration.mean_y
        self.parameters[THRESHOLD] = calibration.threshold_y

    def set_parameter(self, name: str, value: object) -> None:
        """What `vibrissa set half_amplitude.share VALUE` calls. Raises ValueError."""
        if name != "share":
            raise ValueError(f"{name}: expected share, nothing else can be changed")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= 1:
            raise ValueError(f"share: found {value!r}, expected 0 to 1")
        self.parameters[SHARE] = value
