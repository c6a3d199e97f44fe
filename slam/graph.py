"""A pose graph with a node per whisk: odometry between successive nodes, loops between mid-whisks.

Minimises over poses (x m, y m, heading rad, not wrapped)
- for every odometry step i -> i + 1 with distance d and turn w
      |R(-h_{i+1}) (p_{i+1} - p_i) - (d, 0)|^2 weighed by (along, lateral), (h_{i+1} - h_i - w)^2;
  the displacement is in the frame after the turn, as the odometry integrates;
- for every loop (a, b, turn) between the means m_a, m_b of nodes a - 1, a and b - 1, b
      rho(|m_a - m_b|^2 / place^2 + (h_a - h_b - turn)^2 / heading^2),
  rho(c) = s c / (s + c), the robust function of Geman and McClure, s lowered from loose
  ("graduated non-convexity", Yang et al., RA-L 2020): at first all loops pull, in the end those
  that the others contradict do not.
Touch happens near mid-whisk while a pose is that at the end of its whisk. Gauss-Newton; node 0
stays where it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled, cos, sin
from vibrissa.slam.graph_solver import Structure, analyse, factorise, solve

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


ANCHOR: Final = 1e12
"""Precision with which node 0 stays, 1 / m^2 and 1 / rad^2."""


@dataclass(frozen=True, slots=True)
class GraphParams:
    """Weights of the graph.

    lateral (m): standard deviation of sideways motion in a step; loop_place (m), loop_heading
    (rad): of a loop; robust: chi^2 (3 degrees of freedom) at which a loop's pull is a quarter in
    the end; loosest: how many times that at first; iterations: of Gauss-Newton.
    """

    lateral: float = 0.0015
    loop_place: float = 0.015
    loop_heading: float = 0.1
    robust: float = 9.0
    loosest: float = 1e4
    iterations: int = 12

    def scale(self, iteration: int) -> float:
        """Scale (chi^2) of the robust function: falls tenfold each time, then stays at `robust`."""
        return self.robust * max(self.loosest * 0.1**iteration, 1.0)


@dataclass(frozen=True, slots=True)
class Graph:
    """What the poses have to agree with.

    steps float64[n - 1, 4]: distance (m), turn (rad), and their standard deviations, of the step
    that ends at node 1, 2, ..; loops int64[m, 2]: nodes (a, b), a - 1 > b > 0; turns float64[m]:
    heading of a over b, rad, with as many whole turns as the start values have.
    """

    steps: Floats
    loops: Ints
    turns: Floats


@dataclass(frozen=True, slots=True)
class Solution:
    """poses float64[n, 3], headings not wrapped; weights float64[m]: 1 for a loop that agrees with
    all others, towards 0 for one that is contradicted; cost: what was minimised, chi^2."""

    poses: Floats
    weights: Floats
    cost: float


def optimise(graph: Graph, start: Floats, params: GraphParams) -> Solution:
    """The poses that agree best with odometry and loops, from start float64[n, 3].

    Without loops the result is `start`, to the bit.
    """
    poses = start.copy()
    weights = np.ones(len(graph.loops))
    if len(graph.loops) == 0 or len(poses) < 2:
        return Solution(poses, weights, 0.0)
    nodes = len(poses)
    pairs, slots = block_pairs(nodes, graph.loops)
    structure = analyse(nodes, pairs)
    for iteration in range(params.iterations):
        scale = params.scale(iteration)
        weigh(graph.loops, graph.turns, poses, params, scale, weights)
        step = _newton(graph, structure, slots, poses, params, weights)
        poses += step
    cost = _cost(
        graph.steps,
        graph.loops,
        graph.turns,
        poses,
        params.lateral,
        params.loop_place,
        params.loop_heading,
        params.robust,
    )
    return Solution(poses, weights, cost)


def block_pairs(nodes: int, loops: Ints) -> tuple[NDArray[np.int32], Ints]:
    """The off-diagonal blocks: pairs int32[m, 2], a < b, each once, and which of them belongs to
    every step and then to the pairs (a - 1, b - 1), (a - 1, b), (a, b - 1), (a, b) of every loop,
    int64[n - 1 + 4 l]."""
    chain = np.arange(nodes - 1) * nodes + np.arange(1, nodes)
    a, b = loops[:, 0], loops[:, 1]
    four = np.stack([a - 1, b - 1, a - 1, b, a, b - 1, a, b], axis=1).reshape(-1, 2)
    keys = np.concatenate([chain, four.min(axis=1) * nodes + four.max(axis=1)])
    kinds, slots = np.unique(keys, return_inverse=True)
    return np.stack([kinds // nodes, kinds % nodes], axis=1).astype(np.int32), slots


def _newton(
    graph: Graph,
    structure: Structure,
    slots: Ints,
    poses: Floats,
    params: GraphParams,
    weights: Floats,
) -> Floats:
    diagonal, lower, gradient = normal_equations(graph, structure, slots, poses, params, weights)
    if not factorise(structure.start, structure.row, diagonal, lower):
        raise ArithmeticError("pose graph: the normal equations are not positive definite")
    solve(structure.place, structure.start, structure.row, diagonal, lower, gradient)
    return gradient


def normal_equations(
    graph: Graph,
    structure: Structure,
    slots: Ints,
    poses: Floats,
    params: GraphParams,
    weights: Floats,
) -> tuple[Floats, Floats, Floats]:
    """The blocks of A and the right-hand side of A step = b at these poses and loop weights.

    diagonal float64[n, 3, 3], lower float64[l, 3, 3] as `factorise` takes them, in order of
    elimination; b float64[n, 3] in order of nodes.
    """
    nodes = len(poses)
    diagonal = np.zeros((nodes, 3, 3))
    lower = np.zeros((len(structure.row), 3, 3))
    gradient = np.zeros((nodes, 3))
    precision = 1.0 / np.square([params.loop_place, params.loop_place, params.loop_heading])
    _assemble(
        graph.steps,
        graph.loops,
        graph.turns,
        poses,
        weights,
        params.lateral,
        precision,
        structure.place,
        structure.pair_slot,
        structure.pair_swap,
        slots,
        diagonal,
        lower,
        gradient,
    )
    return diagonal, lower, gradient


@compiled
def loop_residual(loops: Ints, turns: Floats, poses: Floats, k: int) -> tuple[float, float, float]:
    """Displacement (m) and turn (rad) from mid-whisk b to mid-whisk a that a loop says are 0."""
    a, b = loops[k, 0], loops[k, 1]
    x = 0.5 * (poses[a, 0] + poses[a - 1, 0] - poses[b, 0] - poses[b - 1, 0])
    y = 0.5 * (poses[a, 1] + poses[a - 1, 1] - poses[b, 1] - poses[b - 1, 1])
    h = 0.5 * (poses[a, 2] + poses[a - 1, 2] - poses[b, 2] - poses[b - 1, 2])
    return x, y, h - turns[k]


def weigh(
    loops: Ints, turns: Floats, poses: Floats, params: GraphParams, scale: float, weights: Floats
) -> None:
    """Fill the robust weights of all loops for a scale (chi^2)."""
    _weigh(loops, turns, poses, params.loop_place, params.loop_heading, scale, weights)


@compiled
def _cost(
    steps: Floats,
    loops: Ints,
    turns: Floats,
    poses: Floats,
    lateral: float,
    place: float,
    heading: float,
    robust: float,
) -> float:
    total = 0.0
    r, w = np.empty(3), np.empty(3)
    j_a, j_b = np.empty((3, 3)), np.empty((3, 3))
    for i in range(steps.shape[0]):
        step_residual(steps[i], poses[i], poses[i + 1], lateral, r, w, j_a, j_b)
        for k in range(3):
            total += w[k] * r[k] * r[k]
    for k in range(loops.shape[0]):
        x, y, h = loop_residual(loops, turns, poses, k)
        chi2 = (x * x + y * y) / (place * place) + h * h / (heading * heading)
        total += robust * chi2 / (robust + chi2)
    return total


@compiled
def _weigh(
    loops: Ints,
    turns: Floats,
    poses: Floats,
    place: float,
    heading: float,
    scale: float,
    weights: Floats,
) -> None:
    for k in range(loops.shape[0]):
        x, y, h = loop_residual(loops, turns, poses, k)
        chi2 = (x * x + y * y) / (place * place) + h * h / (heading * heading)
        root = scale / (scale + chi2)
        weights[k] = root * root


@compiled
def step_residual(
    step: Floats,
    a: Floats,
    b: Floats,
    lateral: float,
    r: Floats,
    w: Floats,
    j_a: Floats,
    j_b: Floats,
) -> None:
    """Residual r (m, m, rad), precision w and derivatives j_a, j_b by the two poses of a step."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    c, s = cos(b[2]), sin(b[2])
    r[0] = c * dx + s * dy - step[0]
    r[1] = c * dy - s * dx
    r[2] = b[2] - a[2] - step[1]
    w[0] = 1.0 / (step[2] * step[2])
    w[1] = 1.0 / (lateral * lateral)
    w[2] = 1.0 / (step[3] * step[3])
    j_b[0, 0], j_b[0, 1], j_b[0, 2] = c, s, c * dy - s * dx
    j_b[1, 0], j_b[1, 1], j_b[1, 2] = -s, c, -c * dx - s * dy
    j_b[2, 0], j_b[2, 1], j_b[2, 2] = 0.0, 0.0, 1.0
    j_a[0, 0], j_a[0, 1], j_a[0, 2] = -c, -s, 0.0
    j_a[1, 0], j_a[1, 1], j_a[1, 2] = s, -c, 0.0
    j_a[2, 0], j_a[2, 1], j_a[2, 2] = 0.0, 0.0, -1.0


