"""Rehearsal: run a throw-away node through everything it will do, so that the real one is warm.

Imports, compilation, first allocations and page faults happen here, before tick 0. The rehearsed
node is made from a shortened experiment and thrown away; what it hears is made up.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from vibrissa.control.kinematics import NOSE_HEIGHT
from vibrissa.messages import types
from vibrissa.messages.codec import CODECS, Message
from vibrissa.messages.types import TICK_NS, WHISKERS
from vibrissa.processes.config import Experiment
from vibrissa.processes.node import Node, Stepper
from vibrissa.processes.results import RunError
from vibrissa.processes.table import ROWS, SLAM_SLOTS, SLOTS, build

TICKS = 1600
PERIOD = 400
ARM_TICKS = 16
FAILURE = b"whisk.failure\0"


def rehearse(name: str, experiment: Experiment, controller: str | None = None) -> None:
    """Step a throw-away copy of a node through a short made-up run.

    A slot is rehearsed as the run's first whisk process with the controller it is meant for.
    Raises RunError when the controller fails in it.
    """
    changes: dict[str, Any] = {"period": PERIOD / types.TICK_HZ, "calibration_cycles": 1}
    if name in SLOTS:
        name, changes["controller"] = "whisk", controller or experiment.whisk.controller
    short = experiment.model_copy(
        update={
            "run": experiment.run.model_copy(update={"duration": TICKS / types.TICK_HZ + 1}),
            "whisk": experiment.whisk.model_copy(update=changes),
        }
    )
    node = build(name, short)
    algorithm = controller or experiment.slam.algorithm
    if name == "slam" or name in SLAM_SLOTS:
        from vibrissa.processes.slams import warm  # a third of a second that nobody else needs

        warm(algorithm, experiment)
    if name in SLAM_SLOTS:
        order = types.Order(0, "assign", name, algorithm, "", -1, 0)
        node.step(Message("run.order", "supervisor", 0, 0, 0, order))
    rehearse_node(name, node)


def rehearse_node(name: str, node: Node) -> None:
    """Step a throw-away node as if it were `name` in a short run. Raises RunError if it fails."""
    stepper = Stepper(name, node)
    hears = set(ROWS[name].hears)
    for topic, source, seq, t, body in _made_up_run():
        if topic in hears:
            step = stepper.step(CODECS[topic].encode(source, 0, seq, t, body))
            for output in step.outputs:
                if output.startswith(FAILURE):
                    raise RunError(CODECS["whisk.failure"].decode(output).body.cause)


def _made_up_run() -> Iterator[tuple[str, str, int, int, Any]]:
    noise = np.random.Generator(np.random.Philox(1)).normal(0, 1e-5, (TICKS, 3, WHISKERS))
    yield "run.event", "supervisor", 0, 0, types.Event(0, "start", "supervisor", "rehearsal")
    for tick in range(TICKS):
        t = tick * TICK_NS
        theta, x, y = np.abs(noise[tick]).astype(np.float32)
        if tick > 2 * PERIOD and tick % PERIOD > PERIOD // 2:
            y = y + np.float32(1e-3)  # a touch
        command = np.zeros(WHISKERS, np.float32)
        yield "host.timer", "rig", tick, t, types.TimerTick(tick)
        yield "rig.sample", "rig", tick, t, types.HeadReading(tick, tick - 1, theta, x, y)
        sample = types.HeadSample(tick, tick - 1, theta, x, y, command)
        if tick == 0:
            yield "head.owner", "sampler", 0, t, types.Ownership(0, "whisk", 0)
        yield "head.sample", "sampler", tick, t, sample
        yield "whisk.command", "whisk", tick, t, types.WhiskCommand(tick, command)
        yield "head.command", "sampler", tick, t, types.HeadCommand(tick, "whisk", command)
        if tick % ARM_TICKS == 0:
            cycle = tick // ARM_TICKS
            pose = np.array([0.09 + 1e-4 * cycle, 0.09, NOSE_HEIGHT, 0.0])
            yield "rig.arm", "rig", cycle, t, types.ArmReading(tick, pose)
            yield "arm.state", "arm", cycle, t, types.ArmState(tick, pose, 1)
            yield "arm.setpoint", "arm", cycle, t, types.ArmSetpoint(tick + ARM_TICKS, pose)
        if (tick + 1) % PERIOD == 0:
            cycle = tick // PERIOD
            if cycle == 0:
                limit = np.full(WHISKERS, 2e-4, np.float32)
                calibration = types.WhiskCalibration(PERIOD, command, limit, limit, command, limit)
                yield "whisk.calibration", "whisk", 0, t, calibration
            whisked = types.WhiskCycle(cycle, tick + 1 - PERIOD, tick, int(cycle == 0), command)
            yield "whisk.cycle", "whisk", cycle, t, whisked
    end = TICKS * TICK_NS
    for kind in ("retract", "stop"):
        event = types.Event(TICKS, kind, "supervisor", "rehearsal")
        yield "run.event", "supervisor", 1, end, event
