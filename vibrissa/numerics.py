"""Arithmetic shared by every room: compiled functions, elementary functions, counter-based noise.

This file lies below all rooms so that `slam`, `control` and `rig` can share it without importing
each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile in nopython mode with strict IEEE arithmetic; the machine code is cached on disk."""
    return cast(F, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))


@compiled
def sin(x: float) -> float:
    return math.sin(x)


@compiled
def cos(x: float) -> float:
    return math.cos(x)


@compiled
def exp(x: float) -> float:
    return math.exp(x)


@compiled
def log(x: float) -> float:
    return math.log(x)


@compiled
def atan2(y: float, x: float) -> float:
    return math.atan2(y, x)
