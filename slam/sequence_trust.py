"""Whether the odometer is better than it is believed to be: stretches that were driven twice.

Two whisks of one drive that repeat two whisks of an earlier one bound a stretch that was driven
twice. What odometry says of its length and turn both times differs by the odometer's own noise, and
by little else: the chain that recognises places never looks at odometry. Mean squares of these
differences over the variances believed are the a-posteriori variance factors of length and turn,
or more than them where loops are wrong. Far below 1, the odometer was believed too little, and its
standard deviations are multiplied by the root.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.slam.angles import wrap_pi
from vibrissa.slam.sequence_table import Floats, Ints

STRETCH: Final = 50
"""Whisks of a stretch, at least: the two places at its ends are found only to a whisk or so."""
LONGEST: Final = 200
LEAST_STRETCHES: Final = 10
FAR_BELOW: Final = 0.2
"""Variance factor that is hardly chance, even where all stretches repeat the same lap and so share
its errors; a standard deviation 2.2 times too large."""


@dataclass(eq=False)
class Trust:
    """The stretches among the loops looked at so far.

    anchor int64[4]: later and earlier whisk where a stretch began, its direction, and how many
    stretches there are; sums float64[2]: of squares over variance, of length and of turn.
    """

    looked_at: int = 0
    anchor: Ints = field(default_factory=lambda: np.array([-1, -1, 0, 0], dtype=np.int64))
    sums: Floats = field(default_factory=lambda: np.zeros(2))

    def copied(self) -> Trust:
        return Trust(self.looked_at, self.anchor.copy(), self.sums.copy())

    def look_at(self, loops: Ints, facing: NDArray[np.int8], travelled: Floats) -> None:
        """Take the loops int64[m, 2], facing int8[m] that were not looked at yet.

        travelled float64[n, 4]: distance and turn by odometry from the beginning to every whisk,
        and the variances believed of both.
        """
        _stretches(loops, facing, travelled, self.looked_at, self.anchor, self.sums)
        self.looked_at = len(loops)

    @property
    def factors(self) -> Floats:
        """float64[2]: what the standard deviations of distance and turn are to be multiplied by;
        1 as long as nothing speaks against them."""
        found = np.ones(2)
        count = int(self.anchor[3])
        if count >= LEAST_STRETCHES:
            variance = self.sums / count
            low = variance < FAR_BELOW
            found[low] = np.sqrt(variance[low])
        return found


@compiled
def _stretches(
    loops: Ints,
    facing: NDArray[np.int8],
    travelled: Floats,
    first: int,
    anchor: Ints,
    sums: Floats,
) -> None:
    for k in range(first, loops.shape[0]):
        if k > 0 and loops[k, 0] == loops[k - 1, 0]:
            continue  # of several members the first is the best
        later, earlier = loops[k, 0], loops[k, 1]
        begun, repeated, direction = anchor[0], anchor[1], anchor[2]
        ahead = later - begun
        sign = -1 if facing[k] else 1
        together = (
            begun >= 0
            and direction == facing[k]
            and ahead <= LONGEST
            and 2 * abs(sign * (earlier - repeated) - ahead) <= ahead
            and max(earlier, repeated) < begun
        )
        if together and ahead < STRETCH:
            continue
        anchor[0], anchor[1], anchor[2] = later, earlier, facing[k]
        if not together:
            continue
        new = travelled[later] - travelled[begun]
        old = travelled[earlier] - travelled[repeated]
        length = new[0] - sign * old[0]
        turn = wrap_pi(new[1] - old[1])
        sums[0] += length * length / (new[2] + abs(old[2]))
        sums[1] += turn * turn / (new[3] + abs(old[3]))
        anchor[3] += 1
