"""The whisk process: hosts one whisk controller, calibrates it in the air, and lets it answer."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import PurePath
from typing import Any, Final

import numpy as np

from vibrissa.control.calibration import (
    Calibration,
    CalibrationError,
    Calibrator,
    inertial_moment,
)
from vibrissa.control.controller import Controller
from vibrissa.control.drives import Violation, check_command
from vibrissa.control.kinematics import Float32s, paper_head
from vibrissa.messages.codec import Message
from vibrissa.messages.types import (
    HOST_ORDERS,
    TICK_NS,
    WHISKERS,
    Answer,
    Event,
    HeadSample,
    Order,
    Ownership,
    WhiskCalibration,
    WhiskCommand,
    WhiskCycle,
)
from vibrissa.processes.calibration_file import from_text
from vibrissa.processes.config import Experiment
from vibrissa.processes.controllers import make_controller
from vibrissa.processes.node import Output
from vibrissa.processes.results import RunError, one_line
from vibrissa.rig.devices.limits import HEAD

DISTURBANCE = 0.02
"""Largest distance of the drives' command from the controller's in free whisking, rad."""
MOST_ATTEMPTS = 20
"""Disturbed whisk cycles after which no calibration is to be expected."""
TELLABLE: Final = np.full(WHISKERS, 6.3, np.float32)
"""The widest command that travels, rad; the arbiter judges it by the travel of the drives."""


class ControllerFailure(Exception):
    """A controller raised an error, or answered with what is no command."""


class WhiskNode:
    """Answers every sample with a command, and tells when a whisk cycle is complete.

    The run's first controller starts with it; a slot is empty until an order assigns one, which
    then answers in shadow until the arbiter makes it the owner of the drives.

    For the first cycles the head is held free: what the whiskers feel then is the calibration. A
    touch during calibration is a fault that ends the run, because the thresholds would be blind.
    Cycles in which the drives did not get what was commanded are no free whisking and don't count;
    after MOST_ATTEMPTS of them it is given up. A controller that comes later is handed the
    calibration. With the file of an earlier calibration one cycle is enough: it shows that nothing
    touches, the file counts.

    A controller that raises an error, or answers with anything but 18 finite angles, has failed: it
    is never asked again, and the sampler hears of it in the same tick.
    """

    def __init__(self, experiment: Experiment, name: str = "whisk") -> None:
        self.name = name
        self._experiment = experiment
        self._period = experiment.period_ticks
        self._calibration_cycles = experiment.whisk.calibration_cycles
        self._given: Calibration | None = None
        if experiment.whisk.calibration_text:
            text, file = experiment.whisk.calibration_text, experiment.whisk.calibration
            self._given = from_text(text, f"whisk.calibration {file}")[0]
            self._calibration_cycles = 1
        self._disturbed = False
        self._spoilt = 0
        self._controller: Controller | None = None
        self._calibrator: Calibrator | None = None
        if name == "whisk":
            self._controller = make_controller(experiment.whisk.controller, experiment)
            inertial = inertial_moment(paper_head(), self._period)
            self._calibrator = Calibrator(self._calibration_cycles, self._period, inertial=inertial)
        self._calibration: Calibration | None = None
        self._owner = False
        self._change: Ownership | None = None
        self._awake = False
        self._cycle_start = 0
        self._command = np.zeros(WHISKERS, np.float32)
        self._protraction = np.zeros(WHISKERS, np.float32)
        self._cycles = 0

    def step(self, message: Message) -> Iterable[Output]:
        match message.topic:
            case "head.sample":
                return [] if self._controller is None else self._watched(message.body)
            case "head.owner":
                self._change = message.body
            case "run.calibration":
                self._calibration = from_message(message.body)
            case "run.order" if message.body.node == self.name:
                return self._obey(message.body, message.t // TICK_NS)
        return []

    def counters(self) -> dict[str, int]:
        """Whisk cycles completed as the owner of the drives."""
        return {"cycles": self._cycles}

    def _watched(self, sample: HeadSample) -> Iterator[Output]:
        try:
            yield from self._answer(sample)
        except ControllerFailure as failure:
            self._controller = self._calibrator = None
            yield "whisk.failure", Event(sample.tick, "failed", self.name, one_line(str(failure)))

    def _answer(self, sample: HeadSample) -> Iterator[Output]:
        controller = self._controller
        assert controller is not None
        tick = sample.tick
        if self._change is not None and tick >= self._change.tick:
            self._own(self._change.controller == self.name)
        if not self._awake:
            self._awake = True
            self._cycle_start = tick
            _call(controller.activate, tick, sample.command, sample.theta)
            self._command = sample.command
        before = self._command
        answer = _call(controller.step, tick, sample.theta, sample.x, sample.y)
        command = self._command = _checked(answer)
        yield "whisk.command", WhiskCommand(tick, command)
        np.maximum(self._protraction, command, out=self._protraction)
        calibrating = self._calibrator is not None
        if self._calibrator is not None:
            off = np.abs(sample.command - before).max()
            unheard = tick - sample.answers >= HEAD.watchdog_ticks  # they retract by themselves
            self._disturbed |= unheard or bool(off > DISTURBANCE)
            yield from self._calibrate(self._calibrator, sample)
        if (tick + 1) // self._period > self._cycle_start // self._period:  # samples may be lost
            cycle = self._cycle(tick, calibrating)
            if self._owner:
                self._cycles += 1
                yield "whisk.cycle", cycle
            if self._calibrator is not None:
                yield from self._count_cycle(self._calibrator, tick)

    def _own(self, owner: bool) -> None:
        """Become or cease to be the owner; whoever gains the drives starts from what they hold."""
        self._change = None
        if owner and not self._owner:
            self._awake = False
        self._owner = owner

    def _obey(self, order: Order, tick: int) -> list[Output]:
        if order.kind in HOST_ORDERS:
            return []
        try:
            text = self._assign(order) if order.kind == "assign" else self._set(order)
            accepted = 1
        except Exception as error:  # whatever a stranger's controller raises
            text, accepted = f"{error}" or type(error).__name__, 0
        return [("node.answer", Answer(order.request, tick, accepted, self.name, one_line(text)))]

    def _assign(self, order: Order) -> str:
        controller = make_controller(order.name, self._experiment, order.value)
        if getattr(controller, "needs_calibration", False):
            if self._calibration is None:
                raise RunError(f"controller {order.name} needs a calibration, there is none yet")
            controller.calibrate(self._calibration)
        self._controller = controller
        self._awake = False
        return f"{order.name} answers in shadow"

    def _set(self, order: Order) -> str:
        setter = getattr(self._controller, "set_parameter", None)
        if order.kind != "set" or setter is None:
            raise RunError(f"{self.name} can't be told to {order.kind} {order.name}")
        setter(order.name, json.loads(order.value))
        return f"{order.name} = {order.value}"

    def _calibrate(self, calibrator: Calibrator, sample: HeadSample) -> list[Output]:
        if self._disturbed:
            return []
        calibrator.update(sample.x, sample.y)
        if not calibrator.complete:
            return []
        try:
            calibration = calibrator.result()
            if self._given is not None:
                calibration = self._given
        except CalibrationError as error:
            self._calibrator = None
            return [_fault(sample.tick, str(error))]
        self._calibrator = None
        self._calibration = calibration
        if self._controller is not None:
            _call(self._controller.calibrate, calibration)
        return [("whisk.calibration", as_message(calibration))]

    def _count_cycle(self, calibrator: Calibrator, tick: int) -> list[Output]:
        if not self._disturbed:
            calibrator.mark()
            return []
        calibrator.back()
        self._disturbed = False
        self._spoilt += 1
        if self._spoilt < MOST_ATTEMPTS:
            return []
        self._calibrator = None
        return [
            _fault(
                tick,
                f"calibration: given up after {MOST_ATTEMPTS} cycles in which the drives were more "
                f"than {DISTURBANCE} rad from what was commanded, or had heard nothing for "
                f"{HEAD.watchdog_ticks} ticks",
            )
        ]

    def _cycle(self, tick: int, calibrating: bool) -> WhiskCycle:
        cycle = WhiskCycle(
            cycle=self._cycle_start // self._period,
            first_tick=self._cycle_start,
            last_tick=tick,
            calibrating=int(calibrating),
            protraction=self._protraction.copy(),
        )
        self._cycle_start = tick + 1
        self._protraction[:] = 0
        return cycle


def _call(method: Callable[..., Any], *arguments: object) -> Any:
    """Ask a controller, whose errors are its own and not ours."""
    try:
        return method(*arguments)
    except Exception as error:
        trace = error.__traceback__
        assert trace is not None
        while trace.tb_next is not None:
            trace = trace.tb_next
        where = f"{PurePath(trace.tb_frame.f_code.co_filename).name}, line {trace.tb_lineno}"
        raise ControllerFailure(f"{type(error).__name__}: {error} ({where})") from error


def _checked(answer: Any) -> Float32s:
    """The answer as a command that can travel, float32[18] rad. Raises ControllerFailure."""
    try:
        command = np.ascontiguousarray(answer, dtype=np.float32)
    except (TypeError, ValueError):
        raise ControllerFailure(
            f"answered with {type(answer).__name__}, expected 18 angles"
        ) from None
    if command.shape != (WHISKERS,):
        raise ControllerFailure(
            f"wrong length: command of shape {np.shape(answer)}, expected ({WHISKERS},)"
        )
    reason, whisker = check_command(abs(command), TELLABLE)
    if reason:
        raise ControllerFailure(str(Violation(0, reason, whisker, float(command[whisker]), 6.3)))
    return command


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


def from_message(message: WhiskCalibration) -> Calibration:
    """The calibration that travelled, as every controller that comes later gets it."""
    return Calibration(
        mean_y=message.mean_y.astype(np.float64),
        sigma_y=message.sigma_y.astype(np.float64),
        threshold_y=message.threshold_y.astype(np.float64),
        mean_dy=message.mean_dy.astype(np.float64),
        threshold_dy=message.threshold_dy.astype(np.float64),
        samples=message.samples,
    )
