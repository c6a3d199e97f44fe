"""The slam process: a tactile image per whisk cycle, odometry, RatSLAM, metrics.

Samples and arm states are kept by tick until a whisk cycle is complete, so what is computed does
not depend on how messages of different processes interleave.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from typing import Any

import numpy as np

from vibrissa.control.kinematics import NOSE_HEIGHT, paper_head
from vibrissa.messages.codec import Message
from vibrissa.messages.types import (
    TICK_HZ,
    WHISKERS,
    ArmState,
    HeadSample,
    Metrics,
    SlamMap,
    SlamPose,
    SlamView,
    WhiskCalibration,
    WhiskCycle,
)
from vibrissa.numerics import cos, philox_normal, sin
from vibrissa.processes.arm import ARM_TICKS
from vibrissa.processes.config import Experiment
from vibrissa.processes.node import Output
from vibrissa.processes.results import RunError
from vibrissa.slam import tactile
from vibrissa.slam.angles import wrap_pi
from vibrissa.slam.config import PRESETS, ConfigError, RatSlamConfig
from vibrissa.slam.interface import Odometry, Slam, SlamStep
from vibrissa.slam.metrics import energy_metric, experience_metric, first_circuit, fixed_interval
from vibrissa.slam.odometry import NOISE_MODELS, odometry_between
from vibrissa.slam.ratslam import RatSlam

NOISE_STREAM = 1000
"""Noise stream of the odometry; the head's sensors use streams below."""
WORKING = 0.001
"""How near the nose plane must be to its working height for a cycle to count, m."""
REPORT_CYCLES = 10


def make_slam_config(experiment: Experiment) -> RatSlamConfig:
    """The RatSLAM parameters of an experiment. Raises RunError that names the bad one."""
    settings = experiment.slam
    if settings.preset not in PRESETS:
        raise RunError(f"slam.preset: {settings.preset!r}, expected one of {', '.join(PRESETS)}")
    if settings.odometry_noise not in NOISE_MODELS:
        raise RunError(
            f"slam.odometry_noise: {settings.odometry_noise!r}, "
            f"expected one of {', '.join(NOISE_MODELS)}"
        )
    known = {f.name for f in dataclasses.fields(RatSlamConfig)}
    for name in settings.parameters:
        if name not in known:
            raise RunError(f"slam.parameters.{name}: no such RatSLAM parameter")
    try:
        changes: dict[str, Any] = dict(settings.parameters)
        return dataclasses.replace(PRESETS[settings.preset], **changes)
    except ConfigError as error:
        raise RunError(f"slam.parameters.{error}") from None


class SlamNode:
    """Builds the tactile image of every cycle and steps a SLAM with it."""

    def __init__(self, experiment: Experiment) -> None:
        self._slam: Slam = RatSlam(make_slam_config(experiment))
        self._kind = experiment.slam.image
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
        self._cycle = 0
        self._reported = 0
        self._log = TrajectoryLog()

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
            case "run.event" if body.kind == "stop":
                return self._complete_cycles() + self._report()
        return self._complete_cycles()

    def counters(self) -> dict[str, int]:
        """Cycles that became a view."""
        return {"views": len(self._log.experiences)}

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
        images = self._make_imager().image(*self._of_cycle(cycle))
        image = getattr(images, self._kind)
        dt = (here.tick - before.tick) / TICK_HZ
        exact = odometry_between(_planar(before), _planar(here), dt)
        normals = (
            philox_normal(self._seed, NOISE_STREAM, 2 * cycle.cycle),
            philox_normal(self._seed, NOISE_STREAM, 2 * cycle.cycle + 1),
        )
        odometry = self._noise.apply(exact, normals)
        result = self._slam.step(image, odometry)
        self._cycle = cycle.cycle
        self._log.add(result, odometry, _planar(here))
        error = result.match_error if math.isfinite(result.match_error) else -1.0
        outputs: list[Output] = [
            (
                "slam.view",
                SlamView(
                    cycle=cycle.cycle,
                    max_angle_gated=images.max_angle_gated.reshape(-1),
                    max_angle_ungated=images.max_angle_ungated.reshape(-1),
                    contact_angle=images.contact_angle.reshape(-1),
                    template=result.template,
                    new=int(result.new_template),
                    error=error,
                ),
            ),
            (
                "slam.pose",
                SlamPose(
                    cycle=cycle.cycle,
                    experience=result.experience,
                    action=result.action,
                    estimate=np.array([result.x, result.y, result.heading]),
                    odometry=np.array([odometry.v, odometry.w, odometry.dt]),
                    truth=here.pose.copy(),
                ),
            ),
        ]
        views = len(self._log.experiences)
        if views - self._reported >= max(REPORT_CYCLES, views // 10):
            outputs += self._report()
        return outputs

    def _report(self) -> list[Output]:
        """Map and metrics: at ever longer intervals, so that their cost stays in proportion."""
        if self._reported == len(self._log.experiences):
            return []
        self._reported = len(self._log.experiences)
        found = self._slam.map()
        return [
            ("slam.map", SlamMap(self._cycle, found.poses, found.links.astype(np.int32))),
            ("eval.metrics", self._log.metrics(self._cycle)),
        ]

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


class TrajectoryLog:
    """True, estimated and dead-reckoned trajectories, one pose per cycle, and their metrics."""

    def __init__(self) -> None:
        self.experiences: list[int] = []
        self.templates = 0
        self._known = 0
        self._truth: list[tuple[float, float, float]] = []
        self._estimate: list[tuple[float, float, float]] = []
        self._reckoned: list[tuple[float, float, float]] = []

    def add(self, result: SlamStep, odometry: Odometry, truth: tuple[float, float, float]) -> None:
        x, y, heading = self._reckoned[-1] if self._reckoned else (0.0, 0.0, 0.0)
        heading = wrap_pi(heading + odometry.w * odometry.dt)
        distance = odometry.v * odometry.dt
        self._reckoned.append((x + distance * cos(heading), y + distance * sin(heading), heading))
        self._estimate.append((result.x, result.y, result.heading))
        self._truth.append(truth)
        self.experiences.append(result.experience)
        self.templates = result.templates
        self._known = result.experiences

    def metrics(self, cycle: int) -> Metrics:
        """Scores so far, over consecutive relations, beside those of the raw odometry."""
        base = first_circuit(self._truth)
        score = experience_metric(self.experiences, self._truth, base)
        pairs = fixed_interval(len(self._truth))
        estimated = reckoned = None
        if len(pairs):
            estimated = energy_metric(self._estimate, self._truth, pairs)
            reckoned = energy_metric(self._reckoned, self._truth, pairs)
        return Metrics(
            cycle=cycle,
            arr=-1.0 if score.arr is None else score.arr,
            arcr=-1.0 if score.arcr is None else score.arcr,
            em_translation=estimated.translation if estimated else -1.0,
            em_rotation=estimated.rotation if estimated else -1.0,
            odometry_translation=reckoned.translation if reckoned else -1.0,
            odometry_rotation=reckoned.rotation if reckoned else -1.0,
            experiences=self._known,
            templates=self.templates,
        )


def _working(state: ArmState) -> bool:
    return abs(float(state.pose[2]) - NOSE_HEIGHT) < WORKING


def _planar(state: ArmState) -> tuple[float, float, float]:
    x, y, _, yaw = state.pose.tolist()
    return x, y, yaw
