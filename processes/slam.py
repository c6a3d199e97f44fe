"""The slam process: a tactile image per whisk cycle, odometry, the run's first SLAM, metrics.

Samples and arm states are kept by tick until a whisk cycle is complete, so what is computed does
not depend on how messages of different processes interleave.

Other SLAMs may be loaded beside it (`processes.slam_shadow`). They step on the images and odometry
that are said here, are handed over everything seen so far, and one of them can be made the run's
SLAM between two whisk cycles. Nothing moves by what a SLAM says, so no arbiter is needed: the first
one never stops, and takes over again from one that is silent.
"""

from __future__ import annotations

import collections

import numpy as np

from vibrissa.control.kinematics import NOSE_HEIGHT, paper_head
from vibrissa.messages.codec import Message
from vibrissa.messages.types import (
    TICK_HZ,
    TICK_NS,
    WHISKERS,
    ArmState,
    HeadSample,
    WhiskCalibration,
    WhiskCycle,
)
from vibrissa.numerics import philox_normal
from vibrissa.processes.arm import ARM_TICKS
from vibrissa.processes.config import Experiment
from vibrissa.processes.mapping import IMAGES, Mapping, Sight
from vibrissa.processes.node import Output
from vibrissa.processes.slam_others import Others
from vibrissa.processes.slams import make_slam
from vibrissa.slam import tactile
from vibrissa.slam.odometry import NOISE_MODELS, odometry_between

NOISE_STREAM = 1000
"""Noise stream of the odometry; the head's sensors use streams below."""
WORKING = 0.001
"""How near the nose plane must be to its working height for a cycle to count, m."""


class SlamNode:
    """Builds the tactile image of every cycle and steps a SLAM with it."""

    def __init__(self, experiment: Experiment) -> None:
        slam = make_slam(experiment.slam.algorithm, experiment)
        self._mapping = Mapping(slam, experiment.slam.image)
        self._others = Others(experiment.slam.image, experiment.period_ticks)
        self._noise = NOISE_MODELS[experiment.slam.odometry_noise]
        self._seed = experiment.run.seed
        size = 2 * experiment.period_ticks + TICK_HZ
        self._samples = np.zeros((3, size, WHISKERS), np.float32)
        self._newest = -1
        self._poses: collections.deque[ArmState] = collections.deque()
        self._cycles: collections.deque[WhiskCycle] = collections.deque()
        self._calibration: WhiskCalibration | None = None
        self._imager: tactile.TactileImager | None = None
        self._free_angle = np.zeros(WHISKERS)
        self._last: ArmState | None = None

    def step(self, message: Message) -> list[Output]:
        body = message.body
        match message.topic:
            case "head.sample":
                self._keep(body)
                if not self._cycles:
                    return []
            case "arm.state":
                self._poses.append(body)
            case "whisk.cycle":
                self._cycles.append(body)
            case "whisk.calibration":
                self._calibration = body
            case "slam.pose":
                self._others.heard(message.source, body.cycle)
                return []
            case "run.order" if body.node == "slam":
                return self._others.obey(body, message.t // TICK_NS)
            case "run.order":
                return []
            case "run.event" if body.kind == "stop":
                return self._complete_cycles() + self._mapping.report()
        return self._complete_cycles()

    def counters(self) -> dict[str, int]:
        """Cycles that became a view."""
        return {"views": self._mapping.views}

    def _keep(self, sample: HeadSample) -> None:
        slot = sample.tick % self._samples.shape[1]
        self._samples[0, slot] = sample.theta
        self._samples[1, slot] = sample.x
        self._samples[2, slot] = sample.y
        self._newest = sample.tick

    def _complete_cycles(self) -> list[Output]:
        outputs: list[Output] = []
        while self._cycles and self._poses:
            cycle = self._cycles[0]
            lacking = self._newest < cycle.last_tick or (
                self._poses[-1].tick + ARM_TICKS <= cycle.last_tick
            )
            uncalibrated = not cycle.calibrating and self._calibration is None
            if lacking or uncalibrated:
                break
            self._cycles.popleft()
            outputs += self._whisked(cycle)
        return outputs

    def _whisked(self, cycle: WhiskCycle) -> list[Output]:
        while len(self._poses) > 1 and self._poses[1].tick <= cycle.last_tick:
            self._poses.popleft()
        here = self._poses[0]
        before, self._last = self._last, here
        if cycle.last_tick - cycle.first_tick >= self._samples.shape[1]:
            return []  # longer than what is kept: a controller that stopped whisking for a while
        if cycle.calibrating:
            theta = self._of_cycle(cycle)[0]
            np.maximum(self._free_angle, theta.max(axis=0), out=self._free_angle)
            return []
        if before is None or not (_working(before) and _working(here)):
            return []
        return self._see(cycle, before, here)

    def _see(self, cycle: WhiskCycle, before: ArmState, here: ArmState) -> list[Output]:
        found = self._make_imager().image(*self._of_cycle(cycle))
        images = {kind: getattr(found, kind).reshape(-1) for kind in IMAGES}
        dt = (here.tick - before.tick) / TICK_HZ
        exact = odometry_between(_planar(before), _planar(here), dt)
        normals = (
            philox_normal(self._seed, NOISE_STREAM, 2 * cycle.cycle),
            philox_normal(self._seed, NOISE_STREAM, 2 * cycle.cycle + 1),
        )
        sight = Sight(cycle.cycle, images, self._noise.apply(exact, normals), here.pose)
        return self._mapping.see(sight) + self._others.saw(sight)

    def _make_imager(self) -> tactile.TactileImager:
        if self._imager is None:
            assert self._calibration is not None
            head = paper_head()
            calibration = self._calibration
            self._imager = tactile.TactileImager(
                tactile.WhiskGeometry(head.pivot_height + NOSE_HEIGHT, head.length, head.phi_start),
                tactile.WhiskCalibration(
                    free_angle=self._free_angle,
                    y_mean=calibration.mean_y.astype(np.float64),
                    y_threshold=calibration.threshold_y.astype(np.float64),
                    rate_mean=calibration.mean_dy.astype(np.float64),
                    rate_threshold=calibration.threshold_dy.astype(np.float64),
                ),
                1.0 / TICK_HZ,
            )
        return self._imager

    def _of_cycle(
        self, cycle: WhiskCycle
    ) -> tuple[tactile.Samples, tactile.Samples, tactile.Samples]:
        ticks = np.arange(cycle.first_tick, cycle.last_tick + 1) % self._samples.shape[1]
        theta, x, y = self._samples[:, ticks]
        return theta, x, y


def _working(state: ArmState) -> bool:
    return abs(float(state.pose[2]) - NOSE_HEIGHT) < WORKING


def _planar(state: ArmState) -> tuple[float, float, float]:
    x, y, _, yaw = state.pose.tolist()
    return x, y, yaw
