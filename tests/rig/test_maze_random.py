"""Random mazes: one seed, one maze; a free ring; connected where asked for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.maze import Maze, MazeError, format_maze, parse_maze
from vibrissa.rig.maze_random import random_maze
from vibrissa.rig.scene import wall_boxes


def regions(maze: Maze) -> int:
    unseen = {(i, j) for i in range(maze.width) for j in range(maze.height)}
    count = 0
    while unseen:
        count += 1
        edge = [unseen.pop()]
        while edge:
            i, j = edge.pop()
            for other, wall in (
                ((i + 1, j), maze.vertical[j, i + 1]),
                ((i - 1, j), maze.vertical[j, i]),
                ((i, j + 1), maze.horizontal[j + 1, i]),
                ((i, j - 1), maze.horizontal[j, i]),
            ):
                if not wall and other in unseen:
                    unseen.remove(other)
                    edge.append(other)
    return count


sizes = st.integers(1, 12)


@given(sizes, sizes, st.integers(0, 2**63 - 1), st.floats(0, 1), st.floats(0, 1), st.booleans())
def test_any_random_maze_has_a_border_a_free_ring_and_a_text(w, h, seed, ring, inner, connected):
    maze = random_maze(w, h, seed, ring, inner, connected)
    assert maze.horizontal[[0, -1]].all() and maze.vertical[:, [0, -1]].all()
    assert not maze.vertical[[0, -1], 1:-1].any() and not maze.horizontal[1:-1, [0, -1]].any()
    again = parse_maze(format_maze(maze), "again")
    assert np.array_equal(again.horizontal, maze.horizontal)
    assert np.array_equal(again.vertical, maze.vertical)
    assert len(wall_boxes(maze))
    if connected:
        assert regions(maze) == 1


def test_one_seed_gives_one_maze_and_another_seed_another() -> None:
    first, again, other = (random_maze(9, 7, seed) for seed in (4, 4, 5))
    assert format_maze(first) == format_maze(again) != format_maze(other)


def test_walls_stand_as_often_as_asked_for() -> None:
    maze = random_maze(200, 200, 1, ring_walls=0.75, inner_walls=0.4)
    inner = maze.vertical[1:-1, 2:-2]
    ring = np.concatenate([maze.vertical[1:-1, [1, -2]], maze.horizontal[[1, -2], 1:-1].T])
    assert inner.mean() == pytest.approx(0.4, abs=0.01)
    assert ring.mean() == pytest.approx(0.75, abs=0.06)


def test_closed_cells_are_opened_only_where_they_part_regions() -> None:
    closed = random_maze(8, 8, 2, 1.0, 1.0)
    opened = random_maze(8, 8, 2, 1.0, 1.0, connected=True)
    assert regions(closed) == 1 + 36 and regions(opened) == 1
    taken = (closed.vertical & ~opened.vertical).sum()
    taken += (closed.horizontal & ~opened.horizontal).sum()
    assert taken == 36
    assert not (opened.vertical & ~closed.vertical).any()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ((0, 5, 1), "size"),
        ((5000, 5000, 1), "size"),
        ((5, 5, -1), "seed"),
        ((5, 5, 1, 1.5), "ring_walls"),
        ((5, 5, 1, 0.5, float("nan")), "inner_walls"),
    ],
)
def test_impossible_mazes_are_refused(arguments, word) -> None:
    with pytest.raises(MazeError, match=word) as error:
        random_maze(*arguments)
    assert "\n" not in str(error.value)
