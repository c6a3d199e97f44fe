"""Mazes: every shipped file is read and written back, and a broken text is named with its place."""

from importlib import resources

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.maze import Maze, MazeError, format_maze, load_maze, parse_maze, shipped_mazes

SIZES = {
    "04_test_01": (4, 4, 1),
    "08MM2016CF_pre": (8, 8, 1),
    "09MM2019C_Cheese": (9, 9, 4),
    "16MM2017CX": (16, 16, 4),
    "16MM2019CX": (16, 16, 4),
    "16MM2019H_Kansai": (16, 16, 4),
    "32MM2019HX": (32, 32, 9),
    "32_no_wall": (32, 32, 1),
    "board7x5": (7, 5, 1),
}
SMALL = "+---+---+\n| S     |\n+   +   +\n|   | G |\n+---+---+\n"


def shipped_text(name: str) -> str:
    file = resources.files("vibrissa.rig").joinpath("mazes", f"{name}.maze")
    return file.read_text(encoding="ascii")


def same(a: Maze, b: Maze) -> bool:
    return (
        (a.width, a.height, a.start, a.goals) == (b.width, b.height, b.start, b.goals)
        and np.array_equal(a.horizontal, b.horizontal)
        and np.array_equal(a.vertical, b.vertical)
        and np.array_equal(a.posts, b.posts)
    )


def test_all_expected_mazes_are_shipped() -> None:
    assert set(shipped_mazes()) == set(SIZES)


@pytest.mark.parametrize("name", sorted(SIZES))
def test_shipped_maze_is_read_and_written_back(name: str) -> None:
    maze = load_maze(name)
    assert (maze.width, maze.height, len(maze.goals)) == SIZES[name]
    assert maze.start == (0, 0)
    assert maze.horizontal[[0, -1]].all() and maze.vertical[:, [0, -1]].all()
    assert format_maze(maze) == shipped_text(name).rstrip("\n") + "\n"


def test_indices_count_from_the_south_west() -> None:
    maze = parse_maze(SMALL, "small")
    assert maze.start == (0, 1) and maze.goals == ((1, 0),)
    assert maze.vertical.tolist() == [[True, True, True], [True, False, True]]
    assert maze.horizontal.tolist() == [[True, True], [False, False], [True, True]]


@pytest.mark.parametrize(
    "text",
    [
        SMALL.replace("\n", "\r\n"),
        SMALL + "\n\n",
        SMALL.replace("\n", "   \n"),
        SMALL.rstrip("\n"),
        SMALL.replace("+", "o"),
    ],
)
def test_line_ends_trailing_blanks_and_round_posts_are_tolerated(text: str) -> None:
    assert same(parse_maze(text, "variant"), parse_maze(SMALL, "small"))


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("", "line 1, column 1"),
        ("+--+\n", "line 1, column 5"),
        (SMALL.replace("|   | G |", "|   | X |"), "line 4, column 7"),
        (SMALL.replace("| S     |", "|S      |"), "line 2, column 2"),
        (SMALL.replace("|   | G |", "|   I G |"), "line 4, column 5"),
        (SMALL.replace("+   +   +", "+ - +   +"), "line 3, column 3"),
        (SMALL.replace("+   +   +", "+--+   +"), "line 3, column 9"),
        (SMALL.replace("+   +   +", "+   *   +"), "line 3, column 5"),
        (SMALL.replace("+   +   +", "+       +"), "line 3, column 5"),
        (SMALL.replace("|   | G |", "|   | G |  |"), "line 4, column 10"),
        (SMALL.replace("| S     |", "| S   S |"), "line 2, column 7"),
        (SMALL + "| S\n", "line 6"),
        (SMALL.replace("\n", "\r", 1), "line 1, column 20"),
    ],
)
def test_broken_maze_is_refused_with_its_place(text: str, place: str) -> None:
    with pytest.raises(MazeError) as error:
        parse_maze(text, "broken")
    message = str(error.value)
    assert f"maze broken, {place}" in message
    assert "expected" in message and "found" in message and "\n" not in message


def test_missing_and_undecodable_files_are_refused(tmp_path) -> None:
    with pytest.raises(MazeError, match="board7x5"):
        load_maze(tmp_path / "nowhere.maze")
    (tmp_path / "bad.maze").write_bytes(b"+---+\xff")
    with pytest.raises(MazeError, match="byte 5"):
        load_maze(tmp_path / "bad.maze")


@st.composite
def mazes(draw) -> Maze:
    width, height = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    bits = draw(st.integers(0, 2**200 - 1))
    walls = np.array([bits >> k & 1 for k in range(200)], dtype=np.bool_)
    horizontal = walls[: (height + 1) * width].reshape(height + 1, width)
    vertical = walls[100 : 100 + height * (width + 1)].reshape(height, width + 1)
    start = draw(st.sampled_from([None, (width - 1, 0)]))
    goals = ((0, height - 1),) if height > 1 else ()
    posts = np.ones((height + 1, width + 1), dtype=np.bool_)
    return Maze("drawn", width, height, horizontal, vertical, posts, start, goals)


@given(mazes())
def test_any_maze_survives_a_round_trip(maze: Maze) -> None:
    assert same(parse_maze(format_maze(maze), "again"), maze)


@given(st.text(alphabet="+o-| SG\n\rx", max_size=200))
def test_any_text_is_a_maze_or_a_named_error(text: str) -> None:
    try:
        maze = parse_maze(text, "any")
    except MazeError as error:
        assert "\n" not in str(error)
    else:
        assert same(parse_maze(format_maze(maze), "again"), maze)
