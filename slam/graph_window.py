"""The newest poses of the graph estimated anew, older ones held: cost in proportion to the window.

Every loop then pulls at one whisk of the window only, towards where the other is now, so that the
normal equations are block tridiagonal and eliminated along the chain without any fill.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.slam.graph import GraphParams, loop_residual, step_residual
from vibrissa.slam.graph_solver import invert
from vibrissa.slam.graph_start import start_values

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def refine(
    poses: Floats,
    first: int,
    steps: Floats,
    loops: Ints,
    facing: NDArray[np.int8],
    params: GraphParams,
) -> None:
    """Estimate poses float64[n, 3] after node `first` anew, in place.

    steps float64[n - 1, 4], loops int64[m, 2] in ascending order of column 0, facing int8[m], as in
    `graph_start.start_values`; loops whose later node is within `first` + 1 are passed over.
    """
    loops_from = int(np.searchsorted(loops[:, 0], first + 2))
    loops, facing = loops[loops_from:], facing[loops_from:]
    turns, surprise = np.empty(len(loops)), np.empty(len(loops))
    nearest = np.zeros(len(loops), dtype=np.bool_)
    start_values(poses, first, steps, loops, facing, params.loop_heading, nearest, turns, surprise)
    if len(loops) == 0:
        return
    scales = np.array([params.scale(k) for k in range(params.iterations)])
    precision = 1.0 / np.square([params.loop_place, params.loop_place, params.loop_heading])
    _refine(poses, first, steps, loops, turns, scales, params.lateral, precision)


@compiled
def _refine(
    poses: Floats,
    first: int,
    steps: Floats,
    loops: Ints,
    turns: Floats,
    scales: Floats,
    lateral: float,
    precision: Floats,
) -> None:
    count = poses.shape[0] - first - 1
    diagonal = np.empty((count, 3, 3))
    lower = np.empty((count, 3, 3))  # row: the node, column: the one before
    gradient = np.empty((count, 3))
    j_a = np.empty((3, 3))
    j_b = np.empty((3, 3))
    r = np.empty(3)
    w = np.empty(3)
    for iteration in range(scales.shape[0]):
        diagonal[:] = 0.0
        lower[:] = 0.0
        gradient[:] = 0.0
        for i in range(count):
            node = first + 1 + i
            step_residual(steps[node - 1], poses[node - 1], poses[node], lateral, r, w, j_a, j_b)
            for p in range(3):
                for k in range(3):
                    gradient[i, p] -= j_b[k, p] * w[k] * r[k]
                    if i > 0:
                        gradient[i - 1, p] -= j_a[k, p] * w[k] * r[k]
                    for q in range(3):
                        diagonal[i, p, q] += j_b[k, p] * w[k] * j_b[k, q]
                        if i > 0:
                            diagonal[i - 1, p, q] += j_a[k, p] * w[k] * j_a[k, q]
                            lower[i, p, q] += j_b[k, p] * w[k] * j_a[k, q]
        for k in range(loops.shape[0]):
            residual = loop_residual(loops, turns, poses, k)
            chi2 = 0.0
            for p in range(3):
                chi2 += precision[p] * residual[p] * residual[p]
            root = scales[iteration] / (scales[iteration] + chi2)
            i = loops[k, 0] - first - 1
            for p in range(3):
                force = 0.25 * root * root * precision[p]
                diagonal[i, p, p] += force
                diagonal[i - 1, p, p] += force
                lower[i, p, p] += force
                gradient[i, p] -= 2.0 * force * residual[p]
                gradient[i - 1, p] -= 2.0 * force * residual[p]
        _solve_chain(diagonal, lower, gradient)
        for i in range(count):
            for p in range(3):
                poses[first + 1 + i, p] += gradient[i, p]


@compiled
def _solve_chain(diagonal: Floats, lower: Floats, b: Floats) -> None:
    """Solve the block tridiagonal system in place: b float64[n, 3] becomes x."""
    n = b.shape[0]
    scaled = np.empty((3, 3))
    for i in range(n):
        if i > 0:
            for p in range(3):
                for q in range(3):
                    total = 0.0
                    for k in range(3):
                        total += lower[i, p, k] * diagonal[i - 1, k, q]
                    scaled[p, q] = total
            for p in range(3):
                for q in range(3):
                    for k in range(3):
                        diagonal[i, p, q] -= scaled[p, k] * lower[i, q, k]
                    b[i, p] -= scaled[p, q] * b[i - 1, q]
            for p in range(3):
                for q in range(3):
                    lower[i, p, q] = scaled[p, q]
        invert(diagonal[i])
    for i in range(n - 1, -1, -1):
        x = diagonal[i, 0] * b[i, 0] + diagonal[i, 1] * b[i, 1] + diagonal[i, 2] * b[i, 2]
        if i < n - 1:
            x -= (
                lower[i + 1, 0] * b[i + 1, 0]
                + lower[i + 1, 1] * b[i + 1, 1]
                + lower[i + 1, 2] * b[i + 1, 2]
            )
        for p in range(3):
            b[i, p] = x[p]
