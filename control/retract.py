"""The built-in fallback: bring every whisker back to its start angle at a limited speed."""

from __future__ import annotations

import math

import numpy as np

from vibrissa.control.controller import LAST, LawController, slewed
from vibrissa.control.kinematics import WHISKERS, Float32s, Float64s
from vibrissa.numerics import compiled

SPEED = 0  # parameter row: rad per tick


@compiled
def retract_command(
    tick: int,
    theta: Float32s,
    x: Float32s,
    y: Float32s,
    parameters: Float64s,
    state: Float64s,
    command: Float32s,
) -> None:
    """Law: the last command moves towards theta = 0 by at most the speed of row SPEED per tick.

    parameters: float64[1, 18], rad per tick; state: float64[1, 18], the last command.
    """
    for i in range(command.shape[0]):
        command[i] = slewed(0.0, state[LAST, i], parameters[SPEED, i])
        state[LAST, i] = command[i]


@compiled
def retract_block(
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
        retract_command(first_tick + j, theta[j], x[j], y[j], parameters, state, commands[j])


class Retract(LawController):
    """Retracts all whiskers; speed in rad per tick (default 5 rad/s). Raises ValueError."""

    def __init__(self, speed: float = 0.0025) -> None:
        if not 0.0 < speed < math.inf:
            raise ValueError(f"retract speed: {speed} rad per tick, expected finite and > 0")
        super().__init__(retract_command, np.full((1, WHISKERS), speed), state_rows=1)
