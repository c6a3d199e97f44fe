import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vibrissa.control.calibration import (
    BLOCK,
    INERTIA,
    Calibration,
    CalibrationError,
    Calibrator,
    DeadChannel,
    NonFiniteSample,
    TooFewSamples,
    TouchedDuringCalibration,
    inertial_moment,
)
from vibrissa.control.kinematics import PER_RING, WHISKERS, paper_head

CYCLES, PERIOD = 3, 400
SAMPLES = CYCLES * PERIOD
HEAD = paper_head()
SIGMA = 1e-5  # N m
WEIGHT = np.repeat([2e-6, 3e-5, 9e-5], PER_RING)  # N m, moment of a horizontal whisker
Signal = NDArray[np.float64]


def free_whisking(
    seed: int = 0, sigma: float = SIGMA, weight: float = 1.0
) -> tuple[Signal, Signal]:
    """x and y float64[SAMPLES, 18] of whiskers that touch nothing: noise and their weight."""
    rng = np.random.default_rng(seed)
    x = rng.normal(0.0, sigma, (SAMPLES, WHISKERS))
    y = rng.normal(0.0, sigma, (SAMPLES, WHISKERS))
    phase = np.arange(SAMPLES)[:, None] / PERIOD
    phi = HEAD.phi_start - HEAD.swing * (1 - np.cos(2 * math.pi * phase)) / 2
    return x, y - weight * WEIGHT * np.sin(phi)


def calibrate(x: Signal, y: Signal) -> Calibration:
    calibrator = Calibrator(CYCLES, PERIOD)
    calibrator.update(x.astype(np.float32), y.astype(np.float32))
    return calibrator.result()


def test_mean_and_sigma_are_those_of_the_samples() -> None:
    x, y = free_whisking()
    y = y.astype(np.float32).astype(np.float64)
    found = calibrate(x, y)
    assert found.samples == SAMPLES
    assert np.allclose(found.mean_y, y.mean(axis=0), rtol=1e-12, atol=0)
    assert np.allclose(found.sigma_y, y.std(axis=0, ddof=1), rtol=1e-10, atol=0)
    assert np.allclose(found.threshold_y, 20 * y.std(axis=0, ddof=1), rtol=1e-10, atol=0)


def test_derivative_threshold_is_eight_sigma_of_the_difference_of_low_passes() -> None:
    x, y = free_whisking()
    y = y.astype(np.float32).astype(np.float64)
    fast, slow = y[0].copy(), y[0].copy()
    dy = np.empty_like(y)
    for t in range(SAMPLES):
        fast += (y[t] - fast) * (1 - math.exp(-0.5 / 5))
        slow += (y[t] - slow) * (1 - math.exp(-0.5 / 15))
        dy[t] = fast - slow
    found = calibrate(x, y)
    assert np.allclose(found.mean_dy, dy.mean(axis=0), rtol=0, atol=1e-12 * SIGMA)
    assert np.allclose(found.threshold_dy, 8 * dy.std(axis=0, ddof=1), rtol=1e-9, atol=0)
    assert (np.abs(dy - found.mean_dy) < found.threshold_dy).all()


def test_the_weight_of_the_whisker_belongs_to_the_calibration() -> None:
    x, y = free_whisking()
    with_weight, without = calibrate(x, y), calibrate(*free_whisking(weight=0.0))
    rear = slice(12, 18)
    assert (with_weight.sigma_y[rear] > 1.1 * without.sigma_y[rear]).all()
    assert (with_weight.mean_y[rear] < -4e-5).all()


@given(cuts=st.lists(st.integers(1, SAMPLES - 1), max_size=6))
@settings(max_examples=15, deadline=None)
def test_samples_and_blocks_give_the_same_bits(cuts: list[int]) -> None:
    x, y = (signal.astype(np.float32) for signal in free_whisking())
    expected = calibrate(x, y)
    by_block, by_sample = Calibrator(CYCLES, PERIOD), Calibrator(CYCLES, PERIOD)
    for a, b in zip([0, *sorted(cuts)], [*sorted(cuts), SAMPLES], strict=True):
        by_block.update(x[a:b], y[a:b])
    for t in range(SAMPLES):
        assert not by_sample.complete
        by_sample.update(x[t], y[t])
    assert by_sample.complete
    for found in (by_block.result(), by_sample.result()):
        for name in ("mean_y", "sigma_y", "threshold_y", "mean_dy", "threshold_dy"):
            assert getattr(found, name).tobytes() == getattr(expected, name).tobytes()


