"""The simulated arm: exact where it can be, within its limits always, still when left alone."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.plant import ARM_PERIOD, ARM_SECONDS, ArmPlant, ArmPlantParams, PlantError

START = (0.09, 0.09, 0.077, 0.0)


def drive(arm: ArmPlant, setpoints, first: int = 0):
    return [arm.step((first + k) * ARM_PERIOD, s) for k, s in enumerate(setpoints)]


def test_gentle_path_is_tracked_exactly_one_period_late() -> None:
    path = []
    for k in range(2000):
        s = k * ARM_SECONDS
        turn = 0.1 * (1 - math.cos(0.5 * s))
        path.append((0.09 + 0.02 * (1 - math.cos(s)), 0.09 + 0.01 * (s - math.sin(s)), 0.077, turn))
    assert drive(ArmPlant(START), path) == path


def test_pose_between_periods_is_linear() -> None:
    arm = ArmPlant(START)
    end = arm.step(0, (0.0901, 0.09, 0.077, 0.0))
    assert arm.pose_at(0) == START and arm.pose_at(16) == end == (0.0901, 0.09, 0.077, 0.0)
    assert arm.pose_at(4)[0] == pytest.approx(0.090025, abs=1e-15)
    arm.step(16, (0.0902, 0.09, 0.077, 0.0))
    assert arm.pose_at(16) == end


def test_far_setpoint_is_reached_within_the_limits_and_without_overshoot() -> None:
    arm, goal = ArmPlant(START), (0.8, 0.3, 0.077, 3.0)
    last, speed, turn = START, 0.0, 0.0
    for k in range(600):
        pose = arm.step(k * ARM_PERIOD, goal)
        step = math.dist(pose[:3], last[:3]) / ARM_SECONDS
        spin = abs(pose[3] - last[3]) / ARM_SECONDS
        assert step <= 0.5 + 1e-9 and abs(step - speed) <= 2.0 * ARM_SECONDS + 1e-9
        assert spin <= 1.5 + 1e-9 and abs(spin - turn) <= 6.0 * ARM_SECONDS + 1e-9
        assert pose[0] <= goal[0] + 1e-12 and pose[3] <= goal[3] + 1e-12
        last, speed, turn = pose, step, spin
    assert last == goal
    assert math.dist(START[:3], goal[:3]) / 0.5 < 2.0


@given(
    st.lists(
        st.one_of(
            st.none(),
            st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 0.2), st.floats(-10, 10)),
        ),
        max_size=60,
    )
)
def test_limits_hold_for_any_setpoints(setpoints) -> None:
    arm, p = ArmPlant(START), ArmPlantParams()
    before = (0.0, 0.0, 0.0, 0.0)
    for k, setpoint in enumerate(setpoints):
        arm.step(k * ARM_PERIOD, setpoint)
        now = arm.velocity
        assert math.hypot(*now[:3]) <= p.speed * (1 + 1e-6)
        assert abs(now[3]) <= p.turn_speed * (1 + 1e-6)
        assert math.dist(now[:3], before[:3]) <= p.acceleration * ARM_SECONDS * (1 + 1e-6) + 1e-12
        assert abs(now[3] - before[3]) <= p.turn_acceleration * ARM_SECONDS * (1 + 1e-6) + 1e-12
        before = now


def test_arm_brakes_and_holds_when_setpoints_stop_coming() -> None:
    arm = ArmPlant(START)
    poses = drive(arm, [(2.0, 0.09, 0.077, 0.0)] * 100)
    assert arm.velocity[0] == pytest.approx(0.5)
    rest = drive(arm, [None] * 100, first=100)
    assert arm.velocity == (0.0, 0.0, 0.0, 0.0)
    braking = rest[-1][0] - poses[-1][0]
    assert braking == pytest.approx(0.5**2 / (2 * 2.0), rel=0.05)
    assert rest[-1] == rest[40]


def test_yaw_turns_the_short_way_and_stays_continuous() -> None:
    arm = ArmPlant((0.0, 0.0, 0.077, 3.0))
    last = drive(arm, [(0.0, 0.0, 0.077, -3.0)] * 300)[-1]
    assert last[3] == pytest.approx(2 * math.pi - 3.0)


def test_moving_setpoint_is_caught_up_with() -> None:
    arm = ArmPlant(START)
    path = [(0.3 + 0.1 * k * ARM_SECONDS, 0.09, 0.077, 0.0) for k in range(500)]
    poses = drive(arm, path)
    assert poses[-100:] == path[-100:]
    assert all(p[0] <= s[0] + 1e-9 for p, s in zip(poses, path, strict=True))


def test_bad_input_is_refused_and_changes_nothing() -> None:
    arm = ArmPlant(START)
    with pytest.raises(PlantError, match="tick 0"):
        arm.step(0, (math.nan, 0.0, 0.0, 0.0))
    with pytest.raises(PlantError, match="expected 0, found 16"):
        arm.step(16, START)
    with pytest.raises(PlantError, match="expected tick"):
        arm.pose_at(17)
    assert arm.step(0, START) == START
    with pytest.raises(PlantError, match="acceleration"):
        ArmPlantParams(acceleration=0.0)
