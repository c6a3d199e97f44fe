"""The wall-line compass: how the head turned by the direction of the walls it touches.

The whiskers of the rear ring at 30 and 150 degrees to one side meet the wall of a corridor ahead of
and behind the head with their tips. Where these were says how the wall lies to the head; that the
whisker of the middle ring between them touched as well, and reached to their line, says that it is
one wall. A pixel of a contact-angle image tells the height of the tip when it touched, and with the
head's shape its place.

A wall is followed from the whisk that touched it first until the head turns, and says the heading
relative to that whisk. There is no other assumption about walls. Where nothing is touched twice,
the compass says nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled, cos, sin
from vibrissa.slam.sequence_table import PER_RING, WHISKERS, Floats
from vibrissa.slam.tactile import HIGHEST_OBSTACLE

REAR: Final = 2 * PER_RING
SIDES: Final = 2
AHEAD: Final = (REAR + 0, REAR + 5)
BEHIND: Final = (REAR + 2, REAR + 3)
BETWEEN: Final = (PER_RING + 1, PER_RING + 4)
"""Whiskers at 30, 150 and 90 degrees, to the left and to the right."""
SHORT: Final = 0.008
"""m by which the tip of the whisker between may fall short of the line. It may well be beyond: then
its shaft touched."""
TURNING: Final = 0.3
"""rad per whisk beyond which the whiskers of one whisk touch with different headings."""
UNSEEN: Final = 10
"""Whisks after which a wall that did not show is no longer taken for the same."""
LOST: Final = UNSEEN + 1.0
DIRECTION, UNSEEN_FOR = 0, 1
SUM, STEP, VARIANCE = 0, 1, 2
SURPRISE: Final = 4.0
"""Standard deviations beyond which a line is not that of the wall that is followed."""


@dataclass(frozen=True, eq=False)
class HeadShape:
    """Where the whiskers are: float64[18] each, whisker i = 6 ring + k, straight shafts.

    pivot_height: m above the floor; pivot_radius: m from the axis; length: m; azimuth: rad from
    straight ahead, counterclockwise.
    """

    pivot_height: Floats
    pivot_radius: Floats
    length: Floats
    azimuth: Floats


def contact_places(head: HeadShape) -> Floats:
    """Where a tip is as its pixel 1 .. 255 tells, float64[18, 256, 2], m ahead of the axis and to
    the left."""
    found = np.zeros((WHISKERS, 256, 2))
    for i in range(WHISKERS):
        height, length = float(head.pivot_height[i]), float(head.length[i])
        azimuth = float(head.azimuth[i])
        for pixel in range(1, 256):
            down = height - HIGHEST_OBSTACLE * (pixel - 1) / 254.0
            out = math.sqrt(max(length * length - down * down, 0.0))
            reach = float(head.pivot_radius[i]) + out
            found[i, pixel] = reach * cos(azimuth), reach * sin(azimuth)
    return found


class Compass:
    """The heading by walls, whisk by whisk.

    sigma: rad, standard deviation of a wall's direction.
    """

    def __init__(self, head: HeadShape, sigma: float) -> None:
        self._places = contact_places(head)
        self._sigma = sigma
        self._heading = np.zeros(3)
        self._walls = np.zeros((SIDES, 2))
        self._walls[:, UNSEEN_FOR] = LOST

    def turned(self, image: NDArray[np.uint8], turn: float, sigma: float) -> tuple[float, float]:
        """(turn, its standard deviation) of a step by odometry and walls, rad.

        image: uint8[3, 6], contact angles in the whisk that ends the step; turn, sigma: of
        odometry, which come back to the bit where no known wall was touched.
        """
        lines = np.empty(SIDES)
        wall_lines(np.ascontiguousarray(image).ravel(), self._places, lines)
        if not follow(self._heading, self._walls, lines, turn, sigma, self._sigma):
            return turn, sigma
        known = 1.0 / (sigma * sigma) + 1.0 / (self._sigma * self._sigma)
        return float(self._heading[STEP]), 1.0 / math.sqrt(known)


@compiled
def wall_lines(image: NDArray[np.uint8], places: Floats, lines: Floats) -> None:
    """Directions of the walls to the left and right, rad from straight ahead, counterclockwise,
    into lines float64[2]; NaN for none. image: uint8[18]; places: of `contact_places`."""
    for side in range(SIDES):
        lines[side] = np.nan
        ahead, behind = AHEAD[side], BEHIND[side]
        between = BETWEEN[side]
        if image[ahead] == 0 or image[behind] == 0 or image[between] == 0:
            continue
        a, b, c = (
            places[ahead, image[ahead]],
            places[behind, image[behind]],
            places[between, image[between]],
        )
        dx, dy = a[0] - b[0], a[1] - b[1]
        left = (dx * (c[1] - b[1]) - dy * (c[0] - b[0])) / math.sqrt(dx * dx + dy * dy)
        beyond = left if side == 0 else -left
        if beyond >= -SHORT:
            lines[side] = atan2(dy, dx)


@compiled
def follow(
    heading: Floats, walls: Floats, lines: Floats, turn: float, sigma: float, wall_sigma: float
) -> bool:
    """Take a step's turn and the lines float64[2] at its end; whether a known wall was touched.

    heading float64[3]: since the first whisk, that of the last step, and the variance relative to
    the walls that are followed; walls float64[2, 2]: direction of the wall on either side, and for
    how many whisks it did not show. A scalar Kalman filter of the heading; that whiskers touch
    near mid-whisk, half a step earlier, it leaves out: odometry's noise is larger than that.
    """
    now = heading[SUM] + turn
    walls[:, UNSEEN_FOR] += 1.0
    if abs(turn) >= TURNING:
        walls[:, UNSEEN_FOR] = LOST
    followed = (walls[:, UNSEEN_FOR] <= UNSEEN).any()
    uncertain = heading[VARIANCE] + sigma * sigma if followed else 0.0
    touched = False
    for side in range(SIDES):
        if math.isnan(lines[side]) or walls[side, UNSEEN_FOR] > UNSEEN:
            continue
        surprise = walls[side, DIRECTION] - lines[side] - now
        variance = uncertain + wall_sigma * wall_sigma
        if surprise * surprise > SURPRISE * SURPRISE * variance:
            continue
        gain = uncertain / variance
        now += gain * surprise
        uncertain *= 1.0 - gain
        walls[side, UNSEEN_FOR] = 0.0
        touched = True
    for side in range(SIDES):
        new = walls[side, UNSEEN_FOR] > UNSEEN and abs(turn) < TURNING
        if new and not math.isnan(lines[side]):
            walls[side, DIRECTION] = now + lines[side]
            walls[side, UNSEEN_FOR] = 0.0
    heading[STEP] = now - heading[SUM]
    heading[SUM], heading[VARIANCE] = now, uncertain
    return touched