def test_samples_since_the_mark_can_be_forgotten() -> None:
    x, y = (signal.astype(np.float32) for signal in free_whisking())
    expected = calibrate(x, y)
    calibrator = Calibrator(CYCLES, PERIOD)
    at = 3 * PERIOD // 2
    for a, b in ((0, at), (at, SAMPLES)):
        calibrator.mark()
        calibrator.update(x[a:b] + 1.0, y[a:b] - 1.0)
        calibrator.back()
        assert calibrator.seen == a
        calibrator.update(x[a:b], y[a:b])
    for name in ("mean_y", "sigma_y", "threshold_y", "mean_dy", "threshold_dy"):
        assert getattr(calibrator.result(), name).tobytes() == getattr(expected, name).tobytes()


@given(
    seed=st.integers(0, 10**6),
    sigma=st.floats(1e-7, 1e-4),
    weight=st.floats(0.0, 2.0),
)
@settings(max_examples=60, deadline=None)
def test_free_whisking_is_never_refused(seed: int, sigma: float, weight: float) -> None:
    assert calibrate(*free_whisking(seed, sigma, weight)).samples == SAMPLES


@given(
    seed=st.integers(0, 10**6),
    whisker=st.integers(0, WHISKERS - 1),
    channel=st.integers(0, 1),
    moment=st.floats(1e-4, 1e-2),
    side=st.sampled_from([-1, 1]),
    onset=st.integers(0, SAMPLES - 2 * BLOCK),
    ticks=st.integers(2 * BLOCK, SAMPLES),
)
@settings(max_examples=80, deadline=None)
def test_a_touch_of_20_ms_or_longer_is_refused_and_named(
    seed: int, whisker: int, channel: int, moment: float, side: int, onset: int, ticks: int
) -> None:
    signals = free_whisking(seed)
    signals[channel][onset : onset + ticks, whisker] += side * moment
    with pytest.raises(TouchedDuringCalibration) as refusal:
        calibrate(*signals)
    message = str(refusal.value)
    ring = ("front", "mid", "rear")[whisker // PER_RING]
    assert f"whisker {whisker} ({ring} ring) {'xy'[channel]} " in message
    assert "limit" in message
    assert message.count("whisker ") == 1
    assert "\n" not in message


@given(pressed=st.sets(st.integers(6, 11), min_size=1, max_size=2), moment=st.floats(1e-4, 1e-2))
@settings(max_examples=20, deadline=None)
def test_whiskers_pressed_against_a_wall_all_the_time_are_refused(
    pressed: set[int], moment: float
) -> None:
    x, y = free_whisking()
    for i in pressed:
        x[:, i] += moment
    with pytest.raises(TouchedDuringCalibration, match="x offset from its ring") as refusal:
        calibrate(x, y)
    named = {i for i in range(WHISKERS) if f"whisker {i} (" in str(refusal.value)}
    assert named == pressed


def test_whiskers_that_touch_nothing_are_not_named_beside_those_that_do() -> None:
    x, y = free_whisking()
    y[SAMPLES // 4 :, 6:10] += 2e-3  # four of six: the median of all six would be theirs
    with pytest.raises(TouchedDuringCalibration) as refusal:
        calibrate(x, y)
    named = {i for i in range(WHISKERS) if f"whisker {i} (" in str(refusal.value)}
    assert named == {6, 7, 8, 9}


def test_a_whole_ring_pressed_is_refused() -> None:
    x, y = free_whisking()
    y[:, 12:] += 1e-3
    with pytest.raises(TouchedDuringCalibration, match=r"whisker 12 .* y offset of the ring"):
        calibrate(x, y)


@pytest.mark.parametrize(("channel", "name"), [(0, "x"), (1, "y")])
def test_a_dead_channel_is_refused(channel: int, name: str) -> None:
    signals = free_whisking()
    signals[channel][:, 7] = 1e-5
    with pytest.raises(
        DeadChannel, match=rf"dead channel: whisker 7 \(mid ring\) {name} stayed at 1e-05 N m"
    ):
        calibrate(*signals)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_sample_that_is_not_finite_is_refused_before_anything_changes(value: float) -> None:
    x, y = (signal.astype(np.float32) for signal in free_whisking())
    expected = calibrate(x, y)
    calibrator = Calibrator(CYCLES, PERIOD)
    calibrator.update(x[:100], y[:100])
    bad = y[100:200].copy()
    bad[30, 17] = value
    with pytest.raises(NonFiniteSample, match=r"whisker 17 \(rear ring\) y is .* at sample 130"):
        calibrator.update(x[100:200], bad)
    calibrator.update(x[100:], y[100:])
    assert calibrator.result().sigma_y.tobytes() == expected.sigma_y.tobytes()


def test_an_unfinished_calibration_has_no_result() -> None:
    calibrator = Calibrator(CYCLES, PERIOD)
    x, y = (signal.astype(np.float32) for signal in free_whisking())
    calibrator.update(x[:-1], y[:-1])
    with pytest.raises(TooFewSamples, match="1199 samples, expected 1200"):
        calibrator.result()
    calibrator.update(x[-1], y[-1])
    with pytest.raises(CalibrationError, match="sample 1201 of 1200"):
        calibrator.update(x[0], y[0])
    assert calibrator.result().samples == SAMPLES


@pytest.mark.parametrize(
    ("x", "y"),
    [((18,), (17,)), ((17,), (17,)), ((2, 18), (3, 18)), ((1, 1, 18), (1, 1, 18)), ((), ())],
)
def test_signals_of_another_shape_are_refused(x: tuple[int, ...], y: tuple[int, ...]) -> None:
    with pytest.raises(CalibrationError, match=r"expected x and y of one shape \(18,\) or"):
        Calibrator(CYCLES, PERIOD).update(np.zeros(x, np.float32), np.zeros(y, np.float32))


def test_impossible_calibrations_are_refused() -> None:
    with pytest.raises(CalibrationError, match="0 cycles"):
        Calibrator(0, PERIOD)
    with pytest.raises(CalibrationError, match="period 19 ticks, expected >= 20"):
        Calibrator(1, 19)
    nothing = np.zeros(WHISKERS)
    with pytest.raises(CalibrationError, match=r"threshold_y: whisker 0 .* is nan"):
        Calibration(nothing, nothing, nothing * np.nan, nothing, nothing, 1)


def accelerated(period_ticks: int) -> NDArray[np.float64]:
    """What heavy but permitted whiskers' inertia makes of two cycles of the full whisk, N m."""
    head = paper_head()
    phase = 2.0 * math.pi * np.arange(2 * period_ticks) / period_ticks
    rate = 2.0 * math.pi * 2000.0 / period_ticks
    inertia = 0.8 * INERTIA * head.length**3
    moment: NDArray[np.float64] = np.cos(phase)[:, None] * inertia * head.swing / 2.0 * rate**2
    return moment


@pytest.mark.parametrize("period", [400, 800, 2000])
def test_the_inertia_of_fast_whisking_is_no_touch(period: int) -> None:
    noise = np.random.default_rng(period).normal(0.0, 1e-5, (2, 2 * period, WHISKERS))
    x, y = noise[0], noise[1] + accelerated(period)
    fast = Calibrator(2, period, inertial=inertial_moment(paper_head(), period))
    fast.update(x.astype(np.float32), y.astype(np.float32))
    assert (fast.result().threshold_y > 0.0).all()


def test_a_touch_in_fast_whisking_is_still_refused() -> None:
    period = 400
    noise = np.random.default_rng(1).normal(0.0, 1e-5, (2, 2 * period, WHISKERS))
    x, y = noise[0], noise[1] + accelerated(period)
    y[300:360, 13] += 6e-4
    fast = Calibrator(2, period, inertial=inertial_moment(paper_head(), period))
    fast.update(x.astype(np.float32), y.astype(np.float32))
    with pytest.raises(TouchedDuringCalibration, match=r"whisker 13 \(rear ring\) y excursion"):
        fast.result()
