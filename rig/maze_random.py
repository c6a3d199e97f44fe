"""Random mazes of any size: a free ring of outer cells around inner cells with walls at random."""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import philox_uniform
from vibrissa.rig.maze import Maze, MazeError

STREAM = 0x6D617A65  # of the random numbers, one for each wall
MOST_CELLS = 1_000_000


def random_maze(
    width: int,
    height: int,
    seed: int,
    ring_walls: float = 0.75,
    inner_walls: float = 0.6,
    connected: bool = False,
) -> Maze:
    """A maze of width x height cells; one seed, one maze, on any machine.

    The border is closed and the ring of outer cells, along which the head travels, has no walls
    across it. ring_walls and inner_walls: probability of each wall between a ring cell and an inner
    cell, and between two inner cells. connected: walls are taken away, in random order and only
    where they part two regions, until every cell can be reached from every other. Raises MazeError.
    """
    if not (width >= 1 and height >= 1 and width * height <= MOST_CELLS):
        raise MazeError(
            f"random maze size: expected 1 x 1 to {MOST_CELLS} cells, found {width} x {height}"
        )
    if not 0 <= seed < 2**63:
        raise MazeError(f"random maze seed: expected 0 to 2^63 - 1, found {seed}")
    for name, value in (("ring_walls", ring_walls), ("inner_walls", inner_walls)):
        if not 0.0 <= value <= 1.0:
            raise MazeError(f"random maze {name}: expected 0 to 1, found {value}")

    horizontal = np.zeros((height + 1, width), dtype=np.bool_)
    vertical = np.zeros((height, width + 1), dtype=np.bool_)
    horizontal[[0, -1]] = True
    vertical[:, [0, -1]] = True
    standing = []
    for j in range(height):
        for i in range(width):
            for east in (True, False):
                other = (i + 1, j) if east else (i, j + 1)
                if other[0] >= width or other[1] >= height:
                    continue
                outer = _in_ring(i, j, width, height) + _in_ring(*other, width, height)
                chance = (inner_walls, ring_walls, 0.0)[outer]
                draw = philox_uniform(seed, STREAM, 2 * (j * width + i) + east)
                if draw < chance:
                    walls, place = (vertical, (j, i + 1)) if east else (horizontal, (j + 1, i))
                    walls[place] = True
                    standing.append(
                        (draw, walls, place, j * width + i, other[1] * width + other[0])
                    )
    if connected:
        _connect(horizontal, vertical, standing)
    posts = np.ones((height + 1, width + 1), dtype=np.bool_)
    return Maze(f"random-{seed}", width, height, horizontal, vertical, posts, (0, 0), ())


def _in_ring(i: int, j: int, width: int, height: int) -> bool:
    return i in (0, width - 1) or j in (0, height - 1)


def _connect(
    horizontal: np.ndarray,
    vertical: np.ndarray,
    standing: list[tuple[float, np.ndarray, tuple[int, int], int, int]],
) -> None:
    """Open walls until one region is left: Kruskal's algorithm over regions."""
    height, width = len(vertical), len(horizontal[0])
    region = list(range(width * height))

    def root(cell: int) -> int:
        while region[cell] != cell:
            region[cell] = region[region[cell]]
            cell = region[cell]
        return cell

    for j in range(height):
        for i in range(width):
            cell = j * width + i
            if i + 1 < width and not vertical[j, i + 1]:
                region[root(cell)] = root(cell + 1)
            if j + 1 < height and not horizontal[j + 1, i]:
                region[root(cell)] = root(cell + width)
    for _draw, walls, place, a, b in sorted(standing, key=lambda wall: wall[0]):
        if root(a) != root(b):
            walls[place] = False
            region[root(a)] = root(b)
