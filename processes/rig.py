"""The rig process: the simulated head, arm and maze; absent on real hardware."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from vibrissa.messages.codec import Message
from vibrissa.messages.types import ArmReading, HeadReading
from vibrissa.processes.arm import make_path
from vibrissa.processes.config import Experiment
from vibrissa.processes.node import Output
from vibrissa.rig.maze import parse_maze
from vibrissa.rig.plant import ARM_PERIOD, ArmPlant, HeadPlant, HeadPlantParams
from vibrissa.rig.scene import wall_boxes


def head_settings(experiment: Experiment) -> dict[str, Any]:
    """What an experiment says of the simulated head, by names of HeadPlantParams."""
    head = experiment.head
    return {
        "servo_stiffness": head.motor_stiffness,
        "servo_frequency": head.motor_frequency,
        "sensor_noise": head.moment_noise,
        "encoder_noise": head.angle_noise,
    }


def head_params(experiment: Experiment) -> HeadPlantParams:
    """The simulated head an experiment asks for."""
    return HeadPlantParams(**head_settings(experiment))


class RigNode:
    """Advances the plant by one tick per timer tick, under the newest command it was given."""

    def __init__(self, experiment: Experiment) -> None:
        boxes = wall_boxes(parse_maze(experiment.maze.text, experiment.maze.file))
        self._head = HeadPlant(boxes, experiment.run.seed, head_params(experiment))
        self._arm = ArmPlant(make_path(experiment).pose(0))
        self._command: np.ndarray[tuple[int], np.dtype[np.float32]] | None = None
        self._answers = -1
        self._setpoint: tuple[float, float, float, float] | None = None

    def step(self, message: Message) -> Iterable[Output]:
        body = message.body
        match message.topic:
            case "host.timer":
                return self._tick(body.tick)
            case "head.command":
                self._command = body.command
                self._answers = body.tick
            case "arm.setpoint":
                self._setpoint = tuple(body.pose.tolist())
        return ()

    def _tick(self, tick: int) -> Iterator[Output]:
        theta, x, y = self._head.step(tick, self._arm.pose_at(tick), self._command)
        self._command = None
        yield "rig.sample", HeadReading(tick, self._answers, theta, x, y)
        if tick % ARM_PERIOD == 0:
            if tick:
                pose = np.array(self._arm.pose_at(tick), np.float64)
                yield "rig.arm", ArmReading(tick, pose)
            self._arm.step(tick, self._setpoint)
            self._setpoint = None
