"""Thresholds from free whisking, and the refusal of a calibration that touched something.

The mean, the noise and every threshold come from whisker signals recorded while the whiskers whisk
in the air, so that weight, inertia and bias belong to the calibration. A whisker that touches
something meanwhile would raise its own threshold and go blind; such a calibration is refused.

Touch is told from the signals alone. Signals are averaged over blocks of 10 ms, which leaves of
white noise about a fifth, and three things are checked in x and in y of every whisker:

    excursion     a block mean leaves the whisker's own median block mean, by more than the inertia
                  of the whisker explains at the whisk's largest acceleration
    offset        the whisker's median leaves the median of its ring, of those without excursion
                  (a whisker pressed against a wall all the time; weight is the same for all six)
    ring offset   that median of the ring leaves zero (the whole ring pressed)

The noise that scales the first limit is measured from second differences within blocks, which
neither weight nor a sustained touch moves, and is the median over the blocks and the ring.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vibrissa.control.kinematics import (
    PER_RING,
    RINGS,
    WHISKERS,
    Float32s,
    Float64s,
    HeadGeometry,
    per_whisker,
    whisker_name,
)
from vibrissa.numerics import compiled, exp

BLOCK = 20  # ticks, 10 ms
THRESHOLD_SIGMAS = 20.0  # of y (Salman and Pearson III E)
DERIVATIVE_SIGMAS = 8.0
TICK_MS = 0.5
FAST_MS, SLOW_MS = 5.0, 15.0  # time constants of the derivative channel
CHANNELS = ("x", "y")
INERTIA = 1.5e-4
"""kg, a whisker's moment of inertia about its base over the cube of its length, at most."""

# rows of the accumulator, float64[ROWS, 2 channels, 18]
MEAN, SQUARES, PREVIOUS, BEFORE, BLOCK_SUM, BLOCK_ROUGHNESS = range(6)
ROWS = 6
# rows of the derivative accumulator, float64[D_ROWS, 18]
FAST, SLOW, D_MEAN, D_SQUARES = range(4)
D_ROWS = 4


class CalibrationError(ValueError):
    """Free whisking that yields no calibration."""


class TouchedDuringCalibration(CalibrationError):
    """A whisker touched something, so this was not free whisking."""


class DeadChannel(CalibrationError):
    """A deflection channel never changed its value."""


class NonFiniteSample(CalibrationError):
    """A deflection sample is NaN or infinite."""


class TooFewSamples(CalibrationError):
    """The calibration was asked for its result before all cycles were seen."""


@dataclass(frozen=True)
class TouchLimits:
    """What free whisking can't explain.

    noise_multiple  excursion limit in standard deviations of the ring's white noise
    excursion       N m, the excursion limit is never smaller than this; above the change of the
                    weight's moment over the whisk (0.02 mN m for a tapered 160 mm whisker)
    offset          N m, limit of a whisker's median against its ring
    ring_offset     N m, limit of the ring's median; above the weight's moment (0.1 mN m)
    """

    noise_multiple: float = 6.0
    excursion: float = 5e-5
    offset: float = 8e-5
    ring_offset: float = 5e-4


def inertial_moment(geometry: HeadGeometry, period_ticks: int) -> Float64s:
    """What a whisker's own inertia makes of the whisk, at most: float64[18], N m.

    INERTIA length^3 times the largest acceleration of the whisk, swing / 2 (2 pi / period)^2.
    """
    rate = 2.0 * math.pi * 1000.0 / (period_ticks * TICK_MS)
    cube = geometry.length * geometry.length * geometry.length
    moment: Float64s = INERTIA * cube * (geometry.swing / 2.0 * rate * rate)
    return moment


@dataclass(frozen=True, eq=False)
class Calibration:
    """What free whisking looks like; arrays are read-only float64[18], finite, N m.

    mean_y, sigma_y  mean and standard deviation of y
    threshold_y      20 sigma_y: touch is |y - mean_y| > threshold_y
    mean_dy          mean of the derivative channel dy
    threshold_dy     8 standard deviations of dy: contact begins when |dy - mean_dy| > threshold_dy
    samples          number of samples behind the figures

    dy(t) = f(t) - s(t), the difference of two first-order low-passes of y that start at the first
    sample: f += (y - f) (1 - exp(-0.5 ms / 5 ms)), s += (y - s) (1 - exp(-0.5 ms / 15 ms)).

    Raises CalibrationError.
    """

    mean_y: Float64s
    sigma_y: Float64s
    threshold_y: Float64s
    mean_dy: Float64s
    threshold_dy: Float64s
    samples: int

    def __post_init__(self) -> None:
        for name in ("mean_y", "sigma_y", "threshold_y", "mean_dy", "threshold_dy"):
            values = per_whisker(getattr(self, name), f"calibration {name}", CalibrationError)
            object.__setattr__(self, name, values)


