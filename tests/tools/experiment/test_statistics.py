"""Means, bootstrap intervals, paired differences, and when an effect counts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.tools.experiment.statistics import (
    Difference,
    Summary,
    geometric_mean,
    paired,
    reading,
    summarise,
)

numbers = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=12)


@given(numbers)
def test_the_interval_holds_the_mean_and_stays_within_the_values(values: list[float]) -> None:
    s = summarise(values)
    slack = 1e-9 * (1 + max(map(abs, values)))
    assert min(values) - slack <= s.low <= s.mean + slack
    assert s.mean - slack <= s.high <= max(values) + slack
    assert s.sd == pytest.approx(np.std(values, ddof=1) if len(values) > 1 else 0.0, abs=1e-7)


def test_the_interval_of_many_values_is_that_of_the_normal_distribution() -> None:
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    s = summarise(values)
    half = 1.96 * 2.0 / math.sqrt(400)
    assert s.high - s.low == pytest.approx(2 * half, rel=0.15)


def test_the_same_values_give_the_same_interval() -> None:
    assert summarise([1.0, 2.0, 4.0]) == summarise([1.0, 2.0, 4.0])


def test_values_that_are_not_numbers_are_left_out() -> None:
    assert summarise([1.0, math.nan, 3.0]).mean == 2.0
    assert summarise([math.nan]).n == 0 and math.isnan(summarise([]).mean)


def test_pairs_are_compared_pair_by_pair() -> None:
    found = paired([1.0, 2.0, 3.0, math.nan], [2.0, 1.0, 5.0, 7.0])
    assert (found.up, found.down, found.summary.n) == (2, 1, 3)
    assert found.summary.mean == pytest.approx(2.0 / 3.0)
    with pytest.raises(ValueError, match="3 values against 2"):
        paired([1.0, 2.0, 3.0], [1.0, 2.0])


@pytest.mark.parametrize(
    ("low", "high", "up", "down", "sign", "expected"),
    [
        (0.1, 0.4, 5, 0, +1, "as in the paper"),
        (0.1, 0.4, 5, 0, -1, "opposite to the paper"),
        (-0.4, -0.1, 1, 4, -1, "as in the paper"),
        (-0.1, 0.4, 5, 0, +1, "not resolved"),
        (0.1, 0.4, 3, 2, +1, "not resolved"),
    ],
)
def test_an_effect_counts_when_interval_and_seeds_agree(
    low: float, high: float, up: int, down: int, sign: int, expected: str
) -> None:
    difference = Difference(Summary(5, (low + high) / 2, 0.1, low, high), up, down)
    assert reading(difference, sign) == expected


def test_two_pairs_resolve_nothing() -> None:
    assert reading(paired([0.0, 0.0], [1.0, 1.0]), +1) == "not resolved"


def test_geometric_mean() -> None:
    assert geometric_mean([0.5, 2.0, 8.0]) == pytest.approx(2.0)
    assert math.isnan(geometric_mean([math.nan]))
