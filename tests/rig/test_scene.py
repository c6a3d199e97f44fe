"""Scenes: the boxes cover the maze's walls, and the index misses none within reach."""

import numpy as np
import pytest

from vibrissa.rig.maze import PITCH, load_maze, parse_maze
from vibrissa.rig.scene import SceneError, build_scene, index_cell, wall_boxes


def covered(boxes: np.ndarray, x: float, y: float) -> bool:
    inside = (boxes[:, 0] < x) & (x < boxes[:, 1]) & (boxes[:, 2] < y) & (y < boxes[:, 3])
    return bool(inside.any())


def test_boxes_stand_where_the_maze_has_walls_and_posts_and_nowhere_else() -> None:
    maze = load_maze("board7x5")
    boxes = wall_boxes(maze)
    for j in range(maze.height + 1):
        for i in range(maze.width + 1):
            x, y = i * PITCH, j * PITCH
            assert covered(boxes, x + 0.005, y - 0.005)
            if i < maze.width:
                assert covered(boxes, x + PITCH / 2, y) == maze.horizontal[j, i]
            if j < maze.height:
                assert covered(boxes, x, y + PITCH / 2) == maze.vertical[j, i]
            assert not covered(boxes, x + PITCH / 2, y + PITCH / 2)
    assert boxes[:, 0].min() == -0.006
    assert boxes[:, 1].max() == pytest.approx(7 * 0.18 + 0.006)
    assert (boxes[:, 4] == 0.05).all()


def test_lone_post_is_a_box_and_a_missing_post_is_none() -> None:
    text = "+---+---+\n|       |\n+   +   +\n|       |\n+---+---+\n"
    assert covered(wall_boxes(parse_maze(text, "post")), PITCH, PITCH)
    bare = text.replace("+   +   +", "+       +")
    assert not covered(wall_boxes(parse_maze(bare, "bare")), PITCH, PITCH)


def test_index_names_every_box_within_reach() -> None:
    reach = 0.16
    scene = build_scene(wall_boxes(load_maze("16MM2019CX")), reach)
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(-0.4, 16 * PITCH + 0.4, (4000, 2)):
        gap_x = np.maximum(np.maximum(scene.boxes[:, 0] - x, x - scene.boxes[:, 1]), 0)
        gap_y = np.maximum(np.maximum(scene.boxes[:, 2] - y, y - scene.boxes[:, 3]), 0)
        near = set(np.flatnonzero(np.hypot(gap_x, gap_y) <= reach))
        cell = index_cell(scene.grid, x, y)
        found = (
            set(scene.items[scene.starts[cell] : scene.starts[cell + 1]]) if cell >= 0 else set()
        )
        assert near <= found


@pytest.mark.parametrize(
    "boxes",
    [
        np.zeros((3, 4)),
        np.array([[0.0, 0.0, 0.0, 1.0, 0.05]]),
        np.array([[0.0, 1.0, 0.0, 1.0, 0.0]]),
        np.array([[0.0, 1.0, 0.0, np.nan, 0.05]]),
        np.array([[0.0, 1e4, 0.0, 1e4, 0.05]]),
    ],
)
def test_impossible_boxes_are_refused(boxes: np.ndarray) -> None:
    with pytest.raises(SceneError):
        build_scene(boxes, 0.16)


def test_empty_scene_has_no_cell() -> None:
    scene = build_scene(np.zeros((0, 5)), 0.16)
    assert index_cell(scene.grid, 0.0, 0.0) == -1
