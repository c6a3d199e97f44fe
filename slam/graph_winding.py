"""Whole turns: where odometry left the heading off by nearly half a turn, both ways are tried.

A loop tells a heading up to whole turns only. Where the expected heading is far from the nearest of
them, the next one over is about as likely by headings alone, but only one of the two lets the
places in between fit as well.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.slam.graph import Floats, Graph, GraphParams, Ints, Solution, optimise
from vibrissa.slam.graph_start import start_values

MOST_DOUBTS: Final = 6
"""Loops whose whole turns are tried the other way, each at the price of one optimisation ..."""
MOST_NODES: Final = 24_000
"""... of the whole graph: poses that all these tries together may solve for."""


def solve_unwound(
    first: Floats,
    steps: Floats,
    loops: Ints,
    facing: NDArray[np.int8],
    params: GraphParams,
    doubt: float,
) -> Solution:
    """The best poses found over the whole turns in doubt.

    first float64[3]: pose of node 0; steps float64[n - 1, 4], loops int64[m, 2] in ascending order
    of their later node, facing int8[m], as in `start_values`; doubt: rad, surprise of a loop's
    heading beyond which its whole turns are tried the other way too.
    """
    other = np.zeros(len(loops), dtype=np.bool_)
    best, surprise = _solve(first, steps, loops, facing, params, other)
    tried = 0
    done = -1
    while tried < min(MOST_DOUBTS, MOST_NODES // (len(steps) + 1)):
        later = np.flatnonzero(np.abs(surprise[done + 1 :]) > doubt)
        if len(later) == 0:
            break
        done += 1 + int(later[0])
        tried += 1
        other[done] = True
        found, surprise_found = _solve(first, steps, loops, facing, params, other)
        if found.cost < best.cost:
            best, surprise = found, surprise_found
        else:
            other[done] = False
    return best


def _solve(
    first: Floats,
    steps: Floats,
    loops: Ints,
    facing: NDArray[np.int8],
    params: GraphParams,
    other: NDArray[np.bool_],
) -> tuple[Solution, Floats]:
    poses = np.empty((len(steps) + 1, 3))
    poses[0] = first
    turns, surprise = np.empty(len(loops)), np.empty(len(loops))
    start_values(poses, 0, steps, loops, facing, params.loop_heading, other, turns, surprise)
    return optimise(Graph(steps, loops, turns), poses, params), surprise
