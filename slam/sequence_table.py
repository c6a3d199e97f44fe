"""What two contact masks tell about whether they were felt at the same place, learnt from the run.

A mask is 18 bits, bit `6 ring + k` set when that whisker touched something in a whisk. Two masks
compare whisker by whisker: none, one or both of the two in contact. The weight of an outcome is how
much more often it occurs between neighbouring whisks, which feel nearly the same place, than
between whisks a few steps further apart, which feel the same corridor but another place. Nearby
whisks and not random ones are the background because corridors look alike. No ground truth is
involved.

When no whisker ever touches, or all always do, both frequencies agree exactly and all weights are
0.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled, log

RINGS: Final = 3
PER_RING: Final = 6
WHISKERS: Final = RINGS * PER_RING
MASKS: Final = 1 << WHISKERS
RING_MASK: Final = (1 << PER_RING) - 1
NONE, ONE, BOTH = 0, 1, 2
NEAREST_OTHER: Final = 9
FARTHEST_OTHER: Final = 60
"""Whisks that many steps apart are the background."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def empty_counts() -> Ints:
    """int64[2, 3, 3]: (neighbours, background) x ring x outcome, how often each was seen."""
    return np.zeros((2, RINGS, 3), dtype=np.int64)


@compiled
def ring_counts(mask: int) -> int:
    """How many whiskers of each ring are set, ring r in bits 6 r to 6 r + 5."""
    pairs = (mask & 0x15555) + ((mask >> 1) & 0x15555)
    return (pairs & 0o030303) + ((pairs >> 2) & 0o030303) + ((pairs >> 4) & 0o030303)


@compiled
def turned(mask: int) -> int:
    """The mask that a head facing the other way would feel here: k becomes k + 3 in every ring.

    The head has six-fold symmetry in azimuth, so half a turn is an exact permutation of whiskers.
    """
    half = PER_RING // 2
    result = 0
    for ring in range(RINGS):
        part = (mask >> (PER_RING * ring)) & RING_MASK
        result |= (((part << half) | (part >> half)) & RING_MASK) << (PER_RING * ring)
    return result


@compiled
def count_pair(counts: Ints, kind: int, a: int, b: int) -> None:
    """Add the outcomes of masks a and b to counts[kind]."""
    boths, ones = ring_counts(a & b), ring_counts(a ^ b)
    for ring in range(RINGS):
        both = (boths >> (PER_RING * ring)) & RING_MASK
        one = (ones >> (PER_RING * ring)) & RING_MASK
        counts[kind, ring, NONE] += PER_RING - both - one
        counts[kind, ring, ONE] += one
        counts[kind, ring, BOTH] += both


@compiled
def count_newest(counts: Ints, masks: Ints, newest: int) -> None:
    """Count whisk `newest` of masks int64[n] against those before it."""
    if newest > 0:
        count_pair(counts, 0, masks[newest], masks[newest - 1])
    for apart in range(NEAREST_OTHER, min(FARTHEST_OTHER, newest) + 1):
        count_pair(counts, 1, masks[newest], masks[newest - apart])


@compiled
def weights(counts: Ints) -> Floats:
    """Log ratios float64[3, 3] (ring, outcome), natural logarithm; 0 before anything was counted.

    Both frequencies are raised by one count's worth of the neighbours, the same for both, so that
    an outcome never seen weighs nothing and equal frequencies give exactly 0.
    """
    found = np.zeros((RINGS, 3))
    for ring in range(RINGS):
        near = counts[0, ring].sum()
        far = counts[1, ring].sum()
        if near == 0 or far == 0:
            continue
        least = 1.0 / near
        for outcome in range(3):
            p = counts[0, ring, outcome] / near + least
            q = counts[1, ring, outcome] / far + least
            found[ring, outcome] = log(p / q)
    return found


@compiled
def score(table: Floats, a: int, b: int) -> float:
    """Sum over all whiskers of the weights of masks a and b."""
    boths, ones = ring_counts(a & b), ring_counts(a ^ b)
    total = 0.0
    for ring in range(RINGS):
        both = (boths >> (PER_RING * ring)) & RING_MASK
        one = (ones >> (PER_RING * ring)) & RING_MASK
        none = PER_RING - both - one
        total += both * table[ring, BOTH] + one * table[ring, ONE] + none * table[ring, NONE]
    return total
