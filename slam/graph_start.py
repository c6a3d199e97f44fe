"""Where the pose graph's optimisation starts: headings filtered over odometry and loops as they come.

Plain odometry is not good enough: after ten laps its heading is off by more than pi, each loop would
pick its own multiple of 2 pi, and the optimum would be wound up.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled, cos, sin
from vibrissa.slam.angles import TAU

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@compiled
def start_values(
    steps: Floats, loops: Ints, facing: NDArray[np.int8], loop_heading: float
) -> tuple[Floats, Floats]:
    """Start poses float64[n, 3] (headings not wrapped) and the turns float64[m] of all loops.

    steps float64[n - 1, 4]: distance, turn and their standard deviations; loops int64[m, 2] in
    ascending order of their later node (column 0); facing int8[m]: 1 when the two face opposite
    ways. A scalar Kalman filter of the heading in the map of its own past, which counts as known.
    Without loops the poses are dead reckoning by the same operations as `reckon`.
    """
    nodes = steps.shape[0] + 1
    poses = np.zeros((nodes, 3))
    turns = np.empty(loops.shape[0])
    uncertain = 0.0
    k = 0
    for i in range(1, nodes):
        poses[i] = poses[i - 1]
        reckon(poses[i], steps[i - 1, 0], steps[i - 1, 1])
        uncertain += steps[i - 1, 3] * steps[i - 1, 3]
        heading = poses[i, 2]
        while k < loops.shape[0] and loops[k, 0] == i:
            half = math.pi if facing[k] else 0.0
            past = poses[loops[k, 1], 2] + half
            turns[k] = half + TAU * math.floor((heading - past) / TAU + 0.5)
            gain = uncertain / (uncertain + loop_heading * loop_heading)
            heading += gain * (poses[loops[k, 1], 2] + turns[k] - heading)
            uncertain *= 1.0 - gain
            k += 1
        if heading != poses[i, 2]:
            poses[i] = poses[i - 1]
            reckon(poses[i], steps[i - 1, 0], heading - poses[i - 1, 2])
    return poses, turns


@compiled
def reckon(pose: Floats, distance: float, turn: float) -> None:
    """Move a pose float64[3] in place: turn first, then go the distance."""
    pose[2] += turn
    pose[0] += distance * cos(pose[2])
    pose[1] += distance * sin(pose[2])
