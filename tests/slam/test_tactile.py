"""Tactile images: heights, the two kinds of image, their gates, and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vibrissa.slam.tactile import (
    TactileError,
    TactileImager,
    WhiskCalibration,
    WhiskGeometry,
    calibrate,
    deflection_rate,
)

DT = 0.0005
SAMPLES = 2000
PIVOT = np.repeat([0.087, 0.107, 0.127], 6)
LENGTH = np.repeat([0.050, 0.110, 0.160], 6)
PHI_START = np.radians(np.repeat([50.2, 61.8, 63.3], 6))
SWING = np.radians(np.repeat([50.2, 38.5, 22.4], 6))
GEOMETRY = WhiskGeometry(PIVOT, LENGTH, PHI_START)
NOISE = 1e-5


def free_whisk(seed=0, cycles=1):
    """Angles and deflections of whisking in air, float32[n, 18]."""
    rng = np.random.default_rng(seed)
    phase = np.arange(SAMPLES * cycles) * DT * 2.0 * math.pi
    theta = 0.5 * (1.0 - np.cos(phase))[:, None] * SWING
    y = NOISE * rng.normal(size=theta.shape)
    return theta.astype(np.float32), y.astype(np.float32)


CALIBRATION = calibrate(*free_whisk(seed=9, cycles=4), DT)
IMAGER = TactileImager(GEOMETRY, CALIBRATION, DT)


def touching(whisker, fraction, stiff=False, slope=2e-3):
    """A whisk in which one whisker meets an obstacle at a fraction of its swing."""
    theta, y = free_whisk(seed=whisker)
    limit = fraction * SWING[whisker]
    excess = np.maximum(theta[:, whisker] - limit, 0.0)
    y[:, whisker] += (slope * excess / SWING[whisker] * 10).astype(np.float32)
    if not stiff:
        theta[:, whisker] = np.minimum(theta[:, whisker], limit)
    return theta, y


def height(whisker, theta):
    return PIVOT[whisker] - LENGTH[whisker] * math.cos(PHI_START[whisker] - theta)


def code(tip_height):
    return 1 + math.floor(254 * min(max(tip_height / 0.055, 0.0), 1.0) + 0.5)


def test_nothing_is_felt_in_free_air():
    for seed in range(5):
        theta, y = free_whisk(seed)
        images = IMAGER.image(theta, y, y)
        assert images.contact_mask == 0
        for image in (images.max_angle_gated, images.max_angle_ungated, images.contact_angle):
            assert (image.dtype, image.shape) == (np.uint8, (3, 6))
            assert not image.any()
        assert not images.mask_image.any()


@pytest.mark.parametrize("whisker", [0, 5, 8, 17])
@pytest.mark.parametrize("fraction", [0.3, 0.6, 0.9])
def test_one_touch_is_one_pixel_of_the_tips_height(whisker, fraction):
    theta, y = touching(whisker, fraction)
    images = IMAGER.image(theta, y, y)
    row, column = divmod(whisker, 6)
    expected = code(height(whisker, float(theta[:, whisker].max())))
    for image in (images.max_angle_gated, images.max_angle_ungated):
        assert np.argwhere(image).tolist() == [[row, column]]
        assert image[row, column] == expected
    assert np.argwhere(images.contact_angle).tolist() == [[row, column]]
    assert abs(int(images.contact_angle[row, column]) - expected) <= 6
    assert images.contact_mask == 1 << whisker
    assert np.argwhere(images.mask_image == 255).tolist() == [[row, column]]


def test_tip_heights_run_from_the_wall_tops_down():
    """Full protraction of the three rings: 37, 6 and 6 mm above the floor, 55 mm at rest."""
    for whisker, lowest in ((0, 0.037), (6, 0.006), (12, 0.006)):
        assert height(whisker, 0.0) == pytest.approx(0.055, abs=1e-3)
        assert height(whisker, SWING[whisker]) == pytest.approx(lowest, abs=1e-3)
    high, low = (IMAGER.image(*[touching(8, f)[n] for n in (0, 1, 1)]) for f in (0.2, 0.9))
    assert high.max_angle_gated[1, 2] > low.max_angle_gated[1, 2] > 0


def test_a_stiff_motor_blanks_the_ungated_image_and_not_the_gated_one():
    theta, y = touching(8, 0.5, stiff=True)
    images = IMAGER.image(theta, y, y)
    assert images.max_angle_ungated[1, 2] == 0
    assert images.max_angle_gated[1, 2] == code(height(8, float(theta[:, 8].max())))
    assert images.contact_angle[1, 2] > images.max_angle_gated[1, 2]


def test_a_contact_that_is_left_before_full_protraction_is_no_gated_pixel():
    """The whisker slips off: max angle forgets the obstacle, contact angle remembers it."""
    theta, y = free_whisk()
    limit = 0.4 * SWING[8]
    inside = (theta[:, 8] > limit) & (theta[:, 8] < 0.6 * SWING[8]) & (np.arange(SAMPLES) < 1000)
    y[inside, 8] += np.float32(2e-3)
    images = IMAGER.image(theta, y, y)
    assert images.max_angle_gated[1, 2] == images.max_angle_ungated[1, 2] == 0
    expected = code(height(8, limit))
    assert abs(int(images.contact_angle[1, 2]) - expected) <= 3


def test_the_first_crossing_counts_whatever_comes_later():
    theta, y = free_whisk()
    early, late = theta.copy(), theta.copy()
    y_early, y_both = y.copy(), y.copy()
    y_early[300:, 3] += np.float32(1e-3)
    y_both[300:, 3] += np.float32(1e-3)
    y_both[450:, 3] += np.float32(5e-3)
    first = IMAGER.image(early, y_early, y_early).contact_angle
    both = IMAGER.image(late, y_both, y_both).contact_angle
    assert first[0, 3] == both[0, 3] > 0


def test_the_release_of_the_whisk_before_is_not_a_contact():
    theta, y = free_whisk()
    y[:20, 4] += np.float32(3e-3)
    assert IMAGER.image(theta, y, y).contact_mask == 0
    y[20:, 4] -= np.float32(1e-3) * np.linspace(0, 1, SAMPLES - 20, dtype=np.float32)
    assert IMAGER.image(theta, y, y).contact_angle[0, 4] == 0


def test_the_rate_is_the_smoothed_derivative():
    n = np.arange(4000)
    ramp = np.repeat((1e-3 * n * DT)[:, None], 18, axis=1).astype(np.float32)
    rate = deflection_rate(ramp, DT)
    assert rate[0] == pytest.approx(0.0)
    np.testing.assert_allclose(rate[-1], 0.010 * 1e-3, rtol=1e-4)
    fast, slow = DT / (0.005 + DT), DT / (0.015 + DT)
    y = free_whisk(3)[1]
    a = b = float(y[0, 7])
    for s in range(50):
        a += fast * (float(y[s, 7]) - a)
        b += slow * (float(y[s, 7]) - b)
        assert deflection_rate(y[: s + 1], DT)[s, 7] == pytest.approx(a - b, abs=1e-18)


def test_calibration_is_mean_and_standard_deviation_of_free_whisking():
    theta, y = free_whisk(seed=2, cycles=3)
    y = y + np.float32(4e-4)
    found = calibrate(theta, y, DT)
    np.testing.assert_allclose(found.free_angle, theta.max(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found.y_mean, 4e-4, atol=1e-6)
    np.testing.assert_allclose(found.y_threshold, 20 * NOISE, rtol=0.1)
    rate = deflection_rate(y, DT)
    np.testing.assert_allclose(found.rate_mean, rate.mean(axis=0))
    np.testing.assert_allclose(found.rate_threshold, 8 * rate.std(axis=0))


@settings(max_examples=20, deadline=None)
@given(whisker=st.integers(0, 17), turn=st.integers(0, 5))
def test_whiskers_of_a_ring_are_interchangeable(whisker, turn):
    """Relabelling whiskers within their rings permutes the pixels of a row."""
    order = np.concatenate([ring * 6 + np.roll(np.arange(6), turn) for ring in range(3)])
    theta, y = touching(whisker, 0.5)
    calibration = WhiskCalibration(*(np.full(18, v) for v in (0.0, 0.0, 2e-4, 0.0, 2e-5)))
    imager = TactileImager(GEOMETRY, calibration, DT)
    one = imager.image(theta, y, y)
    other = imager.image(theta[:, order], y[:, order], y[:, order])
    assert (other.contact_angle == np.roll(one.contact_angle, turn, axis=1)).all()
    assert (other.max_angle_gated == np.roll(one.max_angle_gated, turn, axis=1)).all()


@pytest.mark.parametrize(
    ("theta", "message"),
    [
        (np.zeros((10, 17), np.float32), r"theta: expected float32\[n, 18\]"),
        (np.zeros((10, 18)), r"theta: expected float32\[n, 18\], found float64"),
        (np.zeros((0, 18), np.float32), "theta: expected 1 samples, found 0"),
        (np.zeros((9, 18), np.float32), "x: expected 9 samples, found 10"),
    ],
)
def test_a_cycle_of_the_wrong_shape_is_refused(theta, message):
    other = np.zeros((10, 18), np.float32)
    with pytest.raises(TactileError, match=message):
        IMAGER.image(theta, other, other)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_sample_that_is_not_a_number_is_named(which):
    arrays = [np.zeros((10, 18), np.float32) for _ in range(3)]
    arrays[which][4, 11] = np.nan
    with pytest.raises(TactileError, match="sample 4, whisker 11: expected finite numbers"):
        IMAGER.image(*arrays)


def test_geometry_calibration_and_dt_are_checked():
    with pytest.raises(TactileError, match="length: expected 18 finite numbers"):
        TactileImager(WhiskGeometry(PIVOT, LENGTH[:3], PHI_START), CALIBRATION, DT)
    with pytest.raises(TactileError, match="dt: expected a positive time"):
        TactileImager(GEOMETRY, CALIBRATION, 0.0)
    with pytest.raises(TactileError, match="calibration: expected theta and y of shape"):
        calibrate(np.zeros((5, 3), np.float32), np.zeros((5, 3), np.float32))
    with pytest.raises(TactileError, match="calibration: expected finite numbers"):
        calibrate(*[np.full((5, 18), np.nan, np.float32)] * 2)
