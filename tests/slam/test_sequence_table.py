"""What is learnt from contact masks, and that nothing is learnt where there is nothing."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vibrissa.slam.sequence_table import (
    MASKS,
    count_newest,
    count_pair,
    empty_counts,
    ring_counts,
    score,
    turned,
    weights,
)

masks = st.integers(0, MASKS - 1)


def learnt(felt: np.ndarray) -> np.ndarray:
    counts = empty_counts()
    for i in range(len(felt)):
        count_newest(counts, felt, i)
    return weights(counts)


@settings(deadline=None)
@given(masks)
def test_whiskers_are_counted_by_ring(mask: int) -> None:
    found = ring_counts(mask)
    expected = [((mask >> (6 * ring)) & 63).bit_count() for ring in range(3)]
    assert [(found >> (6 * ring)) & 63 for ring in range(3)] == expected


@settings(deadline=None)
@given(masks)
def test_half_a_turn_moves_every_whisker_by_three_and_twice_is_none(mask: int) -> None:
    expected = sum(
        ((mask >> (6 * ring + k)) & 1) << (6 * ring + (k + 3) % 6)
        for ring in range(3)
        for k in range(6)
    )
    assert turned(mask) == expected
    assert turned(turned(mask)) == mask


@settings(deadline=None)
@given(masks, masks, st.integers(0, 2**32))
def test_a_score_is_the_same_from_either_side_and_after_half_a_turn(
    a: int, b: int, seed: int
) -> None:
    table = np.random.default_rng(seed).normal(size=(3, 3))
    assert score(table, a, b) == score(table, b, a)
    assert score(table, turned(a), turned(b)) == score(table, a, b)


def test_a_score_adds_the_weights_of_all_whiskers() -> None:
    table = np.array([[1.0, 10.0, 100.0], [2.0, 20.0, 200.0], [3.0, 30.0, 300.0]])
    a, b = 0b000001_000011_000111, 0b000000_000001_000011
    # ring 0: both 2, one 1, none 3; ring 1: both 1, one 1, none 4; ring 2: one 1, none 5
    assert score(table, a, b) == (200 + 10 + 3) + (200 + 20 + 8) + (30 + 15)


def test_counts_are_those_of_all_pairs_of_neighbours_and_background() -> None:
    felt = np.random.default_rng(1).integers(0, MASKS, 100)
    counts, expected = empty_counts(), empty_counts()
    for i in range(100):
        count_newest(counts, felt, i)
        for j in range(i):
            if i - j == 1:
                count_pair(expected, 0, felt[i], felt[j])
            elif 9 <= i - j <= 60:
                count_pair(expected, 1, felt[i], felt[j])
    assert (counts == expected).all()
    assert counts[0].sum() == 99 * 18


def test_without_contrast_every_weight_is_exactly_zero() -> None:
    for felt in (0, MASKS - 1):
        assert (learnt(np.full(200, felt, dtype=np.int64)) == 0.0).all()
    assert (weights(empty_counts()) == 0.0).all()


def test_contact_that_lasts_makes_agreement_count() -> None:
    rng = np.random.default_rng(2)
    table = learnt(np.repeat(rng.integers(0, MASKS, 60), 5))
    assert (table[:, 2] > 0.1).all()  # both in contact
    assert (table[:, 1] < -0.1).all()  # one only
