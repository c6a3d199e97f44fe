"""Which whole turns are tried both ways, and how often."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vibrissa.slam import graph_winding
from vibrissa.slam.graph import GraphParams, Solution
from vibrissa.slam.graph_winding import MOST_DOUBTS, MOST_NODES, solve_unwound

SURPRISES = np.array([0.1, -1.2, 0.0, 1.6, 0.9] * 4)


class Solver:
    """Takes the place of the optimisation: a cost by which loops go the other way."""

    def __init__(self, good: int) -> None:
        self.tried: list[tuple[int, ...]] = []
        self._good = good

    def __call__(self, *arguments: Any) -> tuple[Solution, np.ndarray]:
        other = np.flatnonzero(arguments[-1])
        self.tried.append(tuple(other.tolist()))
        cost = 10.0 + len(other) - 5.0 * (self._good in other)
        return Solution(np.zeros((1, 3)), np.ones(0), cost), SURPRISES


def solved(
    monkeypatch: pytest.MonkeyPatch, nodes: int, doubt: float = 1.0, good: int = 3
) -> tuple[list[tuple[int, ...]], float]:
    solver = Solver(good)
    monkeypatch.setattr(graph_winding, "_solve", solver)
    loops = np.zeros((len(SURPRISES), 2), np.int64)
    facing = np.zeros(len(SURPRISES), np.int8)
    steps = np.zeros((nodes - 1, 4))
    found = solve_unwound(np.zeros(3), steps, loops, facing, GraphParams(), doubt)
    return solver.tried, found.cost


def test_loops_that_surprise_are_tried_in_turn_and_what_is_cheaper_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried, cost = solved(monkeypatch, 100)
    assert tried == [(), (1,), (3,), (3, 6), (3, 8), (3, 11), (3, 13)]
    assert cost == 6.0
    assert solved(monkeypatch, 100, doubt=2.0) == ([()], 10.0)


@pytest.mark.parametrize(
    ("nodes", "tries"),
    [(MOST_NODES // MOST_DOUBTS, MOST_DOUBTS), (10_000, 2), (MOST_NODES, 1), (MOST_NODES + 1, 0)],
)
def test_a_larger_graph_is_solved_less_often(
    monkeypatch: pytest.MonkeyPatch, nodes: int, tries: int
) -> None:
    tried, _ = solved(monkeypatch, nodes, good=-1)
    assert len(tried) == 1 + tries
