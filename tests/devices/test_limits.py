"""The limits of head and arm: what passes is within them, what does not says which and by much."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.devices.errors import DeviceLimit
from vibrissa.rig.devices.limits import ARM, HEAD, Follower, HeadLimits, Pose
from vibrissa.rig.plant import WATCHDOG_TICKS

START: Pose = (0.63, 0.09, 0.177, 0.0)
PERIOD = 0.008


def ramp(count: int, axis: int, speed: float, acceleration: float) -> list[Pose]:
    """Poses along an axis that speed up gently."""
    poses, pose, v = [], list(START), 0.0
    for _ in range(count):
        v = min(v + acceleration * PERIOD, speed)
        pose[axis] += v * PERIOD
        poses.append((pose[0], pose[1], pose[2], pose[3]))
    return poses


def test_a_gentle_path_passes() -> None:
    Follower(ARM, PERIOD, START).check_path([START, *ramp(200, 0, 0.25, 1.0)])
    Follower(ARM, PERIOD, START).check_path([START, *ramp(200, 3, 1.0, 4.0)])


@pytest.mark.parametrize(
    ("path", "complaint"),
    [
        ([START, *ramp(400, 0, 0.6, 1.0)], r"speed: expected at most 0.5 m/s, found 0.5"),
        ([START, *ramp(50, 0, 0.4, 3.0)], r"acceleration: expected at most 2.0 m/s\^2, found 3"),
        ([START, *ramp(400, 3, 2.0, 4.0)], r"turn speed: expected at most 1.5 rad/s"),
        ([START, *ramp(50, 3, 1.4, 9.0)], r"turn acceleration: expected at most 6.0"),
        ([START, *ramp(2000, 0, 0.4, 1.0)], r"x: expected -0.05 to 1.31 m \(workspace\)"),
        ([(0.7, 0.09, 0.177, 0.0)], r"first set-point within 0.02 m and rad of the arm"),
        ([START, (0.63, math.nan, 0.177, 0.0)], r"expected finite x, y, z, yaw"),
    ],
)
def test_a_path_beyond_a_limit_is_refused_by_name(path: list[Pose], complaint: str) -> None:
    with pytest.raises(DeviceLimit, match=complaint) as caught:
        Follower(ARM, PERIOD, START).check_path(path)
    assert "\n" not in str(caught.value) and "arm path, " in str(caught.value)


def test_a_drive_at_its_bound_is_inside_whatever_the_sign_of_zero() -> None:
    limits = HeadLimits(low=np.zeros(18, np.float32))
    limits.check(1, np.full(18, -0.0, np.float32))
    with pytest.raises(DeviceLimit, match="found nan"):
        limits.check(1, np.array([*np.zeros(17), np.nan], np.float32))


@given(st.lists(st.integers(4, 160), min_size=3, max_size=12), st.sampled_from([1.9, 2.1]))
def test_acceleration_is_judged_alike_however_unevenly_set_points_come(
    ticks: list[int], acceleration: float
) -> None:
    follower = Follower(ARM, PERIOD, START)
    follower.follow("set-point", START)
    at = 0.0
    passed = True
    for number in ticks:
        seconds = number / 2000
        at += seconds
        x = START[0] + 0.5 * acceleration * at * at
        if acceleration * at > ARM.speed:
            return
        try:
            follower.follow("set-point", (x, *START[1:]), seconds)
        except DeviceLimit as error:
            assert " acceleration: expected at most 2.0" in str(error)
            passed = False
            break
    assert passed == (acceleration < ARM.acceleration)


coordinate = st.floats(-0.5, 1.5) | st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(st.tuples(coordinate, coordinate, coordinate, coordinate), max_size=30))
def test_whatever_passes_is_within_speed_and_workspace(setpoints: list[Pose]) -> None:
    follower = Follower(ARM, PERIOD, START)
    last, first = START, True
    for pose in setpoints:
        try:
            follower.follow("set-point", pose)
        except DeviceLimit:
            assert follower.pose == last
            continue
        moved = math.dist(pose[:3], last[:3])
        assert moved <= (ARM.start_jump if first else ARM.speed * PERIOD) + 1e-8
        assert all(a <= v <= b for a, v, b in zip(ARM.lower, pose, ARM.upper, strict=False))
        last, first = pose, False


def test_the_firmwares_watchdog_and_the_loops_patience_agree() -> None:
    assert HEAD.watchdog_ticks == WATCHDOG_TICKS
    assert ARM.stale_setpoint_ticks / 2000 < 1.0 / ARM.watchdog  # ours is first
