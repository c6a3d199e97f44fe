"""What a run remembers: its masks, the table they teach, and the whisks that may be repeated."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.slam.growing import grown
from vibrissa.slam.sequence_chain import Flags
from vibrissa.slam.sequence_table import (
    FARTHEST_OTHER,
    Floats,
    Ints,
    count_newest,
    empty_counts,
    weights,
)

VISIT: Final = 5
"""Neighbouring place labels that count as one place when visits are counted."""


class WhiskMemory:
    """Masks of all whisks, and up to `capacity` remembered whisks in the order they came.

    kinds int64[k]: the different masks; kind_of int32[n]: which of them every whisk felt. whisk
    int64[m]: number of every remembered whisk; kind int32[m]; follows bool[m]: the next one
    remembered is the next whisk.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.count = 0
        self.remembered = 0
        self._kind_of_mask: dict[int, int] = {}
        self._kinds = np.zeros(64, dtype=np.int64)
        self._kind_of = np.zeros(256, dtype=np.int32)
        self._recent = np.zeros(FARTHEST_OTHER + 1, dtype=np.int64)
        self._counts = empty_counts()
        self.whisk = np.zeros(capacity, dtype=np.int64)
        self.kind = np.zeros(capacity, dtype=np.int32)
        self.follows: Flags = np.zeros(capacity, dtype=np.bool_)

    @property
    def kinds(self) -> Ints:
        return self._kinds[: len(self._kind_of_mask)]

    @property
    def kind_of(self) -> NDArray[np.int32]:
        return self._kind_of[: self.count]

    @property
    def table(self) -> Floats:
        """The weights learnt so far, float64[3, 3]."""
        return weights(self._counts)

    def feel(self, mask: int) -> bool:
        """Take the mask of the next whisk; whether it was never felt before."""
        known = len(self._kind_of_mask)
        number = self._kind_of_mask.setdefault(mask, known)
        if number == known:
            self._kinds = grown(self._kinds, known + 1)
            self._kinds[number] = mask
        self._kind_of = grown(self._kind_of, self.count + 1)
        self._kind_of[self.count] = number
        self.count += 1
        self._recent[:-1] = self._recent[1:]
        self._recent[-1] = mask
        seen = min(self.count, len(self._recent))
        count_newest(self._counts, self._recent[-seen:], seen - 1)
        return number == known

    def mask(self, whisk: int) -> int:
        """What was felt in a whisk."""
        return int(self._kinds[self._kind_of[whisk]])

    def remember(self, whisk: int) -> None:
        """Let a whisk be repeated from now on. There must be room: see `forget`."""
        m = self.remembered
        if m and self.whisk[m - 1] == whisk - 1:
            self.follows[m - 1] = True
        self.whisk[m], self.kind[m], self.follows[m] = whisk, self._kind_of[whisk], False
        self.remembered = m + 1

    def forget(self, label: Ints) -> Ints:
        """Forget half, places visited often first and of those the latest visits, then the oldest.

        label int64[n]: place label of every whisk. Returns the states that are kept, ascending.
        """
        m = self.remembered
        whisk = self.whisk[:m]
        visit = _visits(label[whisk] // VISIT)
        kept = np.sort(np.lexsort((-whisk, visit))[: self.capacity // 2])
        self.follows[: len(kept)] = np.append(np.diff(whisk[kept]) == 1, False)
        self.whisk[: len(kept)] = whisk[kept]
        self.kind[: len(kept)] = self.kind[kept]
        self.remembered = len(kept)
        return kept


def _visits(place: Ints) -> Ints:
    """How many remembered visits to its place every whisk comes after."""
    order = np.argsort(place, kind="stable")
    first = np.searchsorted(place[order], place[order])
    rank = np.empty(len(place), dtype=np.int64)
    rank[order] = np.arange(len(place)) - first
    return rank // VISIT
