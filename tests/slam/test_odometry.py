"""Odometry from true poses, and its noise models."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.slam.interface import Odometry, SlamInputError
from vibrissa.slam.odometry import NOISE_MODELS, odometry_between

angles = st.floats(-math.pi, math.pi)
lengths = st.floats(-5.0, 5.0)


def test_driving_forward_backward_and_turning_on_the_spot():
    assert odometry_between((0, 0, 0), (0.04, 0, 0), 2.0) == Odometry(0.02, 0.0, 2.0)
    assert odometry_between((0, 0, 0), (-0.04, 0, 0), 2.0) == Odometry(-0.02, 0.0, 2.0)
    turned = odometry_between((1, 1, 3.0), (1, 1, -3.0), 1.0)
    assert turned.v == 0.0
    assert turned.w == pytest.approx(2.0 * math.pi - 6.0)


@given(x=lengths, y=lengths, yaw=angles, v=st.floats(-0.5, 0.5), w=st.floats(-1.5, 1.5))
def test_constant_velocities_are_recovered_from_the_chord(x, y, yaw, v, w):
    """Driving an arc: the speed is the chord, with the sign of v; the turn is exact."""
    middle = yaw + 0.5 * w
    chord = v if abs(w) < 1e-6 else v * math.sin(0.5 * w) / (0.5 * w)
    end = (x + chord * math.cos(middle), y + chord * math.sin(middle), yaw + w)
    found = odometry_between((x, y, yaw), end, 1.0)
    assert found.v == pytest.approx(chord, abs=1e-9)
    assert found.w == pytest.approx(w, abs=1e-9)


@pytest.mark.parametrize("dt", [0.0, -1.0, math.nan])
def test_an_impossible_interval_is_refused(dt):
    with pytest.raises(SlamInputError, match="odometry dt: expected a positive time"):
        odometry_between((0, 0, 0), (1, 0, 0), dt)


def test_poses_that_are_not_numbers_are_refused():
    with pytest.raises(SlamInputError, match="odometry end pose: expected finite numbers"):
        odometry_between((0, 0, 0), (math.nan, 0, 0), 1.0)


@pytest.mark.parametrize(
    ("name", "distance", "angle"),
    [
        ("none", 0.0, 0.0),
        ("paper-std", 8.2e-3, 0.103),
        ("paper-variance", 2.8636e-3, 0.32094),
        ("third", 2.7e-3, 0.034),
        ("full", 8.2e-3, 0.103),
    ],
)
def test_additive_noise_has_the_named_size_whatever_the_speed(name, distance, angle):
    rng = np.random.default_rng(0)
    for true in (Odometry(0.02, 0.1, 1.0), Odometry(-0.05, 0.0, 0.5)):
        noisy = [
            NOISE_MODELS[name].apply(true, (float(a), float(b)))
            for a, b in rng.normal(size=(4000, 2))
        ]
        along = np.array([(n.v - true.v) * true.dt for n in noisy])
        around = np.array([(n.w - true.w) * true.dt for n in noisy])
        assert along.std() == pytest.approx(distance, rel=0.05)
        assert around.std() == pytest.approx(angle, rel=0.05)
        assert abs(along.mean()) <= 4 * distance / math.sqrt(4000)


def test_timing_noise_scales_motion_and_turn_together():
    noisy = NOISE_MODELS["jit"].apply(Odometry(0.04, 0.5, 1.0), (1.0, -3.0))
    assert (noisy.v, noisy.w) == (pytest.approx(0.048), pytest.approx(0.6))
    still = NOISE_MODELS["jit"].apply(Odometry(0.0, 0.0, 1.0), (2.0, 2.0))
    assert (still.v, still.w) == (0.0, 0.0)
