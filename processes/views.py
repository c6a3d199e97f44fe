"""Tactile views straight from the whisk loop: what the slam process makes of the same run.

One view per whisk cycle that begins and ends at working height, with the images, the odometry step
and the truth that `SlamNode` would use, to the bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.calibration import Calibration
from vibrissa.control.kinematics import NOSE_HEIGHT, WHISKERS, HeadGeometry
from vibrissa.messages.types import TICK_HZ
from vibrissa.processes.cycle import Cycle, WhiskLoop
from vibrissa.processes.slam import WORKING
from vibrissa.processes.whisk import as_message
from vibrissa.slam import tactile
from vibrissa.slam.interface import Odometry
from vibrissa.slam.odometry import odometry_between


@dataclass(frozen=True, eq=False)
class View:
    """What one whisk cycle felt, and how far the head had moved since the one before.

    images: the cycle's tactile images; odometry: exact average velocities; truth: x, y (m), yaw
    (rad) at the end. impingement float64[18] rad and slips int64[18] are the loop's, see `Cycle`.
    """

    cycle: int
    last_tick: int
    images: tactile.TactileImages
    odometry: Odometry
    truth: tuple[float, float, float]
    impingement: NDArray[np.float64]
    slips: NDArray[np.int64]


def make_imager(
    geometry: HeadGeometry, calibration: Calibration, free_angle: NDArray[np.float64]
) -> tactile.TactileImager:
    """The imager of a run; the calibration is rounded as it is on its way to the slam process."""
    sent = as_message(calibration)
    return tactile.TactileImager(
        tactile.WhiskGeometry(
            geometry.pivot_height + NOSE_HEIGHT, geometry.length, geometry.phi_start
        ),
        tactile.WhiskCalibration(
            free_angle=free_angle,
            y_mean=sent.mean_y.astype(np.float64),
            y_threshold=sent.threshold_y.astype(np.float64),
            rate_mean=sent.mean_dy.astype(np.float64),
            rate_threshold=sent.threshold_dy.astype(np.float64),
        ),
        1.0 / TICK_HZ,
    )


def views(loop: WhiskLoop) -> Iterator[View]:
    """The views of a run; arrays in them are overwritten by the next. Raises as `cycles` does."""
    free_angle = np.zeros(WHISKERS, dtype=np.float64)
    imager: tactile.TactileImager | None = None
    before: tuple[int, NDArray[np.float64]] | None = None
    for cycle in loop.cycles():
        if not cycle.complete or cycle.pose is None:
            continue
        last, before = before, (cycle.arm_tick, cycle.pose.copy())
        if cycle.calibrating:
            np.maximum(free_angle, cycle.theta.max(axis=0), out=free_angle)
            if cycle.calibration is not None:
                imager = make_imager(loop.run.head.geometry, cycle.calibration, free_angle)
            continue
        if last is None or not (_working(last[1]) and _working(cycle.pose)):
            continue
        assert imager is not None
        yield _view(cycle, imager, last[0], last[1])


def _view(
    cycle: Cycle, imager: tactile.TactileImager, before_tick: int, before: NDArray[np.float64]
) -> View:
    assert cycle.pose is not None
    here = _planar(cycle.pose)
    return View(
        cycle=cycle.number,
        last_tick=cycle.last_tick,
        images=imager.image(cycle.theta, cycle.x, cycle.y),
        odometry=odometry_between(_planar(before), here, (cycle.arm_tick - before_tick) / TICK_HZ),
        truth=here,
        impingement=cycle.impingement,
        slips=cycle.slips,
    )


def _working(pose: NDArray[np.float64]) -> bool:
    return abs(float(pose[2]) - NOSE_HEIGHT) < WORKING


def _planar(pose: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, _, yaw = pose.tolist()
    return x, y, yaw
