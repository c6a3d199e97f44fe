"""The path of an experiment: the arm's circuits as a rig repeats them, never quite the same.

Speed, pause and lateral wander differ from circuit to circuit. They are functions of the seed, the
circuit's number and the time within it, so that circuits keep their course when others change
direction, and every control scheme is carried along exactly the same path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.arm_path import ArmLimits, ArmPath, Motion, circuit
from vibrissa.numerics import compiled, cos, philox_normal, philox_uniform, sin
from vibrissa.processes.arm import MARGIN
from vibrissa.rig.maze import Maze

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SPEED_STREAM: Final = 2000
PAUSE_STREAM: Final = 2001
WANDER_STREAM: Final = 2100
YAW_STREAM: Final = 2200
"""Noise streams of the path; wander and yaw have one per circuit from here on."""
SPEED_SPREAD: Final = 0.02
LONGEST_PAUSE: Final = 1.0
"""s, at the end of a circuit."""
WANDER_TIME: Final = 10.0
"""Correlation time of the lateral wander, s; it has a knot every second."""
WANDER_EDGE: Final = 3.0
"""s at either end of a circuit in which the wander grows from nothing."""
NS: Final = 1e9


@dataclass(frozen=True)
class PathParams:
    """sequence: one letter per circuit, C or A; speed: m/s; wander: m, and yaw: rad, standard
    deviations of the lateral wander and of the heading's."""

    sequence: str
    speed: float
    wander: float
    yaw: float = 0.0


class CircuitPath:
    """The timed path, with `poses` as the whisk loop wants them.

    duration_ns: its length; ends_ns int64[k]: when circuit 0, 1, .. is complete.
    """

    def __init__(self, maze: Maze, params: PathParams, seed: int) -> None:
        route = circuit(maze.width, maze.height, params.sequence, pitch=maze.pitch)
        circuits = len(params.sequence)
        spread = [SPEED_SPREAD * philox_normal(seed, SPEED_STREAM, k) for k in range(circuits)]
        pauses = [LONGEST_PAUSE * philox_uniform(seed, PAUSE_STREAM, k) for k in range(circuits)]
        corner = (maze.width * maze.pitch + MARGIN, maze.height * maze.pitch + MARGIN, 0.4)
        self._path = ArmPath(
            route,
            Motion(speed=params.speed),
            ArmLimits(lower=(-MARGIN, -MARGIN, 0.06), upper=corner),
            speeds=[params.speed * (1.0 + s) for s in spread],
            pauses=pauses,
        )
        self.duration_ns = self._path.duration_ns
        self.ends_ns = self._path.circuit_ends_ns
        starts = [self._path.circuits_start_ns]
        starts += [
            int(end + math.ceil(pause * NS))
            for end, pause in zip(self.ends_ns[:-1], pauses[:-1], strict=True)
        ]
        self._starts = np.array(starts, dtype=np.int64)
        longest = int(max(self.ends_ns - self._starts) / NS) + 2
        self._knots = params.wander * np.stack(
            [_wander(seed, WANDER_STREAM + k, longest) for k in range(circuits)]
        )
        self._yaw = params.yaw * np.stack(
            [_wander(seed, YAW_STREAM + k, longest) for k in range(circuits)]
        )

    def poses(self, t_ns: Ints) -> Floats:
        """Poses float64[n, 4] (x, y, z m, yaw rad) at times int64[n], ns since departure."""
        poses = self._path.poses(t_ns)
        times = np.asarray(t_ns, dtype=np.int64)
        _displace(times, self._starts, self.ends_ns, self._knots, self._yaw, poses)
        return poses


@compiled
def _wander(seed: int, stream: int, count: int) -> Floats:
    """An Ornstein-Uhlenbeck process of unit variance at every second, float64[count]."""
    keep = 1.0 - 1.0 / WANDER_TIME
    fresh = math.sqrt(1.0 - keep * keep)
    out = np.empty(count)
    value = philox_normal(seed, stream, 0)
    for k in range(count):
        out[k] = value
        value = keep * value + fresh * philox_normal(seed, stream, k + 1)
    return out


@compiled
def _displace(
    times: Ints, starts: Ints, ends: Ints, knots: Floats, yaws: Floats, poses: Floats
) -> None:
    """Move every pose to the left of where it faces by the wander at its time, then turn it."""
    circuits = starts.shape[0]
    for j in range(times.shape[0]):
        k = 0
        while k < circuits - 1 and times[j] >= starts[k + 1]:
            k += 1
        since = (times[j] - starts[k]) / NS
        left = (ends[k] - times[j]) / NS
        if since <= 0.0 or left <= 0.0:
            continue
        edge = min(min(since, left) / WANDER_EDGE, 1.0)
        second = int(since)
        part = since - second
        offset = knots[k, second] + (knots[k, second + 1] - knots[k, second]) * part
        smooth = edge * edge * (3.0 - 2.0 * edge)
        offset *= smooth
        yaw = poses[j, 3]
        poses[j, 0] -= offset * sin(yaw)
        poses[j, 1] += offset * cos(yaw)
        eased = part * part * (3.0 - 2.0 * part)  # the wrist's rate must not jump
        turned = yaws[k, second] + (yaws[k, second + 1] - yaws[k, second]) * eased
        poses[j, 3] += smooth * turned