@compiled
def _accumulate(
    x: Float64s,
    y: Float64s,
    seen: int,
    fast: float,
    slow: float,
    moments: Float64s,
    derivative: Float64s,
    block_mean: Float64s,
    block_noise: Float64s,
) -> None:
    """Add the samples x, y float64[n, 18], the first of which is number `seen` (from 0)."""
    for j in range(x.shape[0]):
        count = seen + j + 1
        for c in range(2):
            for i in range(WHISKERS):
                value = x[j, i] if c == 0 else y[j, i]
                m = moments[:, c, i]
                away = value - m[MEAN]
                m[MEAN] += away / count
                m[SQUARES] += away * (value - m[MEAN])
                if count > 2:
                    bend = value - 2.0 * m[PREVIOUS] + m[BEFORE]
                    m[BLOCK_ROUGHNESS] += bend * bend
                m[BEFORE] = m[PREVIOUS]
                m[PREVIOUS] = value
                m[BLOCK_SUM] += value
                if count % BLOCK == 0:
                    block = count // BLOCK - 1
                    block_mean[c, i, block] = m[BLOCK_SUM] / BLOCK
                    # white noise of variance v has second differences of variance 6 v
                    block_noise[c, i, block] = math.sqrt(m[BLOCK_ROUGHNESS] / (6.0 * BLOCK))
                    m[BLOCK_SUM] = 0.0
                    m[BLOCK_ROUGHNESS] = 0.0
        for i in range(WHISKERS):
            d = derivative[:, i]
            if count == 1:
                d[FAST] = y[j, i]
                d[SLOW] = y[j, i]
            d[FAST] += (y[j, i] - d[FAST]) * fast
            d[SLOW] += (y[j, i] - d[SLOW]) * slow
            slope = d[FAST] - d[SLOW]
            away = slope - d[D_MEAN]
            d[D_MEAN] += away / count
            d[D_SQUARES] += away * (slope - d[D_MEAN])


