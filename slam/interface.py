"""The interface every SLAM stands behind: one step per whisk cycle, a map on request.

Poses are (x, y, heading) in the map frame: x, y in metres, heading in radians, counterclockwise
from +x, wrapped to (-pi, pi].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

ACTION_NONE: Final = 0
ACTION_CREATE_NODE: Final = 1
ACTION_CREATE_EDGE: Final = 2


class SlamInputError(ValueError):
    """An image or an odometry step cannot be used; raised before any state changes."""


@dataclass(frozen=True, slots=True)
class Odometry:
    """Average velocities over one step: v in m/s (negative in reverse), w in rad/s, dt in s."""

    v: float
    w: float
    dt: float

    def __post_init__(self) -> None:
        for name, value in (("v", self.v), ("w", self.w), ("dt", self.dt)):
            if not math.isfinite(value):
                raise SlamInputError(f"odometry {name}: expected a finite number, found {value}")
        if self.dt <= 0.0:
            raise SlamInputError(f"odometry dt: expected a positive time in s, found {self.dt}")


@dataclass(frozen=True, slots=True)
class SlamStep:
    """What one step decided, and the pose estimate it ends with.

    `template` is -1 and `experience` is -1 where there is none. `match_error` is the mean absolute
    difference to the matched template (0 to 1), infinite when no template was comparable.
    `action`: 0 none, 1 an experience was created, 2 a known experience was entered.
    `x`, `y` (m) and `heading` (rad): current pose in the map frame.
    `pc_x`, `pc_y`, `pc_th`: the pose cells' packet, in cells; 0 where there are none.
    `experiences`, `templates`: how many exist after the step.
    """

    template: int
    new_template: bool
    match_error: float
    experience: int
    action: int
    x: float
    y: float
    heading: float
    pc_x: float
    pc_y: float
    pc_th: float
    experiences: int
    templates: int


@dataclass(frozen=True, slots=True)
class SlamMap:
    """The map as plain arrays.

    `poses` float64[n, 3] (x, y, heading), `links` int32[m, 2] (from, to), `templates` int32[n]
    (the template each experience was created with).
    """

    poses: NDArray[np.float64]
    links: NDArray[np.int32]
    templates: NDArray[np.int32]


class Slam(Protocol):
    """A SLAM algorithm: deterministic, no I/O, no clock."""

    def step(self, image: NDArray[np.uint8], odometry: Odometry) -> SlamStep:
        """Take the image seen at the end of an odometry step; return the new estimate.

        image: uint8[rows, columns], or uint8[rows, columns, 3] (BGR).
        Raises SlamInputError, before any state changes, for an image of the wrong shape or type.
        """
        ...

    def map(self) -> SlamMap:
        """Return a copy of the current map."""
        ...
