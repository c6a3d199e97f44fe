"""Open-loop whisking: every whisker follows the whisk pattern whatever it touches."""

from __future__ import annotations

from vibrissa.control.controller import LAST, LawController, slewed
from vibrissa.control.kinematics import Float32s, Float64s
from vibrissa.control.whisk_pattern import (
    AMPLITUDE,
    MINIMUM,
    PERIOD,
    SLEW,
    WhiskParams,
    desired_angle,
    protraction_at,
)
from vibrissa.numerics import compiled


@compiled
def open_loop_command(
    tick: int,
    theta: Float32s,
    x: Float32s,
    y: Float32s,
    parameters: Float64s,
    state: Float64s,
    command: Float32s,
) -> None:
    """Law: command = minimum + amplitude (1 - cos(2 pi phase)) / 2, slew limited.

    parameters: `WhiskParams.rows()`; state: float64[1, 18], the last command.
    """
    share = protraction_at(tick, int(parameters[PERIOD, 0]))
    for i in range(command.shape[0]):
        desired = desired_angle(parameters[MINIMUM, i], parameters[AMPLITUDE, i], share)
        command[i] = slewed(desired, state[LAST, i], parameters[SLEW, i])
        state[LAST, i] = command[i]


@compiled
def open_loop_block(
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
        open_loop_command(first_tick + j, theta[j], x[j], y[j], parameters, state, commands[j])


class OpenLoop(LawController):
    """Open-loop whisk controller."""

    def __init__(self, whisk: WhiskParams) -> None:
        self.whisk = whisk
        super().__init__(open_loop_command, whisk.rows(), state_rows=1)
