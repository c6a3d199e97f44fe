"""The maze as boxes, with an index that finds the boxes a whisker can reach.

Skipping is exact: the index lists every box within reach of a grid cell, and the contact kernel
reduces over boxes in a way that depends neither on their order nor on boxes out of reach.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.rig.maze import Maze

INDEX_CELL = 0.03
REACH_MARGIN = 0.03  # m, so that a whisker that reaches no box has some way to go

# Columns of Scene.boxes, m.
X_MIN, X_MAX, Y_MIN, Y_MAX, TOP = range(5)
# Entries of Scene.grid.
GRID_X, GRID_Y, GRID_COLUMNS, GRID_ROWS, GRID_TOP, GRID_REACH = range(6)


class SceneError(ValueError):
    """A scene can't be built from these values."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Boxes standing on the floor, world frame, and the index over them.

    ``boxes`` float64[n, 5]: x_min, x_max, y_min, y_max, top in m. ``grid`` float64[6]: south-west
    corner of the index (m), its columns and rows, highest top (m), and the distance (m) within
    which every box is listed. Index cell c holds the boxes ``items[starts[c]:starts[c + 1]]``
    (int32); a point outside the index is farther than that distance from all boxes.
    """

    boxes: NDArray[np.float64]
    grid: NDArray[np.float64]
    starts: NDArray[np.int32]
    items: NDArray[np.int32]
    reach: float


def wall_boxes(maze: Maze) -> NDArray[np.float64]:
    """Boxes float64[n, 5] of a maze: straight runs of wall from post to post, and lone posts.

    A run is one box, so that no face lies inside a wall; runs that cross share their post.
    """
    half = maze.wall_thickness / 2
    covered = np.zeros_like(maze.posts)
    boxes: list[tuple[float, float, float, float, float]] = []

    def add(i0: int, i1: int, j0: int, j1: int) -> None:
        covered[j0 : j1 + 1, i0 : i1 + 1] = True
        boxes.append(
            (
                i0 * maze.pitch - half,
                i1 * maze.pitch + half,
                j0 * maze.pitch - half,
                j1 * maze.pitch + half,
                maze.wall_height,
            )
        )

    for j in range(maze.height + 1):
        for i0, i1 in _runs(maze.horizontal[j]):
            add(i0, i1, j, j)
    for i in range(maze.width + 1):
        for j0, j1 in _runs(maze.vertical[:, i]):
            add(i, i, j0, j1)
    for j, i in np.argwhere(maze.posts & ~covered):
        add(int(i), int(i), int(j), int(j))
    return np.array(boxes, dtype=np.float64).reshape(-1, 5)


def _runs(walls: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Maximal runs of True as (first, last + 1), i.e. as lattice points."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], walls, [False])).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def build_scene(boxes: NDArray[np.float64], reach: float) -> Scene:
    """Index ``boxes`` float64[n, 5] (m) for probes that reach ``reach`` m horizontally.

    Raises SceneError for boxes of another shape, not finite or empty, or a reach not positive.
    """
    if boxes.ndim != 2 or boxes.shape[1] != 5:
        raise SceneError(f"scene boxes: expected shape (n, 5), found {boxes.shape}")
    if not np.isfinite(boxes).all():
        raise SceneError("scene boxes: expected finite numbers, found nan or inf")
    bad = np.flatnonzero(
        (boxes[:, X_MIN] >= boxes[:, X_MAX])
        | (boxes[:, Y_MIN] >= boxes[:, Y_MAX])
        | (boxes[:, TOP] <= 0)
    )
    if bad.size:
        raise SceneError(
            f"scene box {bad[0]}: expected min < max and top > 0, found {boxes[bad[0]]}"
        )
    if not 0 < reach < 10:
        raise SceneError(f"scene reach: expected 0 to 10 m, found {reach}")
    boxes = np.ascontiguousarray(boxes, dtype=np.float64)
    if not len(boxes):
        return Scene(
            boxes,
            np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1e3]),
            np.zeros(1, dtype=np.int32),
            np.zeros(0, dtype=np.int32),
            reach,
        )
    margin = reach + REACH_MARGIN
    x0, y0 = boxes[:, X_MIN].min() - margin, boxes[:, Y_MIN].min() - margin
    columns = int(np.ceil((boxes[:, X_MAX].max() + margin - x0) / INDEX_CELL))
    rows = int(np.ceil((boxes[:, Y_MAX].max() + margin - y0) / INDEX_CELL))
    if columns * rows > 4_000_000:
        raise SceneError(f"scene: expected at most 4000000 index cells, found {columns} x {rows}")
    west = x0 + INDEX_CELL * np.arange(columns)
    south = y0 + INDEX_CELL * np.arange(rows)
    lists: list[list[int]] = [[] for _ in range(columns * rows)]
    for n, (x_min, x_max, y_min, y_max, _) in enumerate(boxes):
        gap_x = np.maximum(np.maximum(x_min - west - INDEX_CELL, west - x_max), 0.0)
        gap_y = np.maximum(np.maximum(y_min - south - INDEX_CELL, south - y_max), 0.0)
        near = gap_x[None, :] ** 2 + gap_y[:, None] ** 2 <= margin**2
        for cell in np.flatnonzero(near):
            lists[cell].append(n)
    starts = np.zeros(columns * rows + 1, dtype=np.int32)
    starts[1:] = np.cumsum([len(entry) for entry in lists])
    items = np.array([n for entry in lists for n in entry], dtype=np.int32)
    grid = np.array([x0, y0, columns, rows, boxes[:, TOP].max(), margin], dtype=np.float64)
    return Scene(boxes, grid, starts, items, reach)


@compiled
def index_cell(grid: NDArray[np.float64], x: float, y: float) -> int:
    """Index cell over (x, y) in m, or -1 where no box is within reach."""
    column = (x - grid[GRID_X]) / INDEX_CELL
    row = (y - grid[GRID_Y]) / INDEX_CELL
    if not (0.0 <= column < grid[GRID_COLUMNS] and 0.0 <= row < grid[GRID_ROWS]):
        return -1
    return int(row) * int(grid[GRID_COLUMNS]) + int(column)
