"""Halving the plant's step changes what a circuit looks like by less than the sensors' noise."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from vibrissa.control.arm_path import ArmPath, Motion, circuit
from vibrissa.control.calibration import Calibrator
from vibrissa.control.kinematics import WHISKERS, paper_head
from vibrissa.control.whisk_pattern import full_whisk, protraction_at
from vibrissa.processes.views import make_imager
from vibrissa.rig.maze import load_maze
from vibrissa.rig.plant import HeadPlantParams
from vibrissa.rig.scene import wall_boxes
from vibrissa.slam.tactile import TactileImager
from vibrissa.tools.carried_head import Carriage, Felt, carried, tour

NOISY = HeadPlantParams()
QUIET = replace(NOISY, encoder_noise=0.0, sensor_noise=0.0, sensor_resolution=0.0)
PERIOD = 2000
MAZE = load_maze("board7x5")
BOXES = wall_boxes(MAZE)


def round_the_maze() -> Carriage:
    """One circuit at 40 mm/s, whisking once a second."""
    path = ArmPath(circuit(MAZE.width, MAZE.height, "C", pitch=MAZE.pitch), Motion(speed=0.04))
    begin = path.circuits_start_ns
    ticks = int(path.circuit_ends_ns[-1] - begin) // 500_000 // PERIOD * PERIOD
    poses = path.poses(begin + np.arange(ticks + 1, dtype=np.int64) * 500_000)
    share = np.array([protraction_at(t, PERIOD) for t in range(PERIOD)])
    command = share[:, None] * full_whisk(paper_head(), PERIOD).amplitude
    return Carriage(poses, np.tile(command.astype(np.float32), (ticks // PERIOD, 1)), 2000)


def imager() -> TactileImager:
    """Calibrated on free whisking with noise, as in a run."""
    free = carried(np.zeros((0, 5)), NOISY, tour(4.0, 2000, height=0.2))
    calibrator = Calibrator(3, PERIOD)
    for first in range(PERIOD, 4 * PERIOD, PERIOD):
        calibrator.update(free.x[first : first + PERIOD], free.y[first : first + PERIOD])
    highest = free.theta[PERIOD:].max(axis=0).astype(np.float64)
    return make_imager(NOISY.geometry, calibrator.result(), highest)


def images(eye: TactileImager, felt: Felt) -> np.ndarray:
    """float64[2, whisks, 18]: max angle and contact angle."""
    seen = []
    for first in range(0, len(felt.theta), PERIOD):
        cut = slice(first, first + PERIOD)
        image = eye.image(felt.theta[cut], felt.x[cut], felt.y[cut])
        seen.append((image.max_angle_gated.reshape(-1), image.contact_angle.reshape(-1)))
    return np.array(seen, dtype=np.float64).swapaxes(0, 1)


def test_halving_the_step_changes_a_circuits_images_less_than_noise_does() -> None:
    over, eye = round_the_maze(), imager()
    usual = images(eye, carried(BOXES, QUIET, over))
    halved = images(eye, carried(BOXES, replace(QUIET, rate=4000.0), over))
    noisy = [images(eye, carried(BOXES, NOISY, over, seed)) for seed in (1, 2)]
    assert usual.shape[1] > 60 and usual.shape[2] == WHISKERS
    for kind in range(2):
        assert (usual[kind] > 0).mean() > 0.05
        by_step = np.sqrt(np.mean((usual[kind] - halved[kind]) ** 2))
        by_noise = np.sqrt(np.mean((noisy[0][kind] - noisy[1][kind]) ** 2))
        assert by_step < by_noise
        assert np.median(np.abs(usual[kind] - halved[kind])) == 0.0


def test_samples_of_a_circuit_converge_with_the_step() -> None:
    over = tour(4.0, 1000)
    truth = carried(BOXES, replace(QUIET, rate=32000.0), over)
    errors = []
    for rate in (1000.0, 2000.0, 4000.0, 8000.0):
        felt = carried(BOXES, replace(QUIET, rate=rate), over)
        errors.append(np.quantile(np.abs(felt.y - truth.y), 0.95))
    for coarse, fine in pairwise(errors):
        assert fine < 0.7 * coarse
    assert errors[1] < 0.1 * NOISY.sensor_noise


def test_rate_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="multiple of 2000"):
        carried(BOXES, replace(QUIET, rate=3000.0), tour(0.1, 2000))
