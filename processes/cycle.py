"""Whole whisk cycles of the closed loop in one compiled call: plant, control law and arbiter.

What `simulate` does message by message happens here tick by tick in one compiled function, in the
same order and with the same rounding, so samples, commands and cycles have the same bits:

    the plant obeys the command given in the tick before; its sample is float32
    the arbiter lets through, slew limited, the command that answers the sample of the same tick
    in the last half second of a run the built-in retract controller has the drives
    the first cycles are free whisking in the air; then the arm departs

A controller whose law is not one of LAWS is stepped from Python instead: slower, the same bits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.calibration import Calibration, Calibrator
from vibrissa.control.controller import LAST, Controller, LawController, slewed
from vibrissa.control.drives import ADMITTED, check_command
from vibrissa.control.kinematics import WHISKERS
from vibrissa.control.open_loop import OpenLoop, open_loop_command
from vibrissa.control.rcp import Rcp, rcp_command
from vibrissa.control.retract import Retract, retract_command
from vibrissa.control.social import Social, social_command
from vibrissa.numerics import compiled
from vibrissa.processes.arm import make_path
from vibrissa.processes.config import Experiment, slew_limit
from vibrissa.processes.controllers import make_controller
from vibrissa.processes.results import RunError
from vibrissa.processes.rig import head_params
from vibrissa.processes.trajectory import Path, Trajectory
from vibrissa.processes.whisk import DISTURBANCE, MOST_ATTEMPTS
from vibrissa.rig.head import COMMAND_NOT_FINITE, OK, HeadModel, head_step
from vibrissa.rig.maze import parse_maze
from vibrissa.rig.plant import (
    ARM_PERIOD,
    HeadPlant,
    HeadPlantParams,
    PlantError,
    fresh_memo,
    head_model,
    rest_state,
)
from vibrissa.rig.rows import GAMMA, at
from vibrissa.rig.scene import wall_boxes

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Int64s = NDArray[np.int64]

OPEN_LOOP, RCP, SOCIAL = range(3)
LAWS: Final[dict[type[LawController], int]] = {OpenLoop: OPEN_LOOP, Rcp: RCP, Social: SOCIAL}
"""Controllers that run compiled. Others, their subclasses included, are stepped from Python."""
SLIP: Final = 0.0175
"""Impingement lost within one tick that only a slip-off explains, rad; a drive makes 0.002."""
SIGNALS = range(5)
SAMPLED_THETA, SAMPLED_X, SAMPLED_Y, APPLIED, COMMANDED = SIGNALS


@dataclass(frozen=True)
class Setup:
    """Everything a run depends on.

    boxes float64[n, 5] (m) of the maze; seed of the sensors' noise; slew_limit rad per tick.
    From retract_tick on the whiskers are retracted.
    """

    boxes: Float64s
    head: HeadPlantParams
    seed: int
    controller: Controller
    path: Path
    ticks: int
    retract_tick: int
    period_ticks: int
    calibration_cycles: int
    slew_limit: float


def setup(experiment: Experiment) -> Setup:
    """What the live nodes make of an experiment. Raises RunError for one that swaps controllers."""
    if experiment.swap:
        raise RunError("swap: whole cycles run with one controller; use `vibrissa simulate`")
    return Setup(
        boxes=wall_boxes(parse_maze(experiment.maze.text, experiment.maze.file)),
        head=head_params(experiment),
        seed=experiment.run.seed,
        controller=make_controller(experiment.whisk.controller, experiment),
        path=make_path(experiment),
        ticks=experiment.ticks,
        retract_tick=experiment.retract_tick,
        period_ticks=experiment.period_ticks,
        calibration_cycles=experiment.whisk.calibration_cycles,
        slew_limit=slew_limit(experiment),
    )


@dataclass(frozen=True, eq=False)
class Cycle:
    """One whisk cycle: samples first_tick .. last_tick, float32[n, 18] each.

    The arrays are the loop's own and are overwritten by the next cycle. `complete` is False when
    the controller lost the drives before its end, or the run ended; `calibration` is that which
    this cycle completed.
    applied: the command the drives were given before the sample; command: the controller's answer.
    pose: the arm's last report up to last_tick, (x, y, z m, yaw rad), None before the first; it was
    made at arm_tick. impingement float64[18] rad: how far walls pushed each shaft back at most;
    slips int64[18]: how often it slipped off a wall.
    """

    number: int
    first_tick: int
    last_tick: int
    complete: bool
    calibrating: bool
    calibration: Calibration | None
    theta: Float32s
    x: Float32s
    y: Float32s
    applied: Float32s
    command: Float32s
    arm_tick: int
    pose: Float64s | None
    impingement: Float64s
    slips: Int64s


class WhiskLoop:
    """The closed loop of a run, a whisk cycle at a time; memory does not grow with its length."""

    def __init__(self, run: Setup) -> None:
        self.run = run
        swing = run.head.geometry.swing
        self._law = LAWS.get(type(run.controller))  # type: ignore[arg-type]
        self._trajectory = Trajectory(run.path)
        self._buffer = np.zeros((len(SIGNALS), run.period_ticks, WHISKERS), dtype=np.float32)
        self._deepest = np.zeros(WHISKERS, dtype=np.float64)
        self._slips = np.zeros(WHISKERS, dtype=np.int64)
        self._travel = swing.astype(np.float32)
        self._last = np.zeros(WHISKERS, dtype=np.float32)
        self._active = np.ones(1, dtype=np.bool_)
        self._retract = Retract()
        if self._law is None:
            self._plant = HeadPlant(run.boxes, run.seed, run.head)
        else:
            self._model = head_model(run.boxes, run.head)
            self._state = rest_state(run.head).reshape(-1)
            self._memo = fresh_memo().reshape(-1)

    def cycles(self) -> Iterator[Cycle]:
        """Run from tick 0 to the end.

        Raises CalibrationError when free whisking touched something, PlantError for a path that
        the arm can't follow, and RunError when the controller's commands keep being altered during
        calibration.
        """
        run, period = self.run, self.run.period_ticks
        calibrator: Calibrator | None = Calibrator(run.calibration_cycles, period)
        spoilt = 0
        for first in range(0, run.ticks, period):
            ticks = min(period, run.ticks - first)
            theta, x, y, applied, command = self._buffer[:, :ticks]
            before = command[-1].copy() if first else applied[0] * 0
            poses = self._trajectory.poses(first, ticks)
            self._deepest[:] = 0.0
            self._slips[:] = 0
            if self._law is None:
                self._advance_python(first, ticks, poses)
            else:
                self._advance(first, ticks, poses)
            calibrating, calibration = calibrator is not None, None
            if calibrator is not None and ticks == period:
                if _disturbed(before, applied, command):
                    spoilt += 1
                    if spoilt == MOST_ATTEMPTS:
                        raise RunError(f"calibration: given up after {MOST_ATTEMPTS} cycles")
                else:
                    calibrator.update(x, y)
                    if calibrator.complete:
                        calibration, calibrator = calibrator.result(), None
                        run.controller.calibrate(calibration)
                        self._trajectory.depart(first + ticks)
            arm_tick = (first + ticks - 1) // ARM_PERIOD * ARM_PERIOD
            yield Cycle(
                number=first // period,
                first_tick=first,
                last_tick=first + ticks - 1,
                complete=ticks == period and self._ruled(first + ticks - 1),
                calibrating=calibrating,
                calibration=calibration,
                theta=theta,
                x=x,
                y=y,
                applied=applied,
                command=command,
                arm_tick=arm_tick,
                pose=poses[arm_tick // ARM_PERIOD - first // ARM_PERIOD] if arm_tick else None,
                impingement=self._deepest,
                slips=self._slips,
            )

    def _ruled(self, tick: int) -> bool:
        """Whether the controller had the drives up to this tick."""
        return bool(self._active[0]) and tick < self.run.retract_tick

    def _advance(self, first: int, ticks: int, poses: Float64s) -> None:
        run = self.run
        controller = run.controller
        assert isinstance(controller, LawController) and self._law is not None
        if first == 0:
            controller.activate(0, self._last, self._last)
        failed = _whisk(
            self._law,
            first,
            ticks,
            run.retract_tick,
            poses,
            self._state,
            self._memo,
            self._model,
            run.seed,
            controller.parameters,
            controller.state,
            self._retract.parameters,
            self._retract.state,
            self._travel,
            run.slew_limit,
            self._last,
            self._active,
            self._buffer,
            self._deepest,
            self._slips,
        )
        if failed != OK:
            what = "a command not finite" if failed == COMMAND_NOT_FINITE else "a pose out of range"
            raise PlantError(f"head plant, ticks {first} to {first + ticks - 1}: {what}")

    def _advance_python(self, first: int, ticks: int, poses: Float64s) -> None:
        run, controller, state = self.run, self.run.controller, self._plant.state
        given = np.zeros(WHISKERS, dtype=np.float32)
        for j in range(ticks):
            tick = first + j
            k = tick // ARM_PERIOD - first // ARM_PERIOD
            x, y, z, yaw = poses[k] + (poses[k + 1] - poses[k]) * (tick % ARM_PERIOD / ARM_PERIOD)
            held = state[GAMMA].copy()
            applied = self._last.copy()
            sample = self._plant.step(tick, (x, y, z, yaw), applied if tick else None)
            np.maximum(self._deepest, np.abs(state[GAMMA]), out=self._deepest)
            self._slips += held - state[GAMMA] > SLIP
            if tick == 0:
                controller.activate(tick, applied, sample[0])
            command = controller.step(tick, *sample)
            self._buffer[:, j] = *sample, applied, command
            _route(
                self._buffer[COMMANDED, j],
                tick < run.retract_tick,
                self._travel,
                run.slew_limit,
                self._last,
                self._active,
                self._retract.parameters,
                self._retract.state,
                given,
            )


def _disturbed(before: Float32s, applied: Float32s, command: Float32s) -> bool:
    """Whether the drives were ever kept from what was commanded in the tick before."""
    wanted = np.concatenate((before[None], command[:-1]))
    return bool(np.abs(applied - wanted).max() > DISTURBANCE)


@compiled
def _route(
    command: Float32s,
    rules: bool,
    travel: Float32s,
    slew: float,
    last: Float32s,
    active: NDArray[np.bool_],
    retract_parameters: Float64s,
    retract_state: Float64s,
    given: Float32s,
) -> None:
    """The arbiter's answer to a command that is on time: `last` becomes what the drives are given.

    Without `rules`, or for a command that no drive may get, they are retracted from then on.
    """
    if active[0] and rules and check_command(command, travel)[0] == ADMITTED:
        for i in range(last.shape[0]):
            given[i] = slewed(np.float64(command[i]), last[i], slew)
    else:
        if active[0]:
            active[0] = False
            retract_state[LAST] = last
        retract_command(0, last, last, last, retract_parameters, retract_state, given)
    last[:] = given


@compiled
def _whisk(
    law: int,
    first: int,
    ticks: int,
    retract_tick: int,
    poses: Float64s,
    state: Float64s,
    memo: Float64s,
    model: HeadModel,
    seed: int,
    parameters: Float64s,
    law_state: Float64s,
    retract_parameters: Float64s,
    retract_state: Float64s,
    travel: Float32s,
    slew: float,
    last: Float32s,
    active: NDArray[np.bool_],
    signals: Float32s,
    deepest: Float64s,
    slips: Int64s,
) -> int:
    """Ticks first .. first + ticks - 1 of the closed loop; a status of `head_step`.

    last float32[18]: what the drives were given; active bool[1]: whether the controller has them;
    signals float32[5, >= ticks, 18]: theta, x, y, applied, command.
    """
    pose = np.empty(4, dtype=np.float64)
    held = np.empty(WHISKERS, dtype=np.float64)
    given = np.empty(WHISKERS, dtype=np.float32)
    theta = np.empty(WHISKERS, dtype=np.float32)
    x, y, command = np.empty_like(theta), np.empty_like(theta), np.empty_like(theta)
    for j in range(ticks):
        tick = first + j
        k = tick // ARM_PERIOD - first // ARM_PERIOD
        part = (tick % ARM_PERIOD) / ARM_PERIOD
        for a in range(4):
            pose[a] = poses[k, a] + (poses[k + 1, a] - poses[k, a]) * part
        for i in range(WHISKERS):
            held[i] = state[at(GAMMA, i)]
        status = head_step(state, memo, model, True, seed, tick, pose, last, tick == 0, theta, x, y)
        if status != OK:
            return status
        for i in range(WHISKERS):
            gamma = state[at(GAMMA, i)]
            deepest[i] = max(deepest[i], abs(gamma))
            slips[i] += 1 if held[i] - gamma > SLIP else 0

        if law == OPEN_LOOP:
            open_loop_command(tick, theta, x, y, parameters, law_state, command)
        elif law == RCP:
            rcp_command(tick, theta, x, y, parameters, law_state, command)
        else:
            social_command(tick, theta, x, y, parameters, law_state, command)

        for i in range(WHISKERS):
            signals[SAMPLED_THETA, j, i] = theta[i]
            signals[SAMPLED_X, j, i] = x[i]
            signals[SAMPLED_Y, j, i] = y[i]
            signals[APPLIED, j, i] = last[i]
            signals[COMMANDED, j, i] = command[i]
        _route(
            command, tick < retract_tick, travel, slew, last, active, retract_parameters,
            retract_state, given,
        )  # fmt: skip
    return OK
