"""The hidden chain along a run: forward whisk by whisk, smoothed with a lag or in batch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from vibrissa.slam.sequence_chain import backward, forward, likelihoods
from vibrissa.slam.sequence_config import SequenceConfig
from vibrissa.slam.sequence_memory import WhiskMemory
from vibrissa.slam.sequence_table import Floats, Ints

BLOCK: Final = 64
"""Whisks between two messages that a batch run keeps."""


@dataclass(eq=False)
class Belief:
    """After a whisk: known float64[2, states], and the probability of new; like float64[2, kinds],
    the likelihoods it was reached with."""

    known: Floats
    new: float
    like: Floats

    @property
    def states(self) -> int:
        return int(self.known.shape[1])


class SequenceFilter:
    """The chain over a memory that somebody else fills."""

    def __init__(self, config: SequenceConfig, memory: WhiskMemory) -> None:
        self._memory = memory
        self._factor = config.evidence
        self._advance = np.array(config.advance)
        self._enter, self._leave = config.enter, config.leave

    def begin(self) -> Belief:
        """Before the first whisk: all is new."""
        return Belief(np.zeros((2, 0)), 1.0, np.ones((2, 0)))

    def forward(self, before: Belief, mask: int, states: int, table: Floats) -> Belief:
        """One whisk on, in which `mask` was felt and after which there are `states` states."""
        memory = self._memory
        like = np.empty((2, len(memory.kinds)))
        likelihoods(table, self._factor, mask, memory.kinds, like)
        known = np.empty((2, states))
        new = forward(
            before.known,
            before.states,
            states,
            before.new,
            memory.follows,
            memory.kind,
            like,
            self._advance,
            self._enter,
            self._leave,
            known,
        )
        return Belief(known, new, like)

    def backward(
        self, later: Belief, message: Floats, new: float, states: int
    ) -> tuple[Floats, float]:
        """The message float64[2, states] (and that for new) one whisk before `later`, whose own is
        `message` (overwritten) and `new`."""
        before = np.empty((2, states))
        fresh = backward(
            message,
            later.states,
            new,
            states,
            self._memory.follows,
            self._memory.kind,
            later.like,
            self._advance,
            self._enter,
            self._leave,
            before,
        )
        return (before, fresh) if later.states else (np.ones((2, states)), 1.0)

    def smooth(self, beliefs: list[Belief], count: int) -> list[Floats]:
        """Posteriors float64[2, states] of the first `count` beliefs, given all of them."""
        last = beliefs[-1]
        return self._smooth(beliefs, count, np.ones_like(last.known), 1.0)

    def _smooth(
        self, beliefs: list[Belief], count: int, message: Floats, new: float
    ) -> list[Floats]:
        found: list[Floats] = []
        for k in range(len(beliefs) - 1, -1, -1):
            here = beliefs[k]
            if k < count:
                weighed = here.known * message
                found.append(weighed / (weighed.sum() + here.new * new))
            if k > 0:
                message, new = self.backward(here, message, new, beliefs[k - 1].states)
        return found[::-1]

    def smooth_run(self, masks: Ints, states: Ints) -> Iterator[Floats]:
        """Posteriors float64[2, states[t]] of every whisk given the whole run, in order.

        masks, states int64[n]: what was felt, and how many states there are after each whisk. Keeps
        a belief or a message per block only, and computes those between a second time.
        """
        table = self._memory.table
        n = len(masks)
        beliefs: list[Belief] = []
        belief = self.begin()
        for t in range(n):
            if t % BLOCK == 0:
                beliefs.append(belief)
            belief = self.forward(belief, int(masks[t]), int(states[t]), table)
        messages: list[tuple[Floats, float]] = []
        message, new = np.ones((2, int(states[-1]))), 1.0
        for t in range(n - 1, -1, -1):
            if t % BLOCK == BLOCK - 1 or t == n - 1:
                messages.append((message.copy(), new))
            if t > 0:
                like = np.empty((2, len(self._memory.kinds)))
                likelihoods(table, self._factor, int(masks[t]), self._memory.kinds, like)
                here = Belief(message, new, like)  # only its size and likelihoods are looked at
                message, new = self.backward(here, message, new, int(states[t - 1]))
        for start, before in zip(range(0, n, BLOCK), beliefs, strict=True):
            block = []
            belief = before
            for t in range(start, min(start + BLOCK, n)):
                belief = self.forward(belief, int(masks[t]), int(states[t]), table)
                block.append(belief)
            yield from self._smooth(block, len(block), *messages.pop())
