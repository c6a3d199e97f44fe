"""The hidden chain: which past whisk, met in which direction, the present one repeats.

States: every remembered whisk met in the same direction, the same whisks met in the opposite one,
and "new". From one whisk to the next a known state advances by 0, 1 or 2 whisks (backwards when
met in the opposite direction), or becomes new; new becomes any known state with equal chance. A
state that has no whisk to advance to becomes new, so that probability is neither lost nor made.

Remembered whisks are numbered as they were remembered. `follows[c]` says that c + 1 is the whisk
after c; where whisks were left out, a stretch ends. Arrays of states are float64[2, n]: row 0 same,
row 1 opposite direction.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled, exp
from vibrissa.slam.sequence_table import Floats, Ints, score, turned

SAME: Final = 0
OPPOSITE: Final = 1

Flags = NDArray[np.bool_]


@compiled
def likelihoods(table: Floats, factor: float, mask: int, kinds: Ints, out: Floats) -> None:
    """Fill out float64[2, >= k]: how much likelier `mask` is at a place where kinds[k] was felt
    than elsewhere, for both directions; 1 says nothing."""
    reversed_mask = turned(mask)
    for k in range(kinds.shape[0]):
        out[SAME, k] = exp(factor * score(table, mask, kinds[k]))
        out[OPPOSITE, k] = exp(factor * score(table, reversed_mask, kinds[k]))


@compiled
def forward(
    before: Floats,
    known: int,
    now: int,
    new: float,
    follows: Flags,
    kind: NDArray[np.int32],
    like: Floats,
    advance: Floats,
    enter: float,
    leave: float,
    after: Floats,
) -> float:
    """One whisk on: fill `after` float64[2, >= now], return the probability of new.

    before: float64[2, >= known], the probabilities of the known states; new: that of new. now:
    states there are after the step. kind int32[n]: row of `like` of each remembered whisk.
    advance float64[3]: chances to advance 0, 1 or 2; enter, leave: new to known, known to new.
    """
    if now == 0:
        return 1.0
    stay, one, two = advance
    keep = 1.0 - leave
    arriving = enter * new / (2.0 * now)
    for j in range(known):
        after[SAME, j] = stay * before[SAME, j]
        after[OPPOSITE, j] = stay * before[OPPOSITE, j]
    for j in range(known, now):
        after[SAME, j] = 0.0
        after[OPPOSITE, j] = 0.0
    for j in range(min(known, now - 1)):
        if follows[j]:
            after[SAME, j + 1] += one * before[SAME, j]
            if j + 2 < now and follows[j + 1]:
                after[SAME, j + 2] += two * before[SAME, j]
    for j in range(1, known):
        if follows[j - 1]:
            after[OPPOSITE, j - 1] += one * before[OPPOSITE, j]
            if j >= 2 and follows[j - 2]:
                after[OPPOSITE, j - 2] += two * before[OPPOSITE, j]
    moved = 0.0
    total = 0.0
    for row in range(2):
        for j in range(now):
            predicted = keep * after[row, j] + arriving
            moved += predicted
            weighed = predicted * like[row, kind[j]]
            after[row, j] = weighed
            total += weighed
    fresh = max(1.0 - moved, 0.0)
    total += fresh
    for row in range(2):
        for j in range(now):
            after[row, j] /= total
    return fresh / total


@compiled
def backward(
    after: Floats,
    now: int,
    new: float,
    known: int,
    follows: Flags,
    kind: NDArray[np.int32],
    like: Floats,
    advance: Floats,
    enter: float,
    leave: float,
    before: Floats,
) -> float:
    """One whisk back: the likelihood of all later whisks given each state, scaled to at most 1.

    after: float64[2, >= now], overwritten, and `new`: those of the later whisk; like: that of the
    later whisk. Fills before float64[2, >= known] and returns that of new.
    """
    if now == 0:
        return 1.0
    stay, one, two = advance
    keep = 1.0 - leave
    mean = 0.0
    for row in range(2):
        for j in range(now):
            after[row, j] *= like[row, kind[j]]
            mean += after[row, j]
    mean /= 2.0 * now
    fresh = (1.0 - enter) * new + enter * mean
    largest = fresh
    for j in range(known):
        value = stay * after[SAME, j]
        gone = one + two
        if j + 1 < now and follows[j]:
            value += one * after[SAME, j + 1]
            gone -= one
            if j + 2 < now and follows[j + 1]:
                value += two * after[SAME, j + 2]
                gone -= two
        before[SAME, j] = keep * value + (leave + keep * gone) * new
        value = stay * after[OPPOSITE, j]
        gone = one + two
        if j >= 1 and follows[j - 1]:
            value += one * after[OPPOSITE, j - 1]
            gone -= one
            if j >= 2 and follows[j - 2]:
                value += two * after[OPPOSITE, j - 2]
                gone -= two
        before[OPPOSITE, j] = keep * value + (leave + keep * gone) * new
        largest = max(largest, before[SAME, j], before[OPPOSITE, j])
    for row in range(2):
        for j in range(known):
            before[row, j] /= largest
    return fresh / largest
