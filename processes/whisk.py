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


DISTURBANCE = 0.02
"""Largest distance of the drives' command from the controller's in free whisking, rad."""
MOST_ATTEMPTS = 20
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
    Cycles in which the drives did not get what was commanded are no free whisking; calibration
    starts over after them.
    """

    def __init__(self, experiment: Experiment) -> None:
        self._period = experiment.period_ticks
        self._calibration_cycles = experiment.whisk.calibration_cycles
        self._calibrator: Calibrator | None = self._fresh_calibrator()
        self._disturbed = False
        self._attempts = 1
        self._controller = make_controller(experiment)
        self._active = False
        self._cycle_start = 0
        self._command = np.zeros(WHISKERS, np.float32)
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
            self._command = sample.command
        if self._calibrator is not None:
            off = np.abs(sample.command - self._command).max()
            self._disturbed |= bool(off > DISTURBANCE)
        command = self._command = self._controller.step(tick, sample.theta, sample.x, sample.y)
        outputs.append(("whisk.command", WhiskCommand(tick, command)))
        np.maximum(self._protraction, command, out=self._protraction)
        calibrating = self._calibrator is not None
        if self._calibrator is not None:
            outputs += self._calibrate(self._calibrator, sample)
        if (tick + 1) % self._period == 0:
            outputs.append(("whisk.cycle", self._cycle(tick, calibrating)))
            if self._disturbed:
                outputs += self._start_over(tick)
        return outputs

    def counters(self) -> dict[str, int]:
        """Whisk cycles completed."""
        return {"cycles": self._cycles}

    def _fresh_calibrator(self) -> Calibrator:
        return Calibrator(self._calibration_cycles, self._period)

    def _calibrate(self, calibrator: Calibrator, sample: HeadSample) -> list[Output]:
        if self._disturbed:
            return []
        calibrator.update(sample.x, sample.y)
        if not calibrator.complete:
            return []
        try:
            calibration = calibrator.result()
        except CalibrationError as error:
            self._calibrator = None
            return [_fault(sample.tick, str(error))]
        self._calibrator = None
        self._controller.calibrate(calibration)
        return [("whisk.calibration", as_message(calibration))]

    def _start_over(self, tick: int) -> list[Output]:
        self._disturbed = False
        self._attempts += 1
        if self._attempts > MOST_ATTEMPTS:
            self._calibrator = None
            return [
                _fault(
                    tick,
                    f"calibration: given up after {MOST_ATTEMPTS} attempts, each time the drives "
                    f"were more than {DISTURBANCE} rad from what was commanded",
                )
            ]
        self._calibrator = self._fresh_calibrator()
        return []

    def _cycle(self, tick: int, calibrating: bool) -> WhiskCycle:
        cycle = WhiskCycle(
            cycle=tick // self._period,
            first_tick=self._cycle_start,
            last_tick=tick,
            calibrating=int(calibrating),
            protraction=self._protraction.copy(),
        )
        self._cycle_start = tick + 1
        self._protraction[:] = 0
        self._cycles += 1
        return cycle


def _fault(tick: int, cause: str) -> Output:
    return "node.event", Event(tick, "fault", "whisk", cause[:400])


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