@compiled
def _assemble(
    steps: Floats,
    loops: Ints,
    turns: Floats,
    poses: Floats,
    weights: Floats,
    lateral: float,
    precision: Floats,
    place: Ints,
    pair_slot: Ints,
    pair_swap: NDArray[np.bool_],
    slots: Ints,
    diagonal: Floats,
    lower: Floats,
    gradient: Floats,
) -> None:
    """The normal equations in order of elimination; `gradient` (in order of nodes) is negative."""
    nodes = poses.shape[0]
    j_a = np.zeros((3, 3))
    j_b = np.zeros((3, 3))
    block = np.zeros((3, 3))
    r = np.empty(3)
    w = np.empty(3)
    for p in range(3):
        diagonal[place[0], p, p] += ANCHOR
    for i in range(nodes - 1):
        step_residual(steps[i], poses[i], poses[i + 1], lateral, r, w, j_a, j_b)
        here, there = place[i], place[i + 1]
        for p in range(3):
            for q in range(3):
                own_a = own_b = across = 0.0
                for k in range(3):
                    own_a += j_a[k, p] * w[k] * j_a[k, q]
                    own_b += j_b[k, p] * w[k] * j_b[k, q]
                    across += j_a[k, p] * w[k] * j_b[k, q]
                diagonal[here, p, q] += own_a
                diagonal[there, p, q] += own_b
                block[p, q] = across
            for k in range(3):
                gradient[i, p] -= j_a[k, p] * w[k] * r[k]
                gradient[i + 1, p] -= j_b[k, p] * w[k] * r[k]
        slot = pair_slot[slots[i]]
        for p in range(3):
            for q in range(3):
                lower[slot, p, q] += block[q, p] if pair_swap[slots[i]] else block[p, q]
    for k in range(loops.shape[0]):
        a, b = loops[k, 0], loops[k, 1]
        residual = loop_residual(loops, turns, poses, k)
        for p in range(3):
            force = 0.25 * weights[k] * precision[p]
            for node, sign in ((a - 1, 2.0), (a, 2.0), (b - 1, -2.0), (b, -2.0)):
                gradient[node, p] -= sign * force * residual[p]
                diagonal[place[node], p, p] += force
            lower[pair_slot[slots[a - 1]], p, p] += force
            lower[pair_slot[slots[b - 1]], p, p] += force
            for across in range(4):
                lower[pair_slot[slots[nodes - 1 + 4 * k + across]], p, p] -= force
