"""Micromouse mazes: the ASCII format, of any size.

A maze of W x H cells is 2 H + 1 lines of 4 W + 1 characters, north at the top. Posts are ``+`` or
``o``, walls between posts ``---`` and ``|``; the middle of a cell may hold ``S`` (start) or ``G``
(goal). Lengths follow the classic micromouse rules: 180 mm pitch, walls 12 mm thick and 50 mm high.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

PITCH = 0.18
WALL_THICKNESS = 0.012
WALL_HEIGHT = 0.05


class MazeError(ValueError):
    """A maze text breaks the format; the message names maze, line and column (from 1)."""


@dataclass(frozen=True, eq=False)
class Maze:
    """A maze seen from above; every index counts cells from the south-west corner.

    ``horizontal[j, i]`` is the wall south of cell (i, j), ``horizontal[height]`` the north border;
    ``vertical[j, i]`` is the wall west of cell (i, j), ``vertical[:, width]`` the east border;
    ``posts[j, i]`` is the post at lattice point (i, j). Lengths in m.
    """

    name: str
    width: int
    height: int
    horizontal: NDArray[np.bool_]
    vertical: NDArray[np.bool_]
    posts: NDArray[np.bool_]
    start: tuple[int, int] | None
    goals: tuple[tuple[int, int], ...]
    pitch: float = PITCH
    wall_thickness: float = WALL_THICKNESS
    wall_height: float = WALL_HEIGHT


def parse_maze(text: str, name: str) -> Maze:
    """Read an ASCII maze; trailing blanks, trailing empty lines and CRLF line ends are tolerated.

    ``name`` labels the maze in error messages. A post may be missing (blank) where no wall ends.
    Raises MazeError.
    """
    lines = [line.rstrip(" \t") for line in text.replace("\r\n", "\n").split("\n")]
    while lines and not lines[-1]:
        lines.pop()

    def fail(line: int, column: int, expected: str, found: str) -> MazeError:
        return MazeError(
            f"maze {name}, line {line + 1}, column {column + 1}: expected {expected}, found {found}"
        )

    def at(line: int, column: int) -> str:
        return lines[line][column]

    if not lines:
        raise fail(0, 0, "a row of posts", "no text")
    length = len(lines[0])
    if length < 5 or length % 4 != 1:
        raise fail(0, length, "4 W + 1 characters with W at least 1", f"{length}")
    if len(lines) < 3 or len(lines) % 2 != 1:
        raise fail(
            len(lines) - 1, 0, "2 H + 1 lines with H at least 1", f"{len(lines)} in the whole maze"
        )
    for row, line in enumerate(lines):
        if len(line) > length:
            raise fail(row, length, f"{length} characters as in line 1", f"{len(line)}")
        if row % 2 == 0 and len(line) < length:
            raise fail(row, len(line), f"{length} characters as in line 1", f"{len(line)}")
        lines[row] = line.ljust(length)

    width, height = (length - 1) // 4, (len(lines) - 1) // 2
    horizontal = np.zeros((height + 1, width), dtype=np.bool_)
    vertical = np.zeros((height, width + 1), dtype=np.bool_)
    posts = np.zeros((height + 1, width + 1), dtype=np.bool_)
    start: tuple[int, int] | None = None
    goals: list[tuple[int, int]] = []

    for row in range(0, 2 * height + 1, 2):
        j = height - row // 2
        for i in range(width + 1):
            found = at(row, 4 * i)
            if found not in "+o ":
                raise fail(row, 4 * i, "a post, + or o", repr(found))
            posts[j, i] = found != " "
        for i in range(width):
            wall = lines[row][4 * i + 1 : 4 * i + 4]
            if wall not in ("---", "   "):
                bad = next((k for k in range(3) if wall[k] != wall[0]), 0)
                bad = bad if wall[0] in "- " else 0
                raise fail(row, 4 * i + 1 + bad, "a wall --- or three blanks", repr(wall))
            horizontal[j, i] = wall == "---"
    for row in range(1, 2 * height, 2):
        j = height - 1 - row // 2
        for i in range(width + 1):
            found = at(row, 4 * i)
            if found not in "| ":
                raise fail(row, 4 * i, "a wall | or a blank", repr(found))
            vertical[j, i] = found == "|"
        for i in range(width):
            for k in (1, 3):
                if at(row, 4 * i + k) != " ":
                    raise fail(row, 4 * i + k, "a blank", repr(at(row, 4 * i + k)))
            mark = at(row, 4 * i + 2)
            if mark not in " SG":
                raise fail(row, 4 * i + 2, "S, G or a blank", repr(mark))
            if mark == "G":
                goals.append((i, j))
            elif mark == "S":
                if start is not None:
                    raise fail(row, 4 * i + 2, "one start S", "a second")
                start = (i, j)

    ends = np.zeros_like(posts)
    ends[:, :-1] |= horizontal
    ends[:, 1:] |= horizontal
    ends[:-1, :] |= vertical
    ends[1:, :] |= vertical
    if (ends & ~posts).any():
        j, i = (int(k) for k in np.argwhere(ends & ~posts)[-1])
        raise fail(2 * (height - j), 4 * i, "a post where a wall ends, + or o", "' '")
    return Maze(name, width, height, horizontal, vertical, posts, start, tuple(sorted(goals)))


def format_maze(maze: Maze) -> str:
    """The ASCII text of ``maze``; ``parse_maze`` reads it back to an equal maze."""
    lines = []
    for row in range(2 * maze.height + 1):
        j = maze.height - (row + 1) // 2
        line = ""
        for i in range(maze.width + 1):
            if row % 2 == 0:
                line += "+" if maze.posts[j, i] else " "
                if i < maze.width:
                    line += "---" if maze.horizontal[j, i] else "   "
            else:
                line += "|" if maze.vertical[j, i] else " "
                if i < maze.width:
                    mark = "S" if maze.start == (i, j) else "G" if (i, j) in maze.goals else " "
                    line += f" {mark} "
        lines.append(line + "\n")
    return "".join(lines)


def shipped_mazes() -> tuple[str, ...]:
    """Names of the mazes that come with the package, for ``load_maze``."""
    files = resources.files("vibrissa.rig").joinpath("mazes").iterdir()
    return tuple(sorted(f.name[:-5] for f in files if f.name.endswith(".maze")))


def load_maze(source: str | Path) -> Maze:
    """The shipped maze of that name, or else the maze in that file.

    Raises MazeError for a bad text, an undecodable file or a source that is neither.
    """
    if str(source) in shipped_mazes():
        file = resources.files("vibrissa.rig").joinpath("mazes", f"{source}.maze")
        return parse_maze(file.read_text(encoding="ascii"), str(source))
    try:
        text = Path(source).read_bytes().decode("ascii")
    except OSError as error:
        raise MazeError(
            f"maze {source}: expected a file or one of {', '.join(shipped_mazes())}, "
            f"found {error.strerror}"
        ) from None
    except UnicodeDecodeError as error:
        raise MazeError(
            f"maze {source}, byte {error.start}: expected ASCII text, "
            f"found byte 0x{error.object[error.start]:02x}"
        ) from None
    return parse_maze(text, Path(source).stem)
