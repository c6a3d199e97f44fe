"""Where the pose graph starts from: headings filtered over odometry and loops as they come.

Plain odometry is not good enough: after ten laps its heading is off by more than pi, each loop
would pick its own multiple of 2 pi, and the optimum would be wound up.
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
    poses: Floats,
    first: int,
    steps: Floats,
    loops: Ints,
    facing: NDArray[np.int8],
    loop_heading: float,
    other: NDArray[np.bool_],
    turns: Floats,
    surprise: Floats,
) -> None:
    """Fill poses float64[n, 3] after node `first` (headings not wrapped) and turns float64[m].

    poses up to `first` are given. steps float64[n - 1, 4]: distance, turn and their standard
    deviations, of the step that ends at node 1, 2, ..; loops int64[m, 2] in ascending order of
    their later node (column 0), all after `first`; facing int8[m]: 1 when the two face opposite
    ways. turns: the heading of one over the other, with as many whole turns as make it nearest to
    what was expected, or second nearest where `other` bool[m] says so; surprise float64[m]: how far
    from it, rad. A scalar Kalman filter of the heading in the map of its own past, which counts as
    known. Without loops the poses are dead reckoning.
    """
    uncertain = 0.0
    k = 0
    for i in range(first + 1, poses.shape[0]):
        turn = steps[i - 1, 1]
        uncertain += steps[i - 1, 3] * steps[i - 1, 3]
        while k < loops.shape[0] and loops[k, 0] == i:
            half = math.pi if facing[k] else 0.0
            heading = poses[i - 1, 2] + turn
            past = poses[loops[k, 1], 2]
            turns[k] = half + TAU * math.floor((heading - past - half) / TAU + 0.5)
            surprise[k] = past + turns[k] - heading
            if other[k]:
                turns[k] += -TAU if surprise[k] > 0.0 else TAU
            gain = uncertain / (uncertain + loop_heading * loop_heading)
            turn += gain * (past + turns[k] - heading)
            uncertain *= 1.0 - gain
            k += 1
        poses[i] = poses[i - 1]
        reckon(poses[i], steps[i - 1, 0], turn)


@compiled
def reckon(pose: Floats, distance: float, turn: float) -> None:
    """Move a pose float64[3] in place: turn first, then go the distance."""
    pose[2] += turn
    pose[0] += distance * cos(pose[2])
    pose[1] += distance * sin(pose[2])
