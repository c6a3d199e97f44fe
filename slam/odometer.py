"""How far an odometer can be trusted: its scatter on a straight and on a turn in place."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.slam.interface import SlamInputError

LEAST_STEPS: Final = 8
"""Steps of a calibration segment below which its scatter says nothing."""
STILL: Final = 0.05
"""Share of the largest motion below which there is none."""
LEAST_WAY: Final = 1e-4
LEAST_TURN: Final = 1e-3
"""m and rad per step below which nothing moved."""


@dataclass(frozen=True, slots=True)
class OdometerNoise:
    """Standard deviations of one step: sqrt(a^2 + (b motion)^2) for distance (m) and turn (rad).

    `distance`, `turn`: the part a, m and rad, > 0; `distance_share`, `turn_share`: the part b.
    Raises SlamInputError for values that are not finite or out of range.
    """

    distance: float = 0.003
    distance_share: float = 0.1
    turn: float = 0.02
    turn_share: float = 0.1

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            least = 0.0 if field.name.endswith("share") else math.ulp(0.0)
            if not (math.isfinite(value) and value >= least):
                raise SlamInputError(
                    f"odometer {field.name}: expected a finite number"
                    f" {'>=' if least == 0.0 else '>'} 0, found {value}"
                )

    def sigmas(self, distance: float, turn: float) -> tuple[float, float]:
        """Standard deviations (m, rad) of a step of that distance and turn."""
        d, w = self.distance_share * distance, self.turn_share * turn
        return (
            math.sqrt(self.distance * self.distance + d * d),
            math.sqrt(self.turn * self.turn + w * w),
        )


FLOOR: Final = OdometerNoise(2e-4, 0.0, 2e-3, 0.0)
"""The least that is believed of an odometer: nothing is exact."""


def calibrated(straight: ArrayLike, turn: ArrayLike) -> OdometerNoise:
    """The noise of an odometer from its own readings, without ground truth.

    straight, turn: float[n, 2], distance (m) and turn (rad) of successive equal steps, driven
    straight ahead and turned on the spot at an even pace. The scatter of distances on the spot is
    the constant part, what a straight adds to it grows with distance; alike for turns.
    Raises SlamInputError for fewer than 8 steps, numbers that are not finite, a straight without
    way and a turn without turn.
    """
    straight_mean, straight_var = _moments("straight", straight)
    turn_mean, turn_var = _moments("turn", turn)
    if straight_mean[0] == 0.0:
        raise SlamInputError("odometer straight: expected some way per step, found 0 m")
    if turn_mean[1] == 0.0:
        raise SlamInputError("odometer turn: expected some turn per step, found 0 rad")
    return _noise(straight_var, abs(float(straight_mean[0])), turn_var, abs(float(turn_mean[1])))


def calibrated_against(felt: ArrayLike, true: ArrayLike) -> tuple[OdometerNoise, int, int]:
    """The noise of an odometer whose steps are known, and how many were on a straight and a turn.

    felt, true: float64[n, 2], distance (m) and turn (rad) of every step, as the odometer says and
    as they were. Steps straight ahead and steps on the spot are picked by what they were; the
    others say nothing. Errors count from the truth, so that a steady error is noise as well.
    Raises SlamInputError for numbers that are not finite and fewer than 8 steps of a kind.
    """
    said, was = np.asarray(felt, dtype=np.float64), np.asarray(true, dtype=np.float64)
    if said.ndim != 2 or said.shape[1:] != (2,) or was.shape != said.shape:
        raise SlamInputError(
            f"odometer: expected float64[n, 2] twice, found shapes {said.shape} and {was.shape}"
        )
    if not (np.isfinite(said).all() and np.isfinite(was).all()):
        raise SlamInputError("odometer: expected finite numbers, found NaN or infinity")
    way, turn = np.abs(was).T
    longest, widest = way.max(initial=LEAST_WAY), turn.max(initial=LEAST_TURN)
    straights = (turn <= STILL * widest) & (way >= 0.5 * longest)
    turns = (way <= STILL * longest) & (turn >= 0.5 * widest)
    for kind, chosen in (("straight ahead", straights), ("turning in place", turns)):
        if (count := int(chosen.sum())) < LEAST_STEPS:
            raise SlamInputError(
                f"odometer: expected at least {LEAST_STEPS} whisks {kind}, found {count}"
            )
    error = np.square(said - was)
    found = _noise(
        error[straights].mean(axis=0),
        math.sqrt(float(np.square(way[straights]).mean())),
        error[turns].mean(axis=0),
        math.sqrt(float(np.square(turn[turns]).mean())),
    )
    return found, int(straights.sum()), int(turns.sum())


def _noise(
    straight: NDArray[np.float64], way: float, turn: NDArray[np.float64], angle: float
) -> OdometerNoise:
    """From variances (distance, turn) of steps of `way` m straight ahead, `angle` rad in place."""
    distance_var = max(straight[0] - turn[0], 0.0)
    angle_var = max(turn[1] - straight[1], 0.0)
    return OdometerNoise(
        distance=max(math.sqrt(turn[0]), FLOOR.distance),
        distance_share=math.sqrt(distance_var) / way,
        turn=max(math.sqrt(straight[1]), FLOOR.turn),
        turn_share=math.sqrt(angle_var) / angle,
    )


def _moments(name: str, steps: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    array = np.asarray(steps, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < LEAST_STEPS:
        raise SlamInputError(
            f"odometer {name}: expected at least {LEAST_STEPS} steps of (distance, turn),"
            f" found shape {array.shape}"
        )
    if not np.isfinite(array).all():
        raise SlamInputError(f"odometer {name}: expected finite numbers, found NaN or infinity")
    return array.mean(axis=0), array.var(axis=0, ddof=1)
