"""The wall-line compass: where tips are, how walls lie and are followed, and when it is silent."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.slam.sequence_world import drive, make_world
from vibrissa.control.kinematics import NOSE_HEIGHT, paper_head, tip_position
from vibrissa.processes.slams import head_shape
from vibrissa.slam.compass import (
    AHEAD,
    BEHIND,
    BETWEEN,
    LOST,
    UNSEEN,
    Compass,
    contact_places,
    follow,
    wall_lines,
)
from vibrissa.slam.config import ConfigError
from vibrissa.slam.interface import Odometry
from vibrissa.slam.odometer import OdometerNoise
from vibrissa.slam.sequence import SequenceSlam
from vibrissa.slam.sequence_config import BATCH, SequenceConfig
from vibrissa.slam.tactile import HIGHEST_OBSTACLE

HEAD = paper_head()
PLACES = contact_places(head_shape())
WALL = 0.092
"""m from the middle of a corridor to where tips meet its walls."""


def touching(yaw: float) -> np.ndarray:
    """Pixels uint8[3, 6] of a head facing yaw whose rear tips met the walls along x at +-WALL, and
    whose middle whiskers lie over them."""
    image = np.zeros(18, dtype=np.uint8)
    pixels = np.arange(1, 256)
    for whisker in (*AHEAD, *BEHIND):
        ahead, left = PLACES[whisker, pixels].T
        across = np.abs(ahead * math.sin(yaw) + left * math.cos(yaw))
        image[whisker] = pixels[np.argmin(np.abs(across - WALL))]
    image[list(BETWEEN)] = 130
    return image.reshape(3, 6)


def lines_of(image: np.ndarray) -> np.ndarray:
    found = np.empty(2)
    wall_lines(np.ascontiguousarray(image).ravel(), PLACES, found)
    return found


def test_a_pixel_tells_where_the_tip_was() -> None:
    for share in (0.2, 0.5, 0.9):
        theta = share * HEAD.swing
        tips = tip_position(HEAD, (0.0, 0.0, NOSE_HEIGHT, 0.0), theta)
        pixels = 1 + np.round(254.0 * np.clip(tips[:, 2] / HIGHEST_OBSTACLE, 0.0, 1.0)).astype(int)
        rear = slice(6, 18)
        found = PLACES[np.arange(18), pixels][rear]
        assert np.abs(found - tips[rear, :2]).max() < 5e-4


@pytest.mark.parametrize("yaw", [0.0, 0.04, -0.04])
def test_a_wall_lies_the_other_way_round_than_the_head_in_the_corridor(yaw: float) -> None:
    assert lines_of(touching(yaw)) == pytest.approx([-yaw, -yaw], abs=4e-3)


def test_a_line_takes_three_whiskers_of_one_side_and_one_wall() -> None:
    image = touching(0.0)
    image[:, 3:] = 0
    assert np.isnan(lines_of(image)).tolist() == [False, True]
    for whisker in (12, 14, 7):
        changed = image.copy()
        changed.ravel()[whisker] = 0
        assert np.isnan(lines_of(changed)).all()
    short = image.copy()
    short.ravel()[7] = 1  # its tip at the floor, 11 mm before the line
    short.ravel()[[12, 14]] = 200
    assert PLACES[12, 200, 1] - PLACES[7, 1, 1] > 0.008
    assert np.isnan(lines_of(short)).all()


def followed(
    sigma: float, headings: np.ndarray, turns: np.ndarray, shown: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Headings after every step by the compass, and whether a known wall was touched."""
    heading, walls = np.zeros(3), np.zeros((2, 2))
    walls[:, 1] = LOST
    said, known = [], []
    for true, turn, visible in zip(headings, turns, shown, strict=True):
        line = -true
        lines = np.array([line, np.nan]) if visible else np.full(2, np.nan)
        known.append(follow(heading, walls, lines, turn, sigma, 0.01))
        said.append(heading[0])
    return np.array(said), np.array(known)


