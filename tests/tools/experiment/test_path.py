"""The path of an experiment: what may differ from run to run, and what may not."""

from __future__ import annotations

import numpy as np

from vibrissa.rig.maze import load_maze
from vibrissa.tools.experiment.path import CircuitPath, PathParams

MAZE = load_maze("board7x5")
STEP = 8_000_000


def path(sequence: str = "CCA", wander: float = 0.002, seed: int = 3) -> CircuitPath:
    return CircuitPath(MAZE, PathParams(sequence, 0.1, wander), seed)


def test_the_same_seed_gives_the_same_path_and_another_seed_another() -> None:
    t = np.arange(0, path().duration_ns, STEP)
    np.testing.assert_array_equal(path().poses(t), path().poses(t))
    assert np.abs(path().poses(t) - path(seed=4).poses(t)).max() > 1e-3


def test_earlier_circuits_do_not_change_with_what_follows_them() -> None:
    one, other = path("CCA"), path("CCCC")
    np.testing.assert_array_equal(one.ends_ns[:2], other.ends_ns[:2])
    t = np.arange(0, one.ends_ns[1], STEP)
    np.testing.assert_array_equal(one.poses(t), other.poses(t))


def test_the_wander_is_lateral_smooth_and_of_the_size_asked_for() -> None:
    calm, wandering = path(wander=0.0), path("CCCCCC", 0.002)
    calm = path("CCCCCC", 0.0)
    t = np.arange(0, calm.duration_ns, STEP)
    offset = wandering.poses(t) - calm.poses(t)
    yaw = calm.poses(t)[:, 3]
    along = offset[:, 0] * np.cos(yaw) + offset[:, 1] * np.sin(yaw)
    across = offset[:, 1] * np.cos(yaw) - offset[:, 0] * np.sin(yaw)
    assert np.abs(along).max() < 1e-12 and (offset[:, 2:] == 0).all()
    assert 0.0012 < across.std() < 0.0028
    assert np.abs(np.diff(across)).max() < 5e-5  # m per 8 ms


def test_circuits_differ_in_speed_and_rest() -> None:
    long = path("CCCCCC")
    lengths = np.diff(long.ends_ns)
    assert len(np.unique(lengths)) == len(lengths)


def test_the_heading_wanders_as_asked_for_and_the_wrist_can_follow() -> None:
    calm = path("CCCCCC", 0.0)
    turning = CircuitPath(MAZE, PathParams("CCCCCC", 0.1, 0.0, 0.07), 3)
    t = np.arange(0, calm.duration_ns, STEP)
    offset = turning.poses(t) - calm.poses(t)
    assert (offset[:, :3] == 0).all()
    assert 0.04 < offset[:, 3].std() < 0.1
    assert np.abs(np.diff(turning.poses(t)[:, 3], 2)).max() / 0.008**2 < 6.0  # rad/s^2
