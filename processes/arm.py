"""The arm process: executes the circuit on the arm and publishes the arm's state."""

from __future__ import annotations

import numpy as np

from vibrissa.control.arm_path import ArmLimits, ArmPath, Motion, circuit
from vibrissa.messages.codec import Message
from vibrissa.messages.types import (
    TICK_NS,
    Answer,
    ArmReading,
    ArmSetpoint,
    ArmState,
    Order,
)
from vibrissa.processes.config import Experiment
from vibrissa.processes.node import Output
from vibrissa.rig.maze import parse_maze

ARM_TICKS = 16
"""Ticks per arm cycle: 125 Hz, the UR10's CB3 controller."""
MARGIN = 0.045
"""m of board around the maze that the head may be over."""


def make_path(experiment: Experiment, sequence: str = "") -> ArmPath:
    """The timed circuits of an experiment: lowered from the height of calibration, then travelling.

    sequence: other circuits than the experiment's. Raises MazeError or ArmPathError.
    """
    maze = parse_maze(experiment.maze.text, experiment.maze.file)
    motion = Motion(
        speed=experiment.arm.speed,
        lift=experiment.arm.lift,
        unwind=experiment.arm.unwind,
    )
    route = circuit(maze.width, maze.height, sequence or experiment.arm.sequence, pitch=maze.pitch)
    corner = (maze.width * maze.pitch + MARGIN, maze.height * maze.pitch + MARGIN, 0.4)
    return ArmPath(route, motion, ArmLimits(lower=(-MARGIN, -MARGIN, 0.06), upper=corner))


class ArmNode:
    """Streams the set-point of the next arm cycle.

    The head rests, raised, until the operator has started the run and the whiskers are calibrated;
    a stop or a fault ends all motion for good.

    An order puts other circuits in the place of those that have not begun. Every circuit begins and
    ends at rest in one cell, facing where it goes next, so both paths are the same up to the end of
    the present circuit and the old one is left there: pose and velocity are handed over as they
    are. When the last circuit is done, the new ones begin at once.
    """

    def __init__(self, experiment: Experiment) -> None:
        self._experiment = experiment
        self._sequence = experiment.arm.sequence
        self._path = make_path(experiment)
        self._started = False
        self._ended = False
        self._departure: int | None = None
        self._rested_ns: int | None = None
        """Path time of the end at which the arm rests while circuits were added, until it goes."""
        self._setpoint = np.array(self._path.pose(0), np.float64)

    def step(self, message: Message) -> list[Output]:
        match message.topic:
            case "rig.arm":
                return self._cycle(message.body)
            case "run.order" if message.body.node == "arm":
                return [self._obey(message.body, message.t)]
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

    def _obey(self, order: Order, t: int) -> Output:
        try:
            text, accepted = self._swap(order, t), 1
        except ValueError as error:
            text, accepted = str(error), 0
        return "node.answer", Answer(order.request, t // TICK_NS, accepted, "arm", text[:400])

    def _swap(self, order: Order, t: int) -> str:
        """Replace the circuits that have not begun. Raises ValueError with the refusal."""
        if order.kind != "swap":
            raise ValueError(f"can't {order.kind}")
        if self._ended:
            raise ValueError("the run is ending, the arm holds")
        done = self._begun(max(t, order.at * TICK_NS))
        if done > len(self._sequence):
            done, self._rested_ns = len(self._sequence), self._path.duration_ns
        sequence = self._sequence[:done] + order.name
        path = make_path(self._experiment, sequence)
        before, self._path, self._sequence = self._sequence, path, sequence
        instead = before[done:] or "rest"
        return f"{order.name} instead of {instead} after {done} circuits"

    def _begun(self, t: int) -> int:
        """How many circuits have begun when an order of t ns takes effect, one more after the last.

        The head faces along the first one from the start, so that has always begun.
        """
        ends = self._path.circuit_ends_ns
        if self._departure is None:
            return 1
        if self._rested_ns is not None:  # more circuits were added just now
            return int(np.searchsorted(ends, self._rested_ns, "right"))
        ahead = t + 2 * ARM_TICKS * TICK_NS - self._departure
        return int(np.searchsorted(ends, ahead, "right")) + 1

    def _cycle(self, reading: ArmReading) -> list[Output]:
        following = reading.tick + ARM_TICKS
        moving = self._started and self._departure is not None
        if self._started and self._departure is not None:
            if self._rested_ns is not None:
                self._departure = following * TICK_NS - self._rested_ns
                self._rested_ns = None
            elapsed = following * TICK_NS - self._departure
            self._setpoint = np.array(self._path.pose(elapsed), np.float64)
        return [
            ("arm.state", ArmState(reading.tick, reading.pose, int(moving))),
            ("arm.setpoint", ArmSetpoint(following, self._setpoint)),
        ]
