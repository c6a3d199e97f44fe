"""Angles in radians, wrapped the way OpenRatSLAM wraps them."""

from __future__ import annotations

import math
from typing import Final

from vibrissa.numerics import compiled

TAU: Final = 2.0 * math.pi
PI: Final = math.pi


@compiled
def wrap_pi(angle: float) -> float:
    """The angle in (-pi, pi]."""
    if angle > PI or angle <= -PI:
        angle -= TAU * math.floor(angle / TAU)
        if angle > PI:
            angle -= TAU
        if angle <= -PI:
            angle = PI
    return angle


@compiled
def turn(start: float, end: float) -> float:
    """The smallest signed turn from one heading to another, in (-pi, pi]."""
    return wrap_pi(end - start)
