"""The compiled loop over whisk cycles gives what `simulate` gives, and plain Python gives both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vibrissa.messages.codec import decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.controllers import BUILT_IN
from vibrissa.processes.cycle import LAWS, SIGNALS, WhiskLoop, setup
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.simulate import simulate
from vibrissa.processes.views import views
from vibrissa.rig.plant import PlantError

SECONDS = 4.3
NAMES = ("theta", "x", "y", "applied", "command")


def experiment(controller: str, **arm: float) -> Experiment:
    """Fast whisking close over the walls, so that a few seconds hold touch, and a cycle cut off."""
    made = load_experiment(duration=SECONDS, controller=controller, seed=7)
    whisk = made.whisk.model_copy(update={"period": 0.4, "calibration_cycles": 2})
    moved = made.arm.model_copy(update={"lift": 0.05, "speed": 0.2, **arm})
    return made.model_copy(update={"whisk": whisk, "arm": moved})


class Plain:
    """A controller that no compiled loop knows: it hands on what another one does."""

    def __init__(self, other):
        self._other = other
        self.needs_calibration = other.needs_calibration
        self.activate = other.activate
        self.calibrate = other.calibrate

    def step(self, tick, theta, x, y):
        return self._other.step(tick, theta, x, y)


class Erring(Plain):
    """... until it asks for what no drive may get."""

    def step(self, tick, theta, x, y):
        command = super().step(tick, theta, x, y)
        return command + np.float32(tick == 6321)


def run(made: Experiment, wrap=None) -> tuple[np.ndarray, list]:
    """Signals float32[5, ticks, 18] of a run, its cycles as (tick, pose, calibrating, complete)."""
    parts = setup(made)
    if wrap is not None:
        object.__setattr__(parts, "controller", wrap(parts.controller))
    blocks, cycles = [], []
    for cycle in WhiskLoop(parts).cycles():
        blocks.append(np.stack([getattr(cycle, name) for name in NAMES]))
        pose = None if cycle.pose is None else cycle.pose.tobytes()
        cycles.append((cycle.last_tick, pose, cycle.calibrating, cycle.complete))
    return np.concatenate(blocks, axis=1), cycles


@pytest.mark.parametrize("controller", ["open_loop", "rcp", "mimc"])
def test_every_tick_has_the_bytes_of_simulate(controller: str, tmp_path: Path) -> None:
    made = experiment(controller)
    simulate(made, tmp_path / "run")
    signals = np.zeros((len(SIGNALS), made.ticks, 18), np.float32)
    poses: dict[int, bytes] = {}
    expected = []
    for record in LogReader(tmp_path / "run" / "run.mcap"):
        body = decode(frame_of(record)).body
        if record.topic == "head.sample":
            signals[:4, body.tick] = body.theta, body.x, body.y, body.command
        elif record.topic == "whisk.command":
            signals[4, body.tick] = body.command
        elif record.topic == "arm.state":
            poses[body.tick] = body.pose.tobytes()
        elif record.topic == "whisk.cycle":
            expected.append((body.last_tick, body.protraction, body.calibrating))
    found, cycles = run(made)
    cycles = [cycle for cycle in cycles if cycle[3]]
    for name, mine, theirs in zip(NAMES, found, signals, strict=True):
        assert mine.tobytes() == theirs.tobytes(), name
    assert len(cycles) == len(expected) > 5
    first = 0
    for (last, pose, calibrating, _), (tick, protraction, flag) in zip(
        cycles, expected, strict=True
    ):
        assert (last, calibrating) == (tick, bool(flag))
        assert pose == poses.get(last // 16 * 16)
        np.testing.assert_array_equal(found[4, first : last + 1].max(axis=0), protraction)
        first = last + 1
    touch = np.abs(found[1:3]).max(axis=(0, 1)) > 4e-4
    assert touch.any(), "a run without touch compares nothing"


def test_views_have_the_bytes_of_the_slam_process(tmp_path: Path) -> None:
    made = experiment("rcp")
    simulate(made, tmp_path / "run")
    seen, placed = [], []
    for record in LogReader(tmp_path / "run" / "run.mcap"):
        body = decode(frame_of(record)).body
        if record.topic == "slam.view":
            images = body.max_angle_gated, body.max_angle_ungated, body.contact_angle
            seen.append((body.cycle, np.stack(images).tobytes()))
        elif record.topic == "slam.pose":
            x, y, _, yaw = body.truth.tolist()
            placed.append((body.odometry.tolist(), (x, y, yaw)))
    found = [
        (
            (
                view.cycle,
                np.stack(
                    [
                        view.images.max_angle_gated.reshape(-1),
                        view.images.max_angle_ungated.reshape(-1),
                        view.images.contact_angle.reshape(-1),
                    ]
                ).tobytes(),
            ),
            ([view.odometry.v, view.odometry.w, view.odometry.dt], view.truth),
        )
        for view in views(WhiskLoop(setup(made)))
    ]
    assert found == list(zip(seen, placed, strict=True))
    assert len(found) > 3 and any(any(image) for _, image in seen)


def test_a_controller_in_plain_python_gives_the_same_bytes() -> None:
    made = experiment("rcp")
    compiled, cycles = run(made)
    plain, same_cycles = run(made, Plain)
    assert compiled.tobytes() == plain.tobytes()
    assert cycles == same_cycles


def test_a_command_outside_the_travel_ends_the_controllers_rule_in_that_tick() -> None:
    made = experiment("rcp")
    good, _ = run(made)
    bad, _ = run(made, Erring)
    assert good[:, :6321].tobytes() == bad[:, :6321].tobytes()
    drives = bad[3, 6322:7600]
    assert (np.diff(drives, axis=0) <= 0).all() and (drives[-1] == 0).all()


def test_another_seed_gives_other_samples() -> None:
    made = experiment("rcp")
    other = made.model_copy(update={"run": made.run.model_copy(update={"seed": 8})})
    assert run(made)[0].tobytes() != run(other)[0].tobytes()


def test_a_path_that_the_arm_cannot_follow_is_refused() -> None:
    class Leap:
        def poses(self, t_ns):
            poses = np.zeros((len(t_ns), 4))
            poses[:, 0] = 0.63 + 0.1 * (t_ns > 1_000_000_000)
            poses[:, 1:] = 0.09, 0.2, 0.0
            return poses

    parts = setup(experiment("open_loop"))
    object.__setattr__(parts, "path", Leap())
    with pytest.raises(PlantError, match="the arm can do"):
        for _ in WhiskLoop(parts).cycles():
            pass


def test_every_controller_of_an_experiment_runs_compiled() -> None:
    assert {type(setup(experiment(name)).controller) for name in BUILT_IN} == set(LAWS)
