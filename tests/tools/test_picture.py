"""The picture shows what the log holds, in the maze's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.messages.codec import decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes.framelog import frame_of
from vibrissa.rig.maze import parse_maze
from vibrissa.tools.picture import draw, integrate, place, walls

angle = st.floats(-3.0, 3.0)
pose = st.tuples(st.floats(-2, 2), st.floats(-2, 2), angle).map(np.array)


def test_the_drawn_path_is_the_recorded_one(simulated: Path) -> None:
    poses = [
        decode(frame_of(record)).body.pose[:2]
        for record in LogReader(simulated / "run.mcap")
        if record.topic == "arm.state"
    ]
    ax = draw(simulated / "run.mcap").axes[0]
    path = next(line for line in ax.lines if line.get_label() == "head, true path")
    np.testing.assert_array_equal(np.array(path.get_data()).T, poses)


def test_the_drawn_cycles_hold_samples_of_the_log(simulated: Path) -> None:
    figure = draw(simulated / "run.mcap")
    angles = next(ax for ax in figure.axes if ax.get_ylabel() == "protraction (deg)")
    measured = np.radians(np.asarray(angles.lines[1].get_ydata()))
    whisker = int(angles.get_title(loc="left").split()[4])
    thetas = [
        decode(frame_of(record)).body.theta[whisker]
        for record in LogReader(simulated / "run.mcap")
        if record.topic == "head.sample"
    ]
    assert len(measured) > 1000
    assert np.isin(measured.astype(np.float32), np.array(thetas, np.float32)).mean() > 0.99


def test_walls_stand_where_the_maze_has_them() -> None:
    maze = parse_maze("+---+   +\n|        \n+   +   +\n", "small")
    segments = {tuple(map(tuple, np.round(wall / maze.pitch, 9))) for wall in walls(maze)}
    assert segments == {((0, 1), (1, 1)), ((0, 0), (0, 1))}


@given(poses=st.lists(pose, min_size=1, max_size=20), there=pose)
def test_placing_keeps_shapes_and_moves_the_named_pose(
    poses: list[np.ndarray], there: np.ndarray
) -> None:
    before = np.array(poses)
    after = place(before, before[0], there)
    np.testing.assert_allclose(after[0], there, atol=1e-12)
    gaps = [np.linalg.norm(p[:, :2] - p[0, :2], axis=1) for p in (before, after)]
    np.testing.assert_allclose(*gaps, atol=1e-12)


def test_odometry_of_a_square_closes() -> None:
    quarter = [(0.1, 0.0, 1.0), (0.1, np.pi / 2, 1.0)]
    path = integrate([(0.0, 0.0, 1.0), *quarter * 4])
    np.testing.assert_allclose(path[1, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(path[-1], [0.0, 0.0, 2 * np.pi], atol=1e-12)
