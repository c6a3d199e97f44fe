"""Tactile images: what eighteen whiskers felt in one whisk cycle, as a picture of 3 x 6 pixels.

Source: Salman & Pearson, section III D: every whisker is a pixel, its intensity the height of the
obstacle at its tip, derived from the protraction angle either at the largest protraction of the
cycle (max angle) or at the moment of touch (contact angle). Row = ring (front, mid, rear), column =
whisker within the ring.

Which max-angle pixels count as an obstacle the paper does not say. Two rules, both in the output:
- gated: the whisker was in contact (deflection over its threshold) near the end of protraction;
- ungated: the whisker stopped more than half a degree short of where it stops in free air.
They differ with a stiff motor, which pushes on to the commanded angle whatever it touches: ungated
pixels then go blank, gated ones do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import compiled, cos

WHISKERS: Final = 18
RINGS: Final = 3
WHISKERS_PER_RING: Final = 6
HIGHEST_OBSTACLE: Final = 0.055
"""Tip height coded as 255, m: the tips' height at the start angle."""
NEAR_MAXIMUM: Final = math.radians(0.5)
FAST_FILTER: Final = 0.005
SLOW_FILTER: Final = 0.015
REFRACTORY: Final = 0.03
"""A crossing counts after this time below the threshold, s; every cycle begins with it."""

Image = NDArray[np.uint8]
Samples = NDArray[np.float32]
Floats = NDArray[np.float64]


class TactileError(ValueError):
    """Whisk cycle, geometry or calibration has the wrong shape or is not finite."""


@dataclass(frozen=True, slots=True)
class WhiskGeometry:
    """Where the tips are: arrays float64[18], whisker i = ring * 6 + k.

    pivot_height: base above the maze floor, m; length: shaft, m; phi_start: angle from straight
    down at protraction 0, rad. The tip of a straight shaft at protraction theta is
    pivot_height - length cos(phi_start - theta) above the floor.
    """

    pivot_height: Floats
    length: Floats
    phi_start: Floats


@dataclass(frozen=True, slots=True)
class WhiskCalibration:
    """Free whisking in air, float64[18] each.

    free_angle: largest protraction reached, rad. y_mean, y_threshold: mean deflection and the
    distance from it that is contact, N m. rate_mean, rate_threshold: the same for the band-passed
    deflection of `deflection_rate`.
    """

    free_angle: Floats
    y_mean: Floats
    y_threshold: Floats
    rate_mean: Floats
    rate_threshold: Floats


@dataclass(frozen=True, slots=True)
class TactileImages:
    """Images uint8[3, 6]: 0 = no obstacle, 1 .. 255 = tip height over [0, 55 mm].

    contact_mask: bit i set when whisker i touched something (its contact-angle pixel is not 0).
    """

    max_angle_gated: Image
    max_angle_ungated: Image
    contact_angle: Image
    contact_mask: int

    @property
    def mask_image(self) -> Image:
        """The contact mask as a picture, 0 or 255."""
        return np.where(self.contact_angle > 0, np.uint8(255), np.uint8(0))


class TactileImager:
    """Turns whisk cycles sampled every `dt` seconds into images; keeps no state between cycles."""

    def __init__(
        self, geometry: WhiskGeometry, calibration: WhiskCalibration, dt: float = 0.0005
    ) -> None:
        if not (math.isfinite(dt) and dt > 0.0):
            raise TactileError(f"tactile dt: expected a positive time in s, found {dt}")
        self._geometry = np.stack(
            [
                _whisker_array("pivot_height", geometry.pivot_height),
                _whisker_array("length", geometry.length),
                _whisker_array("phi_start", geometry.phi_start),
            ]
        )
        self._calibration = np.stack(
            [
                _whisker_array("free_angle", calibration.free_angle),
                _whisker_array("y_mean", calibration.y_mean),
                _whisker_array("y_threshold", calibration.y_threshold),
                _whisker_array("rate_mean", calibration.rate_mean),
                _whisker_array("rate_threshold", calibration.rate_threshold),
            ]
        )
        self._fast, self._slow = _gains(dt)
        self._refractory = math.ceil(REFRACTORY / dt)

    def image(self, theta: Samples, x: Samples, y: Samples) -> TactileImages:
        """Images of one cycle: protraction theta (rad), deflections x, y (N m), float32[n, 18].

        Raises TactileError for a wrong shape, an empty cycle, or a sample that is not finite.
        """
        for name, array in (("theta", theta), ("x", x), ("y", y)):
            if array.dtype != np.float32 or array.ndim != 2 or array.shape[1] != WHISKERS:
                raise TactileError(
                    f"whisk cycle {name}: expected float32[n, {WHISKERS}],"
                    f" found {array.dtype}{list(array.shape)}"
                )
            if array.shape != theta.shape or len(array) == 0:
                raise TactileError(
                    f"whisk cycle {name}: expected {max(len(theta), 1)} samples, found {len(array)}"
                )
        pixels = np.zeros((3, WHISKERS), dtype=np.uint8)
        bad = _image(
            np.ascontiguousarray(theta),
            np.ascontiguousarray(x),
            np.ascontiguousarray(y),
            self._geometry,
            self._calibration,
            self._fast,
            self._slow,
            self._refractory,
            pixels,
        )
        if bad >= 0:
            raise TactileError(
                f"whisk cycle sample {bad // WHISKERS}, whisker {bad % WHISKERS}:"
                " expected finite numbers, found NaN or infinity"
            )
        shape = (RINGS, WHISKERS_PER_RING)
        mask = sum(1 << i for i in range(WHISKERS) if pixels[2, i] > 0)
        return TactileImages(
            pixels[0].reshape(shape), pixels[1].reshape(shape), pixels[2].reshape(shape), mask
        )


