"""The least-squares optimum of an experience map, to compare its relaxation with.

Minimises, over all poses, the sum over links (a, b, distance, heading, facing) of
    |p_b - p_a - distance (cos(th_a + heading), sin(th_a + heading))|^2
    + wrap(th_b - th_a - facing)^2
in m^2 + rad^2, by Gauss-Newton with Levenberg-Marquardt damping on the sparse normal equations.
The first experience of every connected part of the map stays where it is. An analysis tool, not
part of any step: its linear algebra is scipy's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse import linalg as sparse_linalg

from vibrissa.slam.angles import PI, TAU
from vibrissa.slam.experience_map import ExperienceMapError

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Optimum:
    """Poses float64[n, 3] at a minimum of the cost (m^2 + rad^2), and how it was reached."""

    poses: Floats
    cost: float
    iterations: int
    converged: bool


def map_cost(poses: ArrayLike, links: ArrayLike, link_values: ArrayLike) -> float:
    """Sum of the squared residuals of all links, m^2 + rad^2."""
    residuals = _residuals(*_checked(poses, links, link_values))
    return float((residuals * residuals).sum())


def optimise(
    poses: ArrayLike,
    links: ArrayLike,
    link_values: ArrayLike,
    max_iterations: int = 100,
    tolerance: float = 1e-12,
) -> Optimum:
    """The nearest least-squares optimum of a map, starting from its present poses.

    poses: float64[n, 3]; links: int32[m, 2]; link_values: float64[m, 4] (distance, heading,
    facing, duration), as from `ExperienceMap`. Stops when a step lowers the cost by less than
    `tolerance` of it or moves nothing by more than `tolerance` (m, rad).

    Raises ExperienceMapError for arrays that do not fit together or are not finite.
    """
    state, ends, values = _checked(poses, links, link_values)
    n = len(state)
    graph = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(n, n))
    _, part = csgraph.connected_components(graph, directed=False)
    free = np.ones(n, dtype=bool)
    free[np.unique(part, return_index=True)[1]] = False
    columns = np.flatnonzero(np.repeat(free, 3))
    residuals = _residuals(state, ends, values)
    cost = float((residuals * residuals).sum())
    if len(columns) == 0:
        return Optimum(state, cost, 0, True)
    damping = 1e-6
    for iteration in range(1, max_iterations + 1):
        jacobian = _jacobian(state, ends, values)[:, columns]
        normal = (jacobian.T @ jacobian).tocsc()
        gradient = jacobian.T @ residuals.ravel()
        while True:
            damped = normal + damping * sparse.identity(len(columns), format="csc")
            step = np.zeros(3 * n)
            step[columns] = -sparse_linalg.spsolve(damped, gradient)
            trial = state + step.reshape(n, 3)
            trial[:, 2] -= TAU * np.ceil((trial[:, 2] - PI) / TAU)
            trial_residuals = _residuals(trial, ends, values)
            trial_cost = float((trial_residuals * trial_residuals).sum())
            largest = float(np.abs(step).max())
            if trial_cost <= cost or largest <= tolerance:
                break
            damping *= 10.0
        gain = cost - trial_cost
        if gain >= 0.0:
            state, residuals, cost = trial, trial_residuals, trial_cost
            damping = max(0.1 * damping, 1e-12)
        if gain <= tolerance * cost or largest <= tolerance:
            return Optimum(state, cost, iteration, True)
    return Optimum(state, cost, max_iterations, False)


def _checked(
    poses: ArrayLike, links: ArrayLike, link_values: ArrayLike
) -> tuple[Floats, Ints, Floats]:
    state = np.array(poses, dtype=np.float64)
    ends = np.asarray(links, dtype=np.int32)
    values = np.asarray(link_values, dtype=np.float64)
    if state.ndim != 2 or state.shape[1] != 3 or len(state) == 0:
        raise ExperienceMapError(f"map poses: expected shape (n, 3), n > 0, found {state.shape}")
    if ends.ndim != 2 or ends.shape[1] != 2 or values.shape != (len(ends), 4):
        raise ExperienceMapError(
            f"map links: expected shapes (m, 2) and (m, 4), found {ends.shape} and {values.shape}"
        )
    if len(ends) and (ends.min() < 0 or ends.max() >= len(state)):
        raise ExperienceMapError(
            f"map links: expected experiences 0 to {len(state) - 1},"
            f" found {ends.min()} to {ends.max()}"
        )
    if not (np.isfinite(state).all() and np.isfinite(values).all()):
        raise ExperienceMapError("map: expected finite numbers, found NaN or infinity")
    return state, ends, values


def _residuals(state: Floats, ends: Ints, values: Floats) -> Floats:
    a, b = state[ends[:, 0]], state[ends[:, 1]]
    direction = a[:, 2] + values[:, 1]
    residuals = np.empty((len(ends), 3), dtype=np.float64)
    residuals[:, 0] = b[:, 0] - a[:, 0] - values[:, 0] * np.cos(direction)
    residuals[:, 1] = b[:, 1] - a[:, 1] - values[:, 0] * np.sin(direction)
    twist = b[:, 2] - a[:, 2] - values[:, 2]
    residuals[:, 2] = twist - TAU * np.ceil((twist - PI) / TAU)
    return residuals


def _jacobian(state: Floats, ends: Ints, values: Floats) -> sparse.csr_matrix:
    """Derivatives of the residuals, sparse [3 m, 3 n]."""
    m, n = len(ends), len(state)
    a, b = 3 * ends[:, 0], 3 * ends[:, 1]
    direction = state[ends[:, 0], 2] + values[:, 1]
    row = 3 * np.arange(m)
    one = np.ones(m)
    entries = [
        (row, a, -one),
        (row, b, one),
        (row, a + 2, values[:, 0] * np.sin(direction)),
        (row + 1, a + 1, -one),
        (row + 1, b + 1, one),
        (row + 1, a + 2, -values[:, 0] * np.cos(direction)),
        (row + 2, a + 2, -one),
        (row + 2, b + 2, one),
    ]
    rows, columns, data = (np.concatenate(column) for column in zip(*entries, strict=True))
    return sparse.csr_matrix((data, (rows, columns)), shape=(3 * m, 3 * n))
