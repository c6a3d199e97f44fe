"""The whisk node answers every sample, calibrates in the air, and says so when it can't."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.processes.bench import ZEROS, Bench, of
from vibrissa.control.kinematics import paper_head
from vibrissa.messages.types import HeadSample, Ownership
from vibrissa.processes.config import Experiment
from vibrissa.processes.whisk import WhiskNode
from vibrissa.rig.devices.limits import HEAD

NOISE = 1e-5


class Head(Bench):
    """The whisk node with a head that obeys it and feels noise."""

    def __init__(self, experiment: Experiment, seed: int = 1) -> None:
        super().__init__(WhiskNode(experiment))
        self.noise = np.random.Generator(np.random.Philox(seed))
        self.held = ZEROS.copy()
        self.tick = -1
        self.outputs: list[tuple[str, Any]] = []
        self.hear("head.owner", "sampler", 0, Ownership(0, "whisk", 0))

    def run(
        self, ticks: int, touch: float = 0.0, obey: bool = True, age: int = 1
    ) -> list[tuple[str, Any]]:
        """Outputs of some ticks; `touch` is added to the moment of whisker 4, `age` is how many
        ticks ago the command was given that the drives obey."""
        outputs = []
        for _ in range(ticks):
            self.tick += 1
            x, y = self.noise.normal(0, NOISE, (2, 18)).astype(np.float32)
            y[4] += np.float32(touch)
            sample = HeadSample(self.tick, self.tick - age, self.held, x, y, self.held)
            said = self.hear("head.sample", "sampler", self.tick, sample)
            (command,) = of(said, "whisk.command")
            assert command.tick == self.tick and said[0][0] == "whisk.command"
            self.held = command.command if obey else np.full(18, 0.3, np.float32)
            outputs += said
        self.outputs += outputs
        return outputs


@pytest.fixture
def head(short: Experiment) -> Head:
    return Head(short)


def test_every_sample_is_answered_within_the_travel(head: Head, short: Experiment) -> None:
    commands = np.stack([c.command for c in of(head.run(2 * short.period_ticks), "whisk.command")])
    assert commands.shape == (2 * short.period_ticks, 18) and commands.dtype == np.float32
    assert (commands >= 0).all() and (commands <= paper_head().swing.astype(np.float32)).all()
    assert commands.max(axis=0).min() > 0.3, "every whisker whisks"


def test_cycles_are_whole_and_follow_each_other(head: Head, short: Experiment) -> None:
    outputs = head.run(4 * short.period_ticks)
    cycles = of(outputs, "whisk.cycle")
    assert [(c.cycle, c.first_tick, c.last_tick) for c in cycles] == [
        (i, i * short.period_ticks, (i + 1) * short.period_ticks - 1) for i in range(4)
    ]
    assert [c.calibrating for c in cycles] == [1, 0, 0, 0]
    commands = np.stack([c.command for c in of(outputs, "whisk.command")])
    for c in cycles:
        np.testing.assert_array_equal(
            c.protraction, commands[c.first_tick : c.last_tick + 1].max(axis=0)
        )


def test_calibration_comes_once_after_free_whisking(head: Head, short: Experiment) -> None:
    (calibration,) = of(head.run(3 * short.period_ticks), "whisk.calibration")
    assert calibration.samples == short.period_ticks
    assert np.abs(calibration.mean_y).max() < NOISE
    assert np.allclose(calibration.sigma_y, NOISE, rtol=0.2)
    assert np.allclose(calibration.threshold_y, 20 * calibration.sigma_y, rtol=1e-5)
    assert of(head.outputs, "node.event") == []


def test_a_touch_while_calibrating_is_a_fault_that_names_the_whisker(
    head: Head, short: Experiment
) -> None:
    head.run(short.period_ticks // 2)
    head.run(short.period_ticks // 4, touch=2e-3)
    head.run(2 * short.period_ticks)
    (fault,) = of(head.outputs, "node.event")
    assert fault.kind == "fault" and fault.node == "whisk"
    assert "whisker 4" in fault.cause and "touched" in fault.cause
    assert of(head.outputs, "whisk.calibration") == []


@pytest.mark.parametrize("what", [{"obey": False}, {"age": HEAD.watchdog_ticks}])
def test_a_cycle_in_which_the_drives_did_something_else_does_not_count_for_calibration(
    head: Head, short: Experiment, what: dict[str, Any]
) -> None:
    head.run(short.period_ticks // 2)
    head.run(50, **what)
    head.run(short.period_ticks)
    assert of(head.outputs, "whisk.calibration") == []
    outputs = head.run(short.period_ticks)
    (calibration,) = of(outputs, "whisk.calibration")
    assert calibration.samples == short.period_ticks
    assert of(head.outputs, "node.event") == []


def test_cycles_before_a_disturbed_one_count(short: Experiment) -> None:
    two = short.model_copy(
        update={"whisk": short.whisk.model_copy(update={"calibration_cycles": 2})}
    )
    head = Head(two)
    head.run(short.period_ticks + short.period_ticks // 2)
    head.run(50, obey=False)
    head.run(short.period_ticks - short.period_ticks // 2 - 50)
    assert of(head.outputs, "whisk.calibration") == []
    (calibration,) = of(head.run(short.period_ticks), "whisk.calibration")
    assert calibration.samples == 2 * short.period_ticks


def test_calibration_that_is_always_disturbed_is_given_up(short: Experiment) -> None:
    head = Head(short)
    head.run(25 * short.period_ticks, obey=False)
    (fault,) = of(head.outputs, "node.event")
    assert fault.kind == "fault" and "given up" in fault.cause


def test_touch_turns_the_whisker_back(short: Experiment) -> None:
    free, touched = Head(short), Head(short)
    calibrated = short.period_ticks
    free.run(calibrated)
    touched.run(calibrated)
    apart = free.run(calibrated // 2), touched.run(calibrated // 2, touch=3e-3)
    most = [np.stack([c.command for c in of(o, "whisk.command")]).max(axis=0) for o in apart]
    assert most[1][4] < 0.7 * most[0][4]
    np.testing.assert_array_equal(np.delete(most[1], 4), np.delete(most[0], 4))


def test_the_same_inputs_give_the_same_commands(short: Experiment) -> None:
    one, two = Head(short, 5), Head(short, 5)
    for o, t in zip(one.run(2000), two.run(2000), strict=True):
        assert o[0] == t[0]
        if o[0] == "whisk.command":
            assert o[1].command.tobytes() == t[1].command.tobytes()


def test_other_messages_change_nothing(head: Head) -> None:
    for kind in ("start", "stop", "retract"):
        assert head.decide(kind) == []
