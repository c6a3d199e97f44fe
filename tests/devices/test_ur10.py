"""The UR10's kinematics, and where it stands beside the maze."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.devices import ur10
from vibrissa.rig.devices.limits import ARM, Follower
from vibrissa.rig.devices.rtde_robot import HOME

angle = st.floats(-3.1, 3.1)
joints = st.tuples(angle, angle, angle, angle, angle, angle)


def difference(a: ur10.Matrix, b: ur10.Matrix) -> float:
    return max(abs(x - y) for r, s in zip(a, b, strict=True) for x, y in zip(r, s, strict=True))


def test_stretched_out_it_is_where_the_data_sheet_puts_it() -> None:
    t = ur10.forward((0.0,) * 6)
    position = (t[0][3], t[1][3], t[2][3])
    assert position == pytest.approx((-1.1843, -0.256141, 0.0116), abs=1e-9)
    up = ur10.forward((0.0, -math.pi / 2, 0.0, -math.pi / 2, 0.0, 0.0))
    assert up[2][3] == pytest.approx(0.1273 + 0.612 + 0.5723 + 0.1157, abs=1e-9)


@given(joints)
def test_every_solution_leads_to_the_pose_and_one_is_where_it_came_from(q: ur10.Joints) -> None:
    t = ur10.forward(q)
    found = ur10.solutions(t, q[5])
    assert 1 <= len(found) <= 8
    for solution in found:
        assert difference(ur10.forward(solution), t) < 1e-5
    if abs(math.sin(q[4])) > 1e-3 and abs(math.sin(q[2])) > 1e-3:
        near = ur10.nearest(t, q)
        assert near is not None and near == pytest.approx(q, abs=1e-5)


@given(joints, joints)
def test_the_nearest_is_the_one_whose_joint_that_moves_most_moves_least(
    there: ur10.Joints, q: ur10.Joints
) -> None:
    def largest(solution: ur10.Joints) -> float:
        turns = zip(solution, q, strict=True)
        return max(abs(math.remainder(a - b, 2 * math.pi)) for a, b in turns)

    t = ur10.forward(there)
    near = ur10.nearest(t, q)
    found = ur10.solutions(t, q[5])
    if near is None:
        assert not found  # some poses are reached with one turn of wrist 3 only
    else:
        assert largest(near) == pytest.approx(min(map(largest, found)), abs=1e-12)


@given(joints)
def test_rotation_vectors_describe_the_same_turn(q: ur10.Joints) -> None:
    t = ur10.forward(q)
    assert difference(ur10.from_vector(ur10.to_vector(t)), t) < 1e-9


@given(
    st.floats(0.0, 1.26), st.floats(0.0, 0.9), st.floats(0.06, 0.3), st.floats(-math.pi, math.pi)
)
def test_head_poses_come_back_from_the_controllers(
    x: float, y: float, z: float, yaw: float
) -> None:
    mount = ur10.Mount(x=0.5, y=-0.3, z=0.02, yaw=0.7)
    pose, tilt = mount.head(mount.tcp((x, y, z, yaw)))
    assert pose[:3] == pytest.approx((x, y, z), abs=1e-9)
    assert math.remainder(pose[3] - yaw, 2 * math.pi) == pytest.approx(0, abs=1e-9)
    assert tilt < 1e-6
    flange = ur10.multiply(mount.base(), mount.flange((x, y, z, yaw)))
    assert flange[2][3] == pytest.approx(z + mount.tool, abs=1e-12)


def test_the_whole_ring_of_the_maze_is_in_reach() -> None:
    mount = ur10.Mount()
    q: ur10.Joints | None = HOME
    ring = [(k * 0.01, 0.09) for k in range(9, 118)] + [(1.17, k * 0.01) for k in range(9, 82)]
    for x, y in ring:
        q = ur10.nearest(mount.flange((x, y, 0.077, 0.0)), q) if q else None
        assert q is not None, (x, y)


def test_out_of_reach_there_is_no_solution() -> None:
    assert ur10.nearest(ur10.Mount().flange((0.63, 1.6, 0.077, 0.0)), HOME) is None


def test_a_path_that_winds_up_the_wrist_is_refused_before_it_begins() -> None:
    start = (0.63, 0.45, 0.15, 0.0)
    mount = ur10.Mount()
    q = ur10.nearest(mount.flange(start), HOME)
    follower = Follower(ARM, 0.008, start, mount, q)
    turns = [(*start[:3], 0.008 * max(k - 100, 0) + 4e-5 * min(k, 100) ** 2) for k in range(8000)]
    with pytest.raises(ValueError, match=r"arm path, .* s: wrist 3 joint: expected within"):
        follower.check_path(turns)
    assert follower.q == q
