import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vibrissa.control.arm_path import ArmLimits, ArmPath, ArmPathError, Motion, Route, circuit

MS = 1_000_000  # ns
RING = 3.6  # m, the ring of a 7 x 5 maze
HUGE = ArmLimits(lower=(-100.0, -100.0, 0.0), upper=(100.0, 100.0, 10.0))


def sampled(path: ArmPath, step_ns: int = MS) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses every step_ns and the mean velocities between them, from before to after the path."""
    times = np.arange(-10 * step_ns, path.duration_ns + 10 * step_ns, step_ns, dtype=np.int64)
    poses = path.poses(times)
    return poses, np.diff(poses, axis=0) / (step_ns * 1e-9)


def length(path: ArmPath) -> float:
    poses, _ = sampled(path, 10 * MS)
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


# routes


def test_a_clockwise_circuit_goes_west_first_and_round_the_outer_cells() -> None:
    route = circuit(7, 5, "C")
    expected = [[3, 0], [0, 0], [0, 4], [6, 4], [6, 0], [3, 0]]
    assert np.allclose(route.points / 0.18 - 0.5, expected)
    assert route.circuit_ends.tolist() == [5]
    assert np.allclose(circuit(7, 5, "A").points, route.points[::-1])


def test_an_inset_ring_runs_inside() -> None:
    points = circuit(7, 5, "C", inset=1).points / 0.18 - 0.5
    assert np.allclose(points.min(axis=0), [1, 1])
    assert np.allclose(points.max(axis=0), [5, 3])


@pytest.mark.parametrize("sequence", ["C", "CCC", "AAA", "CCCAAACACA"])
def test_every_circuit_has_the_length_of_the_ring(sequence: str) -> None:
    path = ArmPath(circuit(7, 5, sequence), Motion(speed=0.2, yaw_rate=1.0))
    assert length(path) == pytest.approx(len(sequence) * RING, abs=1e-6)
    assert len(path.circuit_ends_ns) == len(sequence)
    assert path.circuit_ends_ns[-1] == path.duration_ns


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1, 5), "maze of 1 x 5 cells has no ring at inset 0"),
        ((7, 5, "CB"), "sequence 'CB', expected letters C and A"),
        ((7, 5, ""), "sequence ''"),
    ],
)
def test_impossible_circuits_are_refused(arguments: tuple[int, int], message: str) -> None:
    with pytest.raises(ArmPathError, match=message):
        circuit(*arguments)
    with pytest.raises(ArmPathError, match="pitch -1 m"):
        circuit(7, 5, pitch=-1)


@pytest.mark.parametrize(
    ("points", "ends", "message"),
    [
        ([[0.1, 0.1]], [0], r"points of shape \(1, 2\), expected"),
        ([[0.1, 0.1], [0.1, 0.1]], [1], "point 1 is point 0 again"),
        ([[0.1, 0.1], [np.nan, 0.1]], [1], "point 1 is .* expected finite"),
        ([[0.1, 0.1], [0.2, 0.1], [0.3, 0.1]], [1], r"circuit ends \[1\], expected increasing"),
        ([[0.1, 0.1], [0.2, 0.1], [0.3, 0.1]], [2, 2], r"circuit ends \[2, 2\], expected"),
        ([[0.1, 0.1], [0.2, 0.1]], [], r"circuit ends \[\], expected"),
    ],
)
def test_impossible_routes_are_refused(
    points: list[list[float]], ends: list[int], message: str
) -> None:
    with pytest.raises(ArmPathError, match=message):
        Route(np.array(points), np.array(ends, dtype=np.int64))


# timing


def test_the_duration_is_that_of_the_trapezoids() -> None:
    """v 0.04, a 0.2: each of 5 legs costs v/a more; each of 4 turns 90/30 + 30/120 s."""
    path = ArmPath(circuit(7, 5, "C"), Motion(t_start=13.0))
    down = 13.0 + 0.1 / 0.05 + 0.05 / 0.2
    assert path.circuits_start_ns * 1e-9 == pytest.approx(down, abs=1e-8)
    around = RING / 0.04 + 5 * 0.2 + 4 * (3.0 + 0.25)
    assert path.duration == pytest.approx(down + around, abs=1e-7)
    assert path.duration == path.duration_ns / 1e9


def test_the_head_is_held_up_then_lowered_then_travels() -> None:
    path = ArmPath(circuit(7, 5, "C"), Motion(t_start=2.0))
    start = (0.63, 0.09, 0.177, math.pi)
    for t in (-5 * MS, 0, 1000 * MS, 2000 * MS):
        assert path.pose(t) == pytest.approx(start, abs=1e-12)
        assert path.velocity(t) == (0.0, 0.0, 0.0, 0.0)
    assert 0.077 < path.pose(3000 * MS)[2] < 0.177
    assert path.pose(path.circuits_start_ns) == pytest.approx((0.63, 0.09, 0.077, math.pi))
    times = np.arange(path.circuits_start_ns, path.duration_ns, 100 * MS, dtype=np.int64)
    assert np.allclose(path.poses(times)[:, 2], 0.077, rtol=0, atol=1e-15)


def test_the_head_faces_where_it_goes() -> None:
    path = ArmPath(circuit(7, 5, "CAC"))
    times = np.arange(path.circuits_start_ns, path.duration_ns, 37 * MS, dtype=np.int64)
    velocity, yaw = path.velocities(times), path.poses(times)[:, 3]
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    moving = speed > 0.0
    forward = velocity[:, 0] * np.cos(yaw) + velocity[:, 1] * np.sin(yaw)
    assert moving.sum() > 0.7 * len(times)
    assert np.allclose(forward[moving], speed[moving], rtol=1e-9)
    assert (velocity[moving, 3] == 0.0).all()  # turns are in place


def test_without_yaw_along_travel_the_heading_is_kept() -> None:
    path = ArmPath(circuit(7, 5, "CA"), Motion(yaw_along_travel=False))
    assert np.ptp(sampled(path, 50 * MS)[0][:, 3]) == 0.0
    assert length(path) == pytest.approx(2 * RING, abs=1e-6)


@pytest.mark.parametrize(("sequence", "turns"), [("CCC", -3), ("AAA", 3)])
def test_circuits_turn_the_head_once_each(sequence: str, turns: int) -> None:
    path = ArmPath(circuit(7, 5, sequence))
    turned = path.pose(path.duration_ns)[3] - path.pose(0)[3]
    assert turned == pytest.approx(turns * 2 * math.pi, abs=1e-12)


def test_a_reversal_turns_by_half_a_circle_and_unwinds_the_yaw() -> None:
    path = ArmPath(circuit(7, 5, "CCCAAACACA"))
    ends = path.circuit_ends_ns.tolist()
    yaws = [path.pose(t)[3] / math.pi for t in [0, *ends]]
    assert yaws == pytest.approx([1, -1, -3, -5, -2, 0, 2, -1, 2, -1, 2], abs=1e-9)


def test_pauses_and_speeds_shape_their_own_circuit() -> None:
    route = circuit(7, 5, "CC")
    plain = ArmPath(route)
    varied = ArmPath(route, speeds=[0.04, 0.05], pauses=[0.7, 0.0])
    first, second = varied.circuit_ends_ns * 1e-9
    assert first == plain.circuit_ends_ns[0] * 1e-9
    again = RING / 0.05 + 5 * 0.25 + 4 * 3.25
    assert second - first == pytest.approx(0.7 + again, abs=1e-7)
    rest = np.arange(varied.circuit_ends_ns[0], varied.circuit_ends_ns[0] + 700 * MS, 50 * MS)
    assert not varied.velocities(rest).any()


# limits and continuity

MOTIONS = st.builds(
    Motion,
    speed=st.floats(0.01, 0.25),
    acceleration=st.floats(0.05, 1.0),
    yaw_rate=st.floats(0.2, 1.0),
    yaw_acceleration=st.floats(0.5, 4.0),
    lift=st.sampled_from([0.0, 0.02, 0.1]),
    lowering_speed=st.floats(0.02, 0.2),
    t_start=st.sampled_from([0.0, 0.3]),
    yaw_along_travel=st.booleans(),
)
ROUTES = st.builds(
    circuit,
    st.integers(2, 4),
    st.integers(2, 4),
    st.text("CA", min_size=1, max_size=3),
    pitch=st.sampled_from([0.01, 0.09, 0.18]),  # legs too short to reach full speed, too
)


@given(route=ROUTES, motion=MOTIONS)
@settings(max_examples=40, deadline=None)
def test_rates_and_accelerations_never_exceed_their_limits(route: Route, motion: Motion) -> None:
    step_ns = 5 * MS
    dt = step_ns * 1e-9
    _, rate = sampled(ArmPath(route, motion, HUGE), step_ns)
    change = np.diff(rate, axis=0) / dt
    for axes, speed, acceleration in (
        ([0, 1], motion.speed, motion.acceleration),
        ([2], motion.lowering_speed, motion.acceleration),
        ([3], motion.yaw_rate, motion.yaw_acceleration),
    ):
        assert np.sqrt((rate[:, axes] ** 2).sum(axis=1)).max() <= speed * (1 + 1e-9) + 1e-12
        found = np.sqrt((change[:, axes] ** 2).sum(axis=1)).max()
        # at a corner one leg's braking and the next one's start share a difference: never more
        # than the limit along each axis
        assert found <= acceleration * math.sqrt(len(axes)) * (1 + 1e-6) + 1e-9


@given(route=ROUTES, motion=MOTIONS)
@settings(max_examples=40, deadline=None)
def test_paths_close_and_are_continuous(route: Route, motion: Motion) -> None:
    path = ArmPath(route, motion, HUGE)
    first, last = path.pose(0), path.pose(path.duration_ns)
    assert last[:2] == pytest.approx(first[:2], abs=1e-12)
    assert first[2] - last[2] == pytest.approx(motion.lift, abs=1e-12)
    if motion.yaw_along_travel:
        laps = (last[3] - first[3]) / math.pi
        assert laps == pytest.approx(round(laps), abs=1e-9)
    for end in path.circuit_ends_ns.tolist():
        assert path.pose(end)[:2] == pytest.approx(first[:2], abs=1e-12)
        assert path.velocity(end) == pytest.approx((0.0,) * 4, abs=1e-6)
        before, after = path.pose(end - 1), path.pose(end + 1)
        assert before == pytest.approx(after, abs=1e-9)


@given(route=ROUTES, motion=MOTIONS, share=st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_velocity_is_the_derivative_of_the_pose(route: Route, motion: Motion, share: float) -> None:
    path = ArmPath(route, motion, HUGE)
    t, h = int(share * path.duration_ns), 10_000
    times = np.array([t - h, t + h], dtype=np.int64)
    found = (path.poses(times)[1] - path.poses(times)[0]) / (2e-9 * h)
    steepest = max(motion.acceleration, motion.yaw_acceleration)
    assert np.abs(found - path.velocity(t)).max() <= steepest * h * 1e-9 + 1e-9


def test_many_times_give_the_bits_of_single_times() -> None:
    path = ArmPath(circuit(4, 3, "CA"), Motion(t_start=0.5))
    times = np.arange(-100 * MS, path.duration_ns + 100 * MS, 111_111_111, dtype=np.int64)
    assert path.poses(times).tobytes() == np.array([path.pose(int(t)) for t in times]).tobytes()
    single = np.array([path.velocity(int(t)) for t in times])
    assert path.velocities(times).tobytes() == single.tobytes()


@pytest.mark.parametrize(
    ("motion", "limits", "message"),
    [
        (Motion(speed=0.3), ArmLimits(), "speed is 0.3, expected > 0 and at most 0.25"),
        (Motion(speed=-1.0), ArmLimits(), "is -1.0, expected > 0"),
        (Motion(acceleration=2.0), ArmLimits(), "acceleration is 2.0, expected > 0 and at most"),
        (Motion(yaw_rate=math.nan), ArmLimits(), "yaw_rate is nan"),
        (Motion(yaw_acceleration=9.0), ArmLimits(), "yaw_acceleration is 9.0"),
        (Motion(lowering_speed=1.0), ArmLimits(), "lowering_speed is 1.0"),
        (Motion(lift=-0.1), ArmLimits(), "lift is -0.1, expected finite and >= 0"),
        (Motion(t_start=math.inf), ArmLimits(), "t_start is inf"),
        (Motion(working_height=0.05), ArmLimits(), r"z = 0.05 m leaves the workspace \[0.06"),
        (Motion(lift=0.5), ArmLimits(), "z = 0.577 m leaves the workspace"),
        (Motion(), ArmLimits(upper=(1.0, 1.0, 0.4)), "x = 1.17 m leaves the workspace"),
        (Motion(), ArmLimits(acceleration=0.0), "limit of acceleration is 0.0"),
    ],
)
def test_what_the_arm_may_not_do_is_refused(
    motion: Motion, limits: ArmLimits, message: str
) -> None:
    with pytest.raises(ArmPathError, match=message) as refusal:
        ArmPath(circuit(7, 5), motion, limits)
    assert "\n" not in str(refusal.value)


def test_speeds_and_pauses_are_one_per_circuit() -> None:
    with pytest.raises(ArmPathError, match="1 speeds, expected one per circuit, 2"):
        ArmPath(circuit(7, 5, "CC"), speeds=[0.04])
    with pytest.raises(ArmPathError, match="3 pauses, expected one per circuit, 2"):
        ArmPath(circuit(7, 5, "CC"), pauses=[0.0, 0.0, 0.0])
    with pytest.raises(ArmPathError, match=r"pause 1 is -1.0 s"):
        ArmPath(circuit(7, 5, "CC"), pauses=[0.0, -1.0])
    with pytest.raises(ArmPathError, match=r"speed of circuit 1 is 0.0"):
        ArmPath(circuit(7, 5, "CC"), speeds=[0.04, 0.0])


@pytest.mark.parametrize("sequence", ["C", "CCC", "AAAA", "CCCAAACACA", "CACACC"])
def test_an_unwinding_path_goes_the_same_way_and_never_winds_up(sequence: str) -> None:
    route = circuit(7, 5, sequence)
    wound = ArmPath(route, Motion())
    unwound = ArmPath(route, Motion(unwind=True))
    yaw = unwound.poses(np.arange(0, unwound.duration_ns, 10**8))[:, 3]
    assert np.abs(yaw - yaw[0]).max() <= 2.5 * np.pi + 1e-9
    for path_a, path_b in ((wound, unwound), (unwound, wound)):
        there = {tuple(np.round(path_a.pose(int(t))[:2], 9)) for t in path_a.circuit_ends_ns}
        assert there == {
            tuple(np.round(path_b.pose(int(t))[:2], 9)) for t in path_b.circuit_ends_ns
        }
    if sequence == "C":
        assert unwound.duration_ns == wound.duration_ns
    for end in unwound.circuit_ends_ns[:-1].tolist():  # turning back, the head stays where it is
        turn = unwound.poses(np.arange(end, end + 10**9, 10**7))
        if np.abs(turn[:, 3] - turn[0, 3]).max() > 0.0:
            np.testing.assert_allclose(turn[:, :3], turn[:1, :3].repeat(len(turn), 0), atol=1e-12)