def test_along_a_wall_the_heading_does_not_drift() -> None:
    rng = np.random.default_rng(5)
    true = 0.1 * np.sin(np.arange(400) / 20.0)
    turns = np.diff(true, prepend=0.0) + rng.normal(size=400) * 0.05
    said, known = followed(0.05, true, turns, np.ones(400, bool))
    assert known[1:].all() and not known[0]
    start = said[0] - true[0]  # the first line says where the wall lies, with odometry's error
    assert np.abs(said - true - start).max() < 0.1 < np.abs(np.cumsum(turns) - true).max()


def test_a_wall_is_lost_by_a_turn_and_when_it_does_not_show() -> None:
    shown = np.ones(60, bool)
    shown[20 : 20 + UNSEEN + 1] = False
    true, turns = np.zeros(60), np.zeros(60)
    turns[10] = true[10:] = 0.5
    _, known = followed(0.02, true, turns, shown)
    assert not known[10] and not known[20 : 20 + UNSEEN + 2].any()
    assert known[1:10].all() and known[13:20].all() and known[20 + UNSEEN + 2 :].all()


def test_a_line_that_can_not_be_the_wall_is_passed_over() -> None:
    heading, walls = np.zeros(3), np.zeros((2, 2))
    walls[:, 1] = LOST
    nan = math.nan
    assert not follow(heading, walls, np.array([0.0, nan]), 0.0, 0.01, 0.01)
    assert not follow(heading, walls, np.array([0.5, nan]), 0.0, 0.01, 0.01)
    assert heading[0] == 0.0
    assert follow(heading, walls, np.array([0.001, nan]), 0.0, 0.01, 0.01)


def config(**changes: object) -> SequenceConfig:
    return SequenceConfig(odometer=OdometerNoise(0.002, 0.0, 0.02, 0.0), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("lag", [BATCH, 10])
def test_off_blind_or_without_a_line_it_changes_no_byte(lag: int) -> None:
    world = make_world(1, "CCC")
    world.masks &= 0b111111  # whiskers of the front ring make no line
    plain, said = drive(world, config(lag=lag))
    slam = SequenceSlam(config(lag=lag, compass=True), head_shape())
    for k, (mask, (distance, turn)) in enumerate(zip(world.masks, world.motion, strict=True)):
        image = (((int(mask) >> np.arange(18)) & 1) * 200).astype(np.uint8).reshape(3, 6)
        step = slam.step(image, Odometry(distance, turn, 1.0))
        assert (step.x, step.y, step.heading) == tuple(said[k])
    assert slam.map().poses.tobytes() == plain.map().poses.tobytes()


@pytest.mark.parametrize("lag", [BATCH, 10])
def test_along_a_corridor_it_keeps_the_map_straight_and_the_same_run_gives_the_same_bytes(
    lag: int,
) -> None:
    rng = np.random.default_rng(2)
    turns = rng.normal(size=300) * 0.02
    ends = []
    for _ in range(2):
        slam = SequenceSlam(config(lag=lag, compass=True), head_shape())
        for turn in turns.tolist():
            slam.step(touching(0.0), Odometry(0.01, turn, 1.0))
        ends.append(slam.map().poses)
    assert ends[0].tobytes() == ends[1].tobytes()
    heading = ends[0][:, 2]
    assert np.abs(heading - heading[0]).max() < 0.05 < np.abs(np.cumsum(turns) - turns[0]).max()


def test_a_turn_that_odometry_alone_knows_comes_back_to_the_bit() -> None:
    compass = Compass(head_shape(), 0.01)
    assert compass.turned(np.zeros((3, 6), np.uint8), 0.02, 0.03) == (0.02, 0.03)
    assert compass.turned(touching(0.0), 0.02, 0.03) == (0.02, 0.03)
    turn, sigma = compass.turned(touching(0.0), 0.02, 0.03)
    assert turn < 0.01 and sigma < 0.01


def test_impossible_compasses_are_refused() -> None:
    with pytest.raises(ConfigError, match="compass: expected the shape of the head"):
        SequenceSlam(SequenceConfig(compass=True))
    with pytest.raises(ConfigError, match="compass: expected true or false, found 1"):
        SequenceConfig(compass=1)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="compass_wall: expected"):
        SequenceConfig(compass_wall=0.0)
