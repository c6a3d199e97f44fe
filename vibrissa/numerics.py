"""Arithmetic shared by every room: compiled functions, elementary functions, counter-based noise.

This file lies below all rooms so that `slam`, `control` and `rig` can share it without importing
each other.
"""

from vibrissa.compilation import compiled
from vibrissa.elementary import (
    MAX_ANGLE,
    acos,
    asin,
    atan2,
    cos,
    cos_sin_turn,
    exp,
    hypot,
    log,
    sin,
)
from vibrissa.philox import (
    normal_quantile,
    philox4x32,
    philox_normal,
    philox_normals4,
    philox_uniform,
)

__all__ = [
    "MAX_ANGLE",
    "acos",
    "asin",
    "atan2",
    "compiled",
    "cos",
    "cos_sin_turn",
    "exp",
    "hypot",
    "log",
    "normal_quantile",
    "philox4x32",
    "philox_normal",
    "philox_normals4",
    "philox_uniform",
    "sin",
]
