"""Which past whisks a whisk is said to repeat: groups of states at one place, not single states.

Several earlier visits to a place share the posterior, so that none of them looks certain. Every
whisk carries the label of its place (the number of the whisk that was there first) and whether it
faced the other way there; states whose labels lie close together and that say the same about the
heading are one group, and it is the group that must be certain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.slam.sequence_table import Floats, Ints


@compiled
def find_members(
    posterior: Floats,
    states: int,
    whisk: Ints,
    label: Ints,
    facing: NDArray[np.int8],
    reach: int,
    certain: float,
    share: float,
    members: NDArray[np.int32],
) -> int:
    """The members of the certain group: fills members int32[m, 2] (state, direction).

    posterior: float64[2, >= states]; whisk int64[n]: number of each remembered whisk; label int64,
    facing int8 (0 or 1): place label and facing of every whisk. reach: how far apart the labels of
    a group are; certain: least probability of a group; share: least of a member, relative to the
    best. Members are local maxima along the whisks. Returns how many there are, the best first; 0
    when no group is certain.
    """
    best, best_row, highest = -1, 0, 0.0
    for row in range(2):
        for j in range(states):
            if posterior[row, j] > highest:
                best, best_row, highest = j, row, posterior[row, j]
    if best < 0:
        return 0
    centre = label[whisk[best]]
    faces = facing[whisk[best]] ^ best_row
    mass = 0.0
    members[0, 0], members[0, 1] = best, best_row
    count = 1
    for row in range(2):
        for j in range(states):
            place = whisk[j]
            if abs(label[place] - centre) > reach or (facing[place] ^ row) != faces:
                continue
            p = posterior[row, j]
            mass += p
            if p < share * highest or count == members.shape[0] or (row == best_row and j == best):
                continue
            if (j == 0 or posterior[row, j - 1] < p) and (
                j == states - 1 or posterior[row, j + 1] <= p
            ):
                members[count, 0], members[count, 1] = j, row
                count += 1
    return count if mass >= certain else 0