class Calibrator:
    """Collects `cycles` whole whisk cycles of free whisking, one sample or one block at a time.

    inertial: float64[18] N m, how much further than its limit an excursion may go because the
    whisker is accelerated (`inertial_moment`); none by default. Blocks and single samples give the
    same bits. Raises CalibrationError for a calibration of no cycle or of cycles shorter than one
    averaging block.
    """

    def __init__(
        self,
        cycles: int = 12,
        period_ticks: int = 2000,
        limits: TouchLimits | None = None,
        inertial: Float64s | float = 0.0,
    ) -> None:
        if cycles < 1:
            raise CalibrationError(f"calibration: {cycles} cycles, expected >= 1")
        if period_ticks < BLOCK:
            raise CalibrationError(f"calibration: period {period_ticks} ticks, expected >= {BLOCK}")
        self.needed = cycles * period_ticks
        self.seen = 0
        self._limits = limits or TouchLimits()
        self._inertial = per_whisker(inertial, "inertial", CalibrationError)
        self._fast = 1.0 - exp(-TICK_MS / FAST_MS)
        self._slow = 1.0 - exp(-TICK_MS / SLOW_MS)
        self._moments = np.zeros((ROWS, len(CHANNELS), WHISKERS), dtype=np.float64)
        self._derivative = np.zeros((D_ROWS, WHISKERS), dtype=np.float64)
        blocks = (len(CHANNELS), WHISKERS, self.needed // BLOCK)
        self._block_mean = np.zeros(blocks, dtype=np.float64)
        self._block_noise = np.zeros(blocks, dtype=np.float64)
        self._add(np.empty((0, WHISKERS)), np.empty((0, WHISKERS)))  # compiles before tick 0
        self.mark()

    def mark(self) -> None:
        """Remember this moment for `back`; the beginning is remembered already."""
        self._marked = self.seen, self._moments.copy(), self._derivative.copy()

    def back(self) -> None:
        """Forget the samples since the mark: they were no free whisking."""
        self.seen = self._marked[0]
        self._moments[:], self._derivative[:] = self._marked[1:]

    @property
    def complete(self) -> bool:
        """True when all cycles have been seen."""
        return self.seen == self.needed

    def update(self, x: Float32s, y: Float32s) -> None:
        """Add samples x, y of shape [18] or [n, 18], N m.

        Raises NonFiniteSample, or CalibrationError when shapes differ or more samples come than the
        calibration has; nothing of a refused call is added.
        """
        if x.shape != y.shape or x.ndim not in (1, 2) or x.shape[-1] != WHISKERS:
            raise CalibrationError(
                f"calibration: expected x and y of one shape (18,) or (n, 18), "
                f"found {x.shape} and {y.shape}"
            )
        signals = [np.array(s, dtype=np.float64).reshape(-1, WHISKERS) for s in (x, y)]
        if self.seen + len(signals[0]) > self.needed:
            raise CalibrationError(
                f"calibration: sample {self.seen + len(signals[0])} of {self.needed}, "
                "it was complete before"
            )
        for channel, signal in zip(CHANNELS, signals, strict=True):
            finite = np.isfinite(signal)
            if not finite.all():
                j, i = (int(index) for index in np.argwhere(~finite)[0])
                raise NonFiniteSample(
                    f"calibration: {whisker_name(i)} {channel} is {signal[j, i]} "
                    f"at sample {self.seen + j}, expected a finite moment"
                )
        self._add(*signals)

    def _add(self, x: Float64s, y: Float64s) -> None:
        _accumulate(
            x,
            y,
            self.seen,
            self._fast,
            self._slow,
            self._moments,
            self._derivative,
            self._block_mean,
            self._block_noise,
        )
        self.seen += len(x)

    def result(self) -> Calibration:
        """The calibration. Raises TooFewSamples, DeadChannel or TouchedDuringCalibration."""
        if not self.complete:
            raise TooFewSamples(
                f"calibration: {self.seen} samples, expected {self.needed} of free whisking"
            )
        self._refuse_dead_channels()
        self._refuse_touch()
        sigma_y = np.sqrt(self._moments[SQUARES, 1] / (self.seen - 1))
        sigma_dy = np.sqrt(self._derivative[D_SQUARES] / (self.seen - 1))
        return Calibration(
            mean_y=self._moments[MEAN, 1],
            sigma_y=sigma_y,
            threshold_y=THRESHOLD_SIGMAS * sigma_y,
            mean_dy=self._derivative[D_MEAN],
            threshold_dy=DERIVATIVE_SIGMAS * sigma_dy,
            samples=self.seen,
        )

    def _refuse_dead_channels(self) -> None:
        dead = [
            f"{whisker_name(i)} {channel} stayed at {self._moments[MEAN, c, i]:.4g} N m"
            for c, channel in enumerate(CHANNELS)
            for i in range(WHISKERS)
            if self._moments[SQUARES, c, i] == 0.0
        ]
        if dead:
            raise DeadChannel(f"calibration: dead channel: {'; '.join(dead)}, expected noise")

    def _refuse_touch(self) -> None:
        limits = self._limits
        touched: dict[int, tuple[float, str]] = {}  # whisker -> value over limit, what was found

        def judge(whisker: int, channel: str, what: str, value: float, limit: float) -> None:
            ratio = abs(value) / limit
            if ratio > 1.0 and ratio > touched.get(whisker, (0.0, ""))[0]:
                found = f"{channel} {what} {value:.4g} N m, limit {limit:.4g}"
                touched[whisker] = ratio, f"{whisker_name(whisker)} {found}"

        median = np.median(self._block_mean, axis=2)
        noise = np.median(self._block_noise, axis=2)
        rings = [range(r * PER_RING, (r + 1) * PER_RING) for r in range(len(RINGS))]
        for c, channel in enumerate(CHANNELS):
            for ring in rings:
                sigma = float(np.median(noise[c, ring]))
                least = max(limits.noise_multiple * sigma, limits.excursion)
                for i in ring:
                    limit = least + float(self._inertial[i])
                    away = self._block_mean[c, i] - median[c, i]
                    excursion = float(away[int(np.abs(away).argmax())])
                    judge(i, channel, "excursion", excursion, limit)
        steady = [[i for i in ring if i not in touched] for ring in rings]
        for c, channel in enumerate(CHANNELS):
            for members in filter(None, steady):
                center = float(np.median(median[c, members]))
                for i in members:
                    offset = float(median[c, i]) - center
                    judge(i, channel, "offset from its ring", offset, limits.offset)
                    judge(i, channel, "offset of the ring", center, limits.ring_offset)
        if touched:
            findings = "; ".join(touched[i][1] for i in sorted(touched))
            raise TouchedDuringCalibration(f"calibration: touched, not free: {findings}")