def deflection_rate(y: Samples, dt: float = 0.0005) -> Floats:
    """The smoothed derivative the contact detector looks at, float64[n, 18], N m.

    The difference of two first-order low-pass filters, 5 ms and 15 ms, both started at the first
    sample; for slow signals 10 ms times the derivative. y: deflection float32[n, 18], N m.
    """
    fast, slow = _gains(dt)
    return _rates(np.ascontiguousarray(y), fast, slow)


def calibrate(
    theta: Samples,
    y: Samples,
    dt: float = 0.0005,
    y_sigmas: float = 20.0,
    rate_sigmas: float = 8.0,
) -> WhiskCalibration:
    """Calibration from whisking in free air: thresholds as multiples of the standard deviation.

    theta, y: float32[n, 18] over whole cycles, without gaps. The paper takes twenty standard
    deviations for the deflection.
    Raises TactileError for a wrong shape, an empty recording, or a sample that is not finite.
    """
    if theta.shape != y.shape or theta.ndim != 2 or theta.shape[1] != WHISKERS or len(y) == 0:
        raise TactileError(
            f"calibration: expected theta and y of shape (n, {WHISKERS}),"
            f" found {theta.shape} and {y.shape}"
        )
    if not (np.isfinite(theta).all() and np.isfinite(y).all()):
        raise TactileError("calibration: expected finite numbers, found NaN or infinity")
    deflection = y.astype(np.float64)
    rate = deflection_rate(y, dt)
    return WhiskCalibration(
        free_angle=theta.astype(np.float64).max(axis=0),
        y_mean=deflection.mean(axis=0),
        y_threshold=y_sigmas * deflection.std(axis=0),
        rate_mean=rate.mean(axis=0),
        rate_threshold=rate_sigmas * rate.std(axis=0),
    )


def _gains(dt: float) -> tuple[float, float]:
    """Per-sample gains of the two low-pass filters (backward Euler)."""
    return dt / (FAST_FILTER + dt), dt / (SLOW_FILTER + dt)


def _whisker_array(name: str, values: ArrayLike) -> Floats:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.shape != (WHISKERS,) or not np.isfinite(array).all():
        raise TactileError(f"{name}: expected {WHISKERS} finite numbers, found {values!r:.60}")
    return array


@compiled
def _rates(y: Samples, fast: float, slow: float) -> Floats:
    n, whiskers = y.shape
    rates = np.empty((n, whiskers))
    for i in range(whiskers):
        quick = float(y[0, i])
        lazy = float(y[0, i])
        for s in range(n):
            quick += fast * (y[s, i] - quick)
            lazy += slow * (y[s, i] - lazy)
            rates[s, i] = quick - lazy
    return rates


@compiled
def _pixel(theta: float, pivot_height: float, length: float, phi_start: float) -> int:
    """Tip height at protraction theta, coded 1 .. 255."""
    height = pivot_height - length * cos(phi_start - theta)
    level: float = min(max(height / HIGHEST_OBSTACLE, 0.0), 1.0)
    return 1 + int(254.0 * level + 0.5)


@compiled
def _image(
    theta: Samples,
    x: Samples,
    y: Samples,
    geometry: Floats,
    calibration: Floats,
    fast: float,
    slow: float,
    refractory: int,
    pixels: NDArray[np.uint8],
) -> int:
    """Fill pixels uint8[3, 18] (gated, ungated, contact angle); -1, or the first bad sample."""
    n: int = theta.shape[0]
    whiskers = WHISKERS
    largest = np.empty(whiskers)
    touching = np.empty(whiskers)
    touched = np.empty(whiskers)
    quiet_since = np.zeros(whiskers, dtype=np.int64)
    quick = np.empty(whiskers)
    lazy = np.empty(whiskers)
    for i in range(whiskers):
        largest[i] = -np.inf
        touching[i] = -np.inf
        touched[i] = np.nan
        quick[i] = y[0, i]
        lazy[i] = y[0, i]
    for s in range(n):
        for i in range(whiskers):
            angle = float(theta[s, i])
            deflection = float(y[s, i])
            if not (math.isfinite(angle) and math.isfinite(deflection) and math.isfinite(x[s, i])):
                return s * whiskers + i
            largest[i] = max(largest[i], angle)
            if abs(deflection - calibration[1, i]) > calibration[2, i]:
                touching[i] = max(touching[i], angle)
            quick[i] += fast * (deflection - quick[i])
            lazy[i] += slow * (deflection - lazy[i])
            if abs(quick[i] - lazy[i] - calibration[3, i]) > calibration[4, i]:
                if s - quiet_since[i] >= refractory and math.isnan(touched[i]):
                    touched[i] = angle
                quiet_since[i] = s + 1
    for i in range(whiskers):
        height, length, start = geometry[0, i], geometry[1, i], geometry[2, i]
        if touching[i] >= largest[i] - NEAR_MAXIMUM:
            pixels[0, i] = _pixel(largest[i], height, length, start)
        if largest[i] < calibration[0, i] - NEAR_MAXIMUM:
            pixels[1, i] = _pixel(largest[i], height, length, start)
        if not math.isnan(touched[i]):
            pixels[2, i] = _pixel(touched[i], height, length, start)
    return -1
