"""The arm node moves only between start and stop, only when calibrated, and never jumps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.processes.bench import Bench, of
from vibrissa.messages.types import ArmReading, WhiskCalibration
from vibrissa.processes.arm import ARM_TICKS, ArmNode, make_path
from vibrissa.processes.config import Experiment


class Arm(Bench):
    """The arm node with an arm that is where it was told to be."""

    def __init__(self, experiment: Experiment) -> None:
        super().__init__(ArmNode(experiment))
        self.start = np.array(make_path(experiment).pose(0))
        self.pose = self.start
        self.tick = 0

    def calibrate(self) -> None:
        some = np.full(18, 1e-4, np.float32)
        body = WhiskCalibration(800, some, some, some, some, some)
        assert self.hear("whisk.calibration", "whisk", self.tick, body) == []

    def run(self, cycles: int) -> np.ndarray[Any, Any]:
        """Set-points of some arm cycles, float64[cycles, 4]."""
        told = []
        for _ in range(cycles):
            self.tick += ARM_TICKS
            said = self.hear("rig.arm", "rig", self.tick, ArmReading(self.tick, self.pose))
            (state,), (setpoint,) = of(said, "arm.state"), of(said, "arm.setpoint")
            np.testing.assert_array_equal(state.pose, self.pose)
            assert (state.tick, setpoint.tick) == (self.tick, self.tick + ARM_TICKS)
            self.pose = setpoint.pose
            self.moving = state.moving
            told.append(setpoint.pose)
        return np.stack(told)


@pytest.fixture
def arm(short: Experiment) -> Arm:
    return Arm(short)


def test_the_arm_rests_until_the_run_starts_and_the_whiskers_are_calibrated(arm: Arm) -> None:
    assert (arm.run(10) == arm.start).all() and not arm.moving
    arm.decide("start")
    assert (arm.run(10) == arm.start).all() and not arm.moving
    arm.calibrate()
    assert (arm.run(200) != arm.start).any() and arm.moving


def test_a_calibration_before_the_start_moves_nothing(arm: Arm) -> None:
    arm.calibrate()
    assert (arm.run(100) == arm.start).all() and not arm.moving


def test_set_points_never_jump_and_keep_the_speed(arm: Arm, short: Experiment) -> None:
    arm.decide("start")
    arm.calibrate()
    told = np.vstack([[arm.start], arm.run(2000)])
    step = np.linalg.norm(np.diff(told[:, :3], axis=0), axis=1) / (ARM_TICKS / 2000)
    assert step.max() <= short.arm.speed * (1 + 1e-6) and step.max() > 0.5 * short.arm.speed
    assert np.abs(np.diff(step)).max() / (ARM_TICKS / 2000) < 1.0, "m/s^2"


@pytest.mark.parametrize("topic", ["run.event", "host.event"])
@pytest.mark.parametrize("kind", ["stop", "retract"])
def test_a_stop_holds_the_arm_for_good(topic: str, kind: str, arm: Arm) -> None:
    arm.decide("start")
    arm.calibrate()
    here = arm.run(300)[-1]
    arm.decide(kind, arm.tick, topic)
    assert (arm.run(50) == here).all() and not arm.moving
    arm.decide("start")
    arm.calibrate()
    assert (arm.run(50) == here).all() and not arm.moving


def test_a_fault_of_somebody_else_does_not_stop_the_arm(arm: Arm) -> None:
    arm.decide("start")
    arm.calibrate()
    arm.run(200)
    arm.decide("note", arm.tick)
    assert len(np.unique(arm.run(50)[:, 2])) > 1 or arm.moving
