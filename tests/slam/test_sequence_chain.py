"""The hidden chain against a dense matrix of transitions, for any memory with gaps."""

from __future__ import annotations

import numpy as np
import pytest

from vibrissa.slam.sequence_chain import backward, forward
from vibrissa.slam.sequence_config import SequenceConfig
from vibrissa.slam.sequence_filter import BLOCK, SequenceFilter
from vibrissa.slam.sequence_memory import WhiskMemory

ADVANCE = np.array([0.1, 0.8, 0.1])
ENTER, LEAVE = 0.01, 0.02


def transitions(known: int, now: int, follows: np.ndarray) -> np.ndarray:
    """Dense [2 known + 1, 2 now + 1]; the last row and column are new."""
    t = np.zeros((2 * known + 1, 2 * now + 1))
    for j in range(known):
        for row, direction in ((0, 1), (1, -1)):
            at: int | None = j
            for steps in range(3):
                if at is not None:
                    t[row * known + j, row * now + at] += (1.0 - LEAVE) * ADVANCE[steps]
                    ahead = at + direction
                    link = at if direction == 1 else ahead
                    at = ahead if 0 <= ahead < now and follows[link] else None
    t[-1, :-1] = ENTER / (2.0 * now)
    t[:, -1] = 1.0 - t[:, :-1].sum(axis=1)
    return t


def random_case(seed: int, known: int, now: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    follows = rng.random(now) < 0.8
    kind = rng.integers(0, 5, now).astype(np.int32)
    like = rng.uniform(0.2, 3.0, (2, 5))
    return rng, follows, kind, like


@pytest.mark.parametrize(("known", "now"), [(0, 1), (1, 1), (1, 2), (2, 3), (7, 7), (9, 10)])
def test_forward_is_one_step_of_the_dense_chain(known: int, now: int) -> None:
    rng, follows, kind, like = random_case(known + now, known, now)
    state = rng.random(2 * known + 1)
    state /= state.sum()
    after = np.empty((2, now))
    before = state[:-1].reshape(2, known).copy()
    new = forward(before, known, now, state[-1], follows, kind, like, ADVANCE, ENTER, LEAVE, after)
    expected = state @ transitions(known, now, follows)
    expected[:-1] *= like[:, kind].ravel()
    expected /= expected.sum()
    assert np.append(after.ravel(), new) == pytest.approx(expected, rel=1e-12)
    assert after.sum() + new == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(("known", "now"), [(0, 1), (1, 1), (1, 2), (2, 3), (7, 7), (9, 10)])
def test_backward_is_one_step_of_the_dense_chain(known: int, now: int) -> None:
    rng, follows, kind, like = random_case(known + now, known, now)
    message = rng.random(2 * now + 1)
    after = message[:-1].reshape(2, now).copy()
    before = np.empty((2, known))
    new = backward(
        after, now, message[-1], known, follows, kind, like, ADVANCE, ENTER, LEAVE, before
    )
    weighed = message * np.append(like[:, kind].ravel(), 1.0)
    expected = transitions(known, now, follows) @ weighed
    expected /= expected.max()
    assert np.append(before.ravel(), new) == pytest.approx(expected, rel=1e-12)


def test_a_whole_run_smoothed_in_blocks_is_the_run_smoothed_at_once() -> None:
    rng = np.random.default_rng(3)
    felt = np.repeat(rng.integers(0, 1 << 18, 40), 3)
    masks = np.concatenate([felt, felt])[: 3 * BLOCK + 7]
    config = SequenceConfig(gap=10)
    memory = WhiskMemory(1000)
    for whisk, mask in enumerate(masks):
        memory.feel(int(mask))
        if whisk >= 10:
            memory.remember(whisk - 10)
    chain = SequenceFilter(config, memory)
    states = np.maximum(np.arange(len(masks)) - 9, 0)
    belief, beliefs = chain.begin(), []
    for mask, count in zip(masks, states, strict=True):
        belief = chain.forward(belief, int(mask), int(count), memory.table)
        beliefs.append(belief)
    at_once = chain.smooth(beliefs, len(beliefs))
    in_blocks = list(chain.smooth_run(masks, states))
    assert len(in_blocks) == len(at_once)
    assert all(np.array_equal(a, b) for a, b in zip(at_once, in_blocks, strict=True))
    assert np.array_equal(at_once[-1], beliefs[-1].known / (beliefs[-1].known.sum() + belief.new))


def test_forgetting_keeps_first_visits_and_the_order_of_whisks() -> None:
    memory = WhiskMemory(100)
    for whisk in range(100):
        memory.feel(whisk % 7)
        memory.remember(whisk)
    label = np.arange(100, dtype=np.int64) % 25  # four visits to 25 places
    kept = memory.forget(label)
    assert memory.remembered == 50
    assert kept.tolist() == list(range(50))
    assert memory.whisk[:50].tolist() == kept.tolist()
    assert memory.follows[:49].all()
    assert not memory.follows[49]


def test_where_nothing_came_twice_the_oldest_are_forgotten() -> None:
    memory = WhiskMemory(100)
    for whisk in range(100):
        memory.feel(0)
        memory.remember(whisk)
    assert memory.forget(np.arange(100, dtype=np.int64)).tolist() == list(range(50, 100))
