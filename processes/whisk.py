"""The whisk process: hosts one whisk controller, calibrates it in the air, and lets it answer."""

from __future__ import annotations

import math

import numpy as np

from vibrissa.control.calibration import Calibration, CalibrationError, Calibrator
from vibrissa.control.controller import Controller
from vibrissa.control.kinematics import paper_head
from vibrissa.control.open_loop import OpenLoop
from vibrissa.control.rcp import Rcp, RcpParams, normalised_gain
from vibrissa.control.whisk_pattern import full_whisk
from vibrissa.messages.codec import Message
from vibrissa.messages.types import (
    TICK_HZ,
    WHISKERS,
    Event,
    HeadSample,
    WhiskCalibration,
    WhiskCommand,
    WhiskCycle,
)
from vibrissa.processes.config import Experiment
from vibrissa.processes.node import Output

CONTROLLERS = ("open_loop", "rcp")


LEAST_SLEW_LIMIT = 0.005
"""Largest change of a command per tick, rad, unless fast whisking itself needs more."""


def slew_limit(experiment: Experiment) -> float:
    """rad per tick: what no command may exceed, a fifth above the whisk's own steepest change."""
    swing = float(paper_head().swing.max())
    return max(LEAST_SLEW_LIMIT, 1.2 * swing * math.pi / experiment.period_ticks)


def make_controller(experiment: Experiment) -> Controller:
    """The controller an experiment names, one of CONTROLLERS."""
    whisk = full_whisk(paper_head(), experiment.period_ticks, slew_limit(experiment))
    settings = experiment.whisk
    if settings.controller == "open_loop":
        return OpenLoop(whisk)
    window = max(round(settings.rcp_window * TICK_HZ), 1)
    return Rcp(RcpParams(whisk, normalised_gain(settings.rcp_gain), window))


class WhiskNode:
    """Answers every sample with a command, and tells when a whisk cycle is complete.

    For the first cycles the head is held free: what the whiskers feel then is the calibration. A
    touch during calibration is a fault that ends the run, because the thresholds would be blind.
    """

    def __init__(self, experiment: Experiment) -> None:
        self._period = experiment.period_ticks
        self._calibrator = Calibrator(experiment.whisk.calibration_cycles, self._period)
        self._calibration_ticks = experiment.calibration_ticks
        self._controller = make_controller(experiment)
        self._active = False
        self._cycle_start = 0
        self._protraction = np.zeros(WHISKERS, np.float32)
        self._cycles = 0

    def step(self, message: Message) -> list[Output]:
        if message.topic != "head.sample":
            return []
        sample: HeadSample = message.body
        tick = sample.tick
        outputs: list[Output] = []
        if not self._active:
            self._active = True
            self._cycle_start = tick
            self._controller.activate(tick, sample.command, sample.theta)
        command = self._controller.step(tick, sample.theta, sample.x, sample.y)
        outputs.append(("whisk.command", WhiskCommand(tick, command)))
        if tick < self._calibration_ticks:
            outputs += self._calibrate(sample)
        np.maximum(self._protraction, command, out=self._protraction)
        if (tick + 1) % self._period == 0:
            outputs.append(("whisk.cycle", self._cycle(tick)))
        return outputs

    def counters(self) -> dict[str, int]:
        """Whisk cycles completed."""
        return {"cycles": self._cycles}

    def _calibrate(self, sample: HeadSample) -> list[Output]:
        self._calibrator.update(sample.x, sample.y)
        if not self._calibrator.complete:
            return []
        try:
            calibration = self._calibrator.result()
        except CalibrationError as error:
            return [("node.event", Event(sample.tick, "fault", "whisk", str(error)[:400]))]
        self._controller.calibrate(calibration)
        return [("whisk.calibration", as_message(calibration))]

    def _cycle(self, tick: int) -> WhiskCycle:
        cycle = WhiskCycle(
            cycle=tick // self._period,
            first_tick=self._cycle_start,
            last_tick=tick,
            calibrating=int(tick < self._calibration_ticks),
            protraction=self._protraction.copy(),
        )
        self._cycle_start = tick + 1
        self._protraction[:] = 0
        self._cycles += 1
        return cycle


def as_message(calibration: Calibration) -> WhiskCalibration:
    """The calibration as it travels."""
    return WhiskCalibration(
        samples=calibration.samples,
        mean_y=calibration.mean_y.astype(np.float32),
        sigma_y=calibration.sigma_y.astype(np.float32),
        threshold_y=calibration.threshold_y.astype(np.float32),
        mean_dy=calibration.mean_dy.astype(np.float32),
        threshold_dy=calibration.threshold_dy.astype(np.float32),
    )
