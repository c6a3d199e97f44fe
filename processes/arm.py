"""The arm process: executes the circuit on the arm and publishes the arm's state."""

from __future__ import annotations

import numpy as np

from vibrissa.control.arm_path import ArmLimits, ArmPath, Motion, circuit
from vibrissa.messages.codec import Message
from vibrissa.messages.types import TICK_NS, ArmReading, ArmSetpoint, ArmState
from vibrissa.processes.config import Experiment
from vibrissa.processes.node import Output
from vibrissa.rig.maze import parse_maze

ARM_TICKS = 16
"""Ticks per arm cycle: 125 Hz, the UR10's CB3 controller."""
MARGIN = 0.045
"""m of board around the maze that the head may be over."""


def make_path(experiment: Experiment) -> ArmPath:
    """The timed circuit of an experiment: lowered from the height of calibration, then travelling.

    Raises MazeError or ArmPathError.
    """
    maze = parse_maze(experiment.maze.text, experiment.maze.file)
    motion = Motion(
        speed=experiment.arm.speed,
        lift=experiment.arm.lift,
        unwind=experiment.arm.unwind,
    )
    route = circuit(maze.width, maze.height, experiment.arm.sequence, pitch=maze.pitch)
    corner = (maze.width * maze.pitch + MARGIN, maze.height * maze.pitch + MARGIN, 0.4)
    return ArmPath(route, motion, ArmLimits(lower=(-MARGIN, -MARGIN, 0.06), upper=corner))


class ArmNode:
    """Streams the set-point of the next arm cycle.

    The head rests, raised, until the operator has started the run and the whiskers are calibrated;
    a stop or a fault ends all motion for good.
    """

    def __init__(self, experiment: Experiment) -> None:
        self._path = make_path(experiment)
        self._started = False
        self._ended = False
        self._departure: int | None = None
        self._setpoint = np.array(self._path.pose(0), np.float64)

    def step(self, message: Message) -> list[Output]:
        match message.topic:
            case "rig.arm":
                return self._cycle(message.body)
            case "whisk.calibration" if self._started and self._departure is None:
                self._departure = message.t + TICK_NS
            case "run.event" if message.body.kind == "start":
                self._started = not self._ended
            case "run.event" | "rig.event" | "host.event" if message.body.kind in (
                "retract",
                "stop",
            ):
                self._started, self._ended = False, True
        return []

    def _cycle(self, reading: ArmReading) -> list[Output]:
        following = reading.tick + ARM_TICKS
        moving = self._started and self._departure is not None
        if self._started and self._departure is not None:
            elapsed = following * TICK_NS - self._departure
            self._setpoint = np.array(self._path.pose(elapsed), np.float64)
        return [
            ("arm.state", ArmState(reading.tick, reading.pose, int(moving))),
            ("arm.setpoint", ArmSetpoint(following, self._setpoint)),
        ]
