"""The topic table: one of the two tables from which the rest of the system is derived."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from vibrissa.messages import types


@dataclass(frozen=True, slots=True)
class Topic:
    """One row: what travels under a name.

    rate is nominal in Hz, 0 for now and then. `producer` is a process name, or "any". `recorded`
    messages are in every log; `compared` ones must come out identical in a re-run.
    """

    name: str
    type: type[types.Body]
    rate: float
    producer: str
    recorded: bool = True
    compared: bool = True


_ROWS: Final = (
    Topic("rig.sample", types.HeadReading, 2000, "rig"),
    Topic("rig.arm", types.ArmReading, 125, "rig"),
    Topic("rig.event", types.Event, 0, "rig"),
    Topic("rig.clock", types.DeviceClock, 0, "rig", compared=False),
    Topic("head.sample", types.HeadSample, 2000, "sampler"),
    Topic("head.command", types.HeadCommand, 2000, "sampler"),
    Topic("whisk.command", types.WhiskCommand, 2000, "whisk"),
    Topic("whisk.cycle", types.WhiskCycle, 1, "whisk"),
    Topic("whisk.calibration", types.WhiskCalibration, 0, "whisk"),
    Topic("whisk.failure", types.Event, 0, "whisk"),
    Topic("arm.state", types.ArmState, 125, "arm"),
    Topic("arm.setpoint", types.ArmSetpoint, 125, "arm"),
    Topic("slam.view", types.SlamView, 1, "slam"),
    Topic("slam.pose", types.SlamPose, 1, "slam"),
    Topic("slam.owner", types.Ownership, 0, "slam"),
    Topic("slam.history", types.SlamHistory, 0, "slam"),
    Topic("slam.map", types.SlamMap, 0.1, "slam"),
    Topic("eval.metrics", types.Metrics, 0.1, "slam"),
    Topic("run.event", types.Event, 0, "supervisor"),
    Topic("run.order", types.Order, 0, "supervisor"),
    Topic("run.calibration", types.WhiskCalibration, 0, "supervisor"),
    Topic("head.owner", types.Ownership, 0, "sampler"),
    Topic("head.shadow", types.ShadowStatus, 1, "sampler"),
    Topic("node.answer", types.Answer, 0, "any"),
    Topic("node.event", types.Event, 0, "any"),
    Topic("host.event", types.Event, 0, "any", compared=False),
    Topic("host.timer", types.TimerTick, 2000, "any", recorded=False, compared=False),
    Topic("node.receipt", types.Receipt, 20, "any", compared=False),
    Topic("node.telemetry", types.Telemetry, 1, "any", compared=False),
)

TOPICS: Final[dict[str, Topic]] = {row.name: row for row in _ROWS}
