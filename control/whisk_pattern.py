"""The whisk cycle: one rhythmic protraction and retraction of every whisker."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vibrissa.control.kinematics import (
    WHISKERS,
    Float64s,
    HeadGeometry,
    per_whisker,
    whisker_name,
)
from vibrissa.numerics import compiled, cos

TWO_PI = 2.0 * math.pi

# rows of a whisking law's parameter array
MINIMUM, AMPLITUDE, PERIOD, SLEW = 0, 1, 2, 3
WHISK_ROWS = 4


class WhiskParameterError(ValueError):
    """Parameters that describe no possible whisk."""


@dataclass(frozen=True, eq=False)
class WhiskParams:
    """The whisk that every law modulates.

    minimum       float64[18] rad, start angle of the cycle, >= 0
    amplitude     float64[18] rad, full protraction above the start angle, >= 0
    period_ticks  length of a whisk cycle; cycle n starts at tick n * period_ticks
    slew_limit    rad per tick, largest change of a command; not below the pattern's own steepest
                  change, amplitude * pi / period_ticks

    Raises WhiskParameterError.
    """

    minimum: Float64s
    amplitude: Float64s
    period_ticks: int = 2000
    slew_limit: float = 0.005

    def __post_init__(self) -> None:
        for name in ("minimum", "amplitude"):
            values = per_whisker(getattr(self, name), name, WhiskParameterError)
            object.__setattr__(self, name, values)
            for i in range(WHISKERS):
                if values[i] < 0.0:
                    raise WhiskParameterError(
                        f"{name}: {whisker_name(i)} is {values[i]}, expected >= 0"
                    )
        if self.period_ticks < 2:
            raise WhiskParameterError(f"period_ticks: {self.period_ticks}, expected >= 2")
        steepest = float(self.amplitude.max()) * math.pi / self.period_ticks
        if not steepest <= self.slew_limit < math.inf:
            raise WhiskParameterError(
                f"slew_limit: {self.slew_limit} rad per tick, expected finite and "
                f">= {steepest:.6g}, the steepest change of the whisk itself"
            )

    def rows(self) -> Float64s:
        """The parameters as the first WHISK_ROWS rows of a law's parameter array."""
        rows = np.empty((WHISK_ROWS, WHISKERS), dtype=np.float64)
        rows[MINIMUM] = self.minimum
        rows[AMPLITUDE] = self.amplitude
        rows[PERIOD] = self.period_ticks
        rows[SLEW] = self.slew_limit
        return rows


def full_whisk(
    geometry: HeadGeometry, period_ticks: int = 2000, slew_limit: float = 0.005
) -> WhiskParams:
    """The paper's whisk: from the start angle through the whole protraction travel, 1 Hz."""
    return WhiskParams(np.zeros(WHISKERS), geometry.swing, period_ticks, slew_limit)


@compiled
def protraction_at(tick: int, period_ticks: int) -> float:
    """Share of the amplitude at `tick`: (1 - cos(2 pi phase)) / 2.

    phase = (tick mod period_ticks) / period_ticks, so cycle n starts at tick n * period_ticks.
    """
    return (1.0 - cos(TWO_PI * ((tick % period_ticks) / period_ticks))) / 2.0


@compiled
def desired_angle(minimum: float, amplitude: float, share: float) -> float:
    """Desired angle, rad: minimum + amplitude (1 - cos(2 pi phase)) / 2 (Salman and Pearson III E).

    share: `protraction_at` of the tick, the same for every whisker.
    """
    return minimum + amplitude * share
