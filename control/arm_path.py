"""Where the arm carries the head, and when: the paper's circuits as a timed path.

A path is a list of rest-to-rest moves between poses (x, y, z, yaw). Every move has a trapezoidal
rate: it speeds up at the acceleration limit, cruises at the speed limit (or turns round half way
when too short) and slows down. Times are integer nanoseconds; a move ends on the next whole one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.kinematics import NOSE_HEIGHT, Float64s
from vibrissa.numerics import atan2, compiled

Int64s = NDArray[np.int64]
Pose = tuple[float, float, float, float]

AXES = 4  # x, y, z, yaw
NS = 1e9
DEGREE = math.pi / 180.0
MOST_WOUND = 2.5 * math.pi
"""rad, how far an unwinding path turns from its first heading."""


class ArmPathError(ValueError):
    """A path that the arm must not or cannot follow."""


@dataclass(frozen=True)
class ArmLimits:
    """What the arm may do, whatever the path asks for; the default box spans the board of the maze.

    lower, upper      m, (x, y, z) corners of the workspace of the nose
    speed             m/s, acceleration m/s^2
    yaw_rate          rad/s, yaw_acceleration rad/s^2
    """

    lower: tuple[float, float, float] = (-0.045, -0.045, 0.060)
    upper: tuple[float, float, float] = (1.305, 0.955, 0.400)
    speed: float = 0.25
    acceleration: float = 1.0
    yaw_rate: float = 60.0 * DEGREE
    yaw_acceleration: float = 240.0 * DEGREE


@dataclass(frozen=True)
class Motion:
    """How a route is travelled.

    speed             m/s along the legs, and acceleration m/s^2 of every straight move
    yaw_rate          rad/s of turns in place, and yaw_acceleration rad/s^2
    yaw_along_travel  the head faces where it goes; otherwise its first heading is kept
    unwind            turn back by whole turns, in place, before a circuit that would wind the yaw
                      further than MOST_WOUND from the first heading: for a wrist that has ends
    working_height    m, nose plane above the floor while travelling
    lift              m, the head starts this much higher
    lowering_speed    m/s
    t_start           s, how long the head is held up there (whisking is calibrated) before it is
                      lowered and travels
    """

    speed: float = 0.04
    acceleration: float = 0.2
    yaw_rate: float = 30.0 * DEGREE
    yaw_acceleration: float = 120.0 * DEGREE
    yaw_along_travel: bool = True
    unwind: bool = False
    working_height: float = NOSE_HEIGHT
    lift: float = 0.1
    lowering_speed: float = 0.05
    t_start: float = 0.0


@dataclass(frozen=True, eq=False)
class Route:
    """Way-points joined by straight legs; the head rests at each.

    points        float64[n, 2], m; neighbours differ
    circuit_ends  int64[k], index of the point at which circuit 0, 1, .. is complete; the last of
                  them is the last point

    Raises ArmPathError.
    """

    points: Float64s
    circuit_ends: Int64s

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 2 or len(self.points) < 2:
            raise ArmPathError(f"route: points of shape {self.points.shape}, expected (n >= 2, 2)")
        for k in range(len(self.points)):
            if not np.isfinite(self.points[k]).all():
                raise ArmPathError(f"route: point {k} is {self.points[k]}, expected finite")
            if k and (self.points[k] == self.points[k - 1]).all():
                raise ArmPathError(f"route: point {k} is point {k - 1} again, expected another")
        ends = [0, *self.circuit_ends.tolist()]
        if ends[-1] != len(self.points) - 1 or any(b <= a for a, b in pairwise(ends)):
            raise ArmPathError(
                f"route: circuit ends {ends[1:]}, expected increasing up to {len(self.points) - 1}"
            )


def circuit(
    maze_width: int, maze_height: int, sequence: str = "C", *, pitch: float = 0.18, inset: int = 0
) -> Route:
    """Circuits along the ring of cell centres `inset` cells inside the maze's edge.

    Each starts and ends in the middle of the south side. sequence: one letter per circuit, C
    clockwise and A anticlockwise seen from above, e.g. "CCCAAACACA". pitch: m.
    Raises ArmPathError.
    """
    west, east = inset, maze_width - 1 - inset
    south, north = inset, maze_height - 1 - inset
    if inset < 0 or east <= west or north <= south:
        raise ArmPathError(
            f"circuit: maze of {maze_width} x {maze_height} cells has no ring at inset {inset}"
        )
    if not 0.0 < pitch < math.inf:
        raise ArmPathError(f"circuit: pitch {pitch} m, expected finite and > 0")
    if not sequence or set(sequence) - {"C", "A"}:
        raise ArmPathError(f"circuit: sequence {sequence!r}, expected letters C and A")
    start = ((west + east) / 2, south)
    clockwise = [(west, south), (west, north), (east, north), (east, south)]
    cells: list[tuple[float, int]] = [start]
    for letter in sequence:
        cells += clockwise if letter == "C" else clockwise[::-1]
        cells.append(start)
    points = (np.array(cells, dtype=np.float64) + 0.5) * pitch
    ends = 5 * np.arange(1, len(sequence) + 1, dtype=np.int64)
    return Route(points, ends)


@compiled
def _path_at(
    t: int,
    begin: Int64s,
    origin: Float64s,
    delta: Float64s,
    ramp: Float64s,
    cruise: Float64s,
    pose: Float64s,
    rate: Float64s,
) -> None:
    """Pose and its rate at `t` ns. Move k runs from begin[k] to begin[k + 1]."""
    moves = begin.shape[0] - 1
    low, high = 0, moves - 1  # the last move that has begun, or the first
    while low < high:
        middle = (low + high + 1) // 2
        if begin[middle] <= t:
            low = middle
        else:
            high = middle - 1
    tau = (t - begin[low]) / 1e9
    up, flat = ramp[low], cruise[low]
    total = 2.0 * up + flat
    peak = 1.0 / (up + flat)
    if tau <= 0.0:
        share, speed = 0.0, 0.0
    elif tau < up:
        share, speed = peak * tau * tau / (2.0 * up), peak * tau / up
    elif tau <= up + flat:
        share, speed = peak * (tau - up / 2.0), peak
    elif tau < total:
        rest = total - tau
        share, speed = 1.0 - peak * rest * rest / (2.0 * up), peak * rest / up
    else:
        share, speed = 1.0, 0.0
    for axis in range(pose.shape[0]):
        pose[axis] = origin[low, axis] + delta[low, axis] * share
        rate[axis] = delta[low, axis] * speed


@compiled
def _path_at_many(
    times: Int64s,
    begin: Int64s,
    origin: Float64s,
    delta: Float64s,
    ramp: Float64s,
    cruise: Float64s,
    poses: Float64s,
    rates: Float64s,
) -> None:
    for j in range(times.shape[0]):
        _path_at(times[j], begin, origin, delta, ramp, cruise, poses[j], rates[j])


class ArmPath:
    """A timed path; before 0 the head rests at the first pose, after the end at the last.

    duration            s (duration_ns in ns)
    circuits_start_ns   when the head is down and the first circuit begins
    circuit_ends_ns     int64[k], when circuit 0, 1, .. is complete
    """

    duration_ns: int
    circuits_start_ns: int
    circuit_ends_ns: Int64s

    def __init__(
        self,
        route: Route,
        motion: Motion | None = None,
        limits: ArmLimits | None = None,
        *,
        speeds: Sequence[float] = (),
        pauses: Sequence[float] = (),
    ) -> None:
        """Time the travel of `route`.

        speeds: m/s, one per circuit in place of motion.speed; pauses: s, one per circuit, a rest at
        its end. Both let the phase of whisking differ from circuit to circuit. A reversal turns the
        way that unwinds the yaw, which is not wrapped. Raises ArmPathError.
        """
        motion = motion or Motion()
        limits = limits or ArmLimits()
        circuits = len(route.circuit_ends)
        leg_speeds = list(speeds) or [motion.speed] * circuits
        rests = list(pauses) or [0.0] * circuits
        _check_motion(motion, limits)
        _check_per_circuit("speeds", leg_speeds, circuits)
        _check_per_circuit("pauses", rests, circuits)
        for number, speed in enumerate(leg_speeds):
            _check_rate(f"speed of circuit {number}", speed, limits.speed)
        for number, rest in enumerate(rests):
            if not 0.0 <= rest < math.inf:
                raise ArmPathError(f"path: pause {number} is {rest} s, expected finite and >= 0")
        _check_workspace(route.points, motion, limits)

        x, y = route.points[0]
        height = motion.working_height
        first = heading = _heading(route.points[0], route.points[1])
        moves = _Moves((x, y, height + motion.lift, heading))
        moves.hold(motion.t_start)
        down = (x, y, height, heading)
        moves.go(down, motion.lift, motion.lowering_speed, motion.acceleration)
        self.circuits_start_ns = moves.now
        ends: list[int] = []
        for k in range(1, len(route.points)):
            number = len(ends)
            begins = k == 1 or k - 1 == route.circuit_ends[number - 1]
            if motion.yaw_along_travel and motion.unwind and begins:
                wound = heading - first
                after = wound + _net_turn(
                    heading, route.points[k - 1 : route.circuit_ends[number] + 1]
                )
                back = _unwinding(wound, after)
                heading += back
                facing = (x, y, height, heading)
                moves.go(facing, abs(back), motion.yaw_rate, motion.yaw_acceleration)
            if motion.yaw_along_travel:
                turn = _turn(heading, _heading(route.points[k - 1], route.points[k]))
                heading += turn
                facing = (x, y, height, heading)
                moves.go(facing, abs(turn), motion.yaw_rate, motion.yaw_acceleration)
            distance = _distance(route.points[k - 1], route.points[k])
            x, y = route.points[k]
            moves.go((x, y, height, heading), distance, leg_speeds[number], motion.acceleration)
            if k == route.circuit_ends[number]:
                ends.append(moves.now)
                moves.hold(rests[number])
        self.circuit_ends_ns = np.array(ends, dtype=np.int64)
        self.duration_ns = moves.now
        self._arrays = moves.arrays()

    @property
    def duration(self) -> float:
        """Length of the path, s."""
        return self.duration_ns / NS

    def pose(self, t_ns: int) -> Pose:
        """(x, y, z, yaw) at t_ns ns, m and rad."""
        x, y, z, yaw = self._at(t_ns)[0]
        return float(x), float(y), float(z), float(yaw)

    def velocity(self, t_ns: int) -> Pose:
        """(vx, vy, vz, yaw rate) at t_ns ns, m/s and rad/s."""
        vx, vy, vz, yaw_rate = self._at(t_ns)[1]
        return float(vx), float(vy), float(vz), float(yaw_rate)

    def poses(self, t_ns: Int64s) -> Float64s:
        """Poses at many times int64[n] ns, float64[n, 4]: the bits of `pose`."""
        return self._at_many(t_ns)[0]

    def velocities(self, t_ns: Int64s) -> Float64s:
        """Velocities at many times int64[n] ns, float64[n, 4]: the bits of `velocity`."""
        return self._at_many(t_ns)[1]

    def _at(self, t_ns: int) -> tuple[Float64s, Float64s]:
        pose, rate = np.empty((2, AXES), dtype=np.float64)
        _path_at(int(t_ns), *self._arrays, pose, rate)
        return pose, rate

    def _at_many(self, t_ns: Int64s) -> tuple[Float64s, Float64s]:
        times = np.array(t_ns, dtype=np.int64)
        poses, rates = np.empty((2, len(times), AXES), dtype=np.float64)
        _path_at_many(times, *self._arrays, poses, rates)
        return poses, rates


@dataclass
class _Moves:
    """The moves of a path under construction."""

    pose: Pose
    now: int = 0
    begin: list[int] = field(default_factory=list)
    origin: list[list[float]] = field(default_factory=list)
    delta: list[list[float]] = field(default_factory=list)
    ramp: list[float] = field(default_factory=list)
    cruise: list[float] = field(default_factory=list)

    def go(self, target: Pose, distance: float, speed: float, acceleration: float) -> None:
        """From rest to rest at `target`, which is `distance` (m or rad) away."""
        if distance == 0.0:
            return
        ramp = speed / acceleration
        cruise = distance / speed - ramp
        if cruise < 0.0:
            ramp, cruise = math.sqrt(distance / acceleration), 0.0
        self._add(target, ramp, cruise)

    def hold(self, seconds: float) -> None:
        if seconds > 0.0:
            self._add(self.pose, seconds / 2.0, 0.0)

    def _add(self, target: Pose, ramp: float, cruise: float) -> None:
        self.begin.append(self.now)
        self.origin.append(list(self.pose))
        self.delta.append([b - a for a, b in zip(self.pose, target, strict=True)])
        self.ramp.append(ramp)
        self.cruise.append(cruise)
        self.now += math.ceil((2.0 * ramp + cruise) * NS)
        self.pose = target

    def arrays(self) -> tuple[Int64s, Float64s, Float64s, Float64s, Float64s]:
        return (
            np.array([*self.begin, self.now], dtype=np.int64),
            np.array(self.origin, dtype=np.float64),
            np.array(self.delta, dtype=np.float64),
            np.array(self.ramp, dtype=np.float64),
            np.array(self.cruise, dtype=np.float64),
        )


def _heading(start: Float64s, end: Float64s) -> float:
    return atan2(end[1] - start[1], end[0] - start[0])


def _distance(start: Float64s, end: Float64s) -> float:
    dx, dy = end[0] - start[0], end[1] - start[1]
    return math.sqrt(dx * dx + dy * dy)


def _turn(yaw: float, heading: float) -> float:
    """Shortest turn from yaw to heading; half turns go the way that unwinds the yaw."""
    turn = math.remainder(heading - yaw, 2.0 * math.pi)
    if math.pi - abs(turn) < 1e-9:
        return math.pi if yaw <= 0.0 else -math.pi
    return 0.0 if abs(turn) < 1e-9 else turn


def _net_turn(yaw: float, points: Float64s) -> float:
    """How far the head turns along points float64[n, 2], from yaw, rad."""
    end = yaw
    for k in range(1, len(points)):
        end += _turn(end, _heading(points[k - 1], points[k]))
    return end - yaw


def _unwinding(before: float, after: float) -> float:
    """The fewest whole turns, rad, that bring a yaw from `before` to `after` within MOST_WOUND."""
    beyond = max(abs(before), abs(after)) - MOST_WOUND
    turns = math.ceil(beyond / (2.0 * math.pi)) if beyond > 0.0 else 0
    return -math.copysign(2.0 * math.pi * turns, before + after)


def _check_motion(motion: Motion, limits: ArmLimits) -> None:
    for limit in fields(limits):
        if limit.name not in ("lower", "upper"):
            _check_rate(f"limit of {limit.name}", getattr(limits, limit.name), math.inf)
            _check_rate(limit.name, getattr(motion, limit.name), getattr(limits, limit.name))
    _check_rate("lowering_speed", motion.lowering_speed, limits.speed)
    for name in ("lift", "t_start"):
        value = getattr(motion, name)
        if not 0.0 <= value < math.inf:
            raise ArmPathError(f"path: {name} is {value}, expected finite and >= 0")


def _check_rate(name: str, value: float, limit: float) -> None:
    if not (0.0 < value <= limit and value < math.inf):
        raise ArmPathError(f"path: {name} is {value}, expected > 0 and at most {limit}")


def _check_per_circuit(name: str, values: Sequence[float], circuits: int) -> None:
    if len(values) != circuits:
        raise ArmPathError(f"path: {len(values)} {name}, expected one per circuit, {circuits}")


def _check_workspace(points: Float64s, motion: Motion, limits: ArmLimits) -> None:
    heights = (motion.working_height, motion.working_height + motion.lift)
    corners = [(float(x), float(y), z) for x, y in points for z in heights]
    for corner in corners:
        for axis, value, low, high in zip("xyz", corner, limits.lower, limits.upper, strict=True):
            if not low <= value <= high:
                raise ArmPathError(
                    f"path: {axis} = {value:.4g} m leaves the workspace [{low}, {high}] m"
                )
