"""The process table: the second of the two tables from which the rest of the system is derived."""

from __future__ import annotations

import dataclasses
import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from vibrissa.messages.topics import TOPICS
from vibrissa.processes.realtime import Cores

if TYPE_CHECKING:
    from vibrissa.processes.config import Experiment
    from vibrissa.processes.node import Node

Pacing = Literal["timer", "arrival", "drain", "device"]
"""How a live host waits: for its own 2 kHz timer, for each message, a few ms at a time, or for what
its device says."""


@dataclass(frozen=True, slots=True)
class Process:
    """One row: a node, what it hears, what it says, and how it is hosted.

    priority is SCHED_FIFO's, 0 for the ordinary scheduler; who is waited for goes first. `source`
    marks a stand-in for hardware: what-if re-runs take its messages from the log instead of
    stepping it. `silence` is how many seconds without a sign of life end the run. The first topic
    it hears drives it; from that step's first output to the arrival of the topic `answer` with the
    same t is its reaction latency.
    """

    name: str
    node: str
    hears: tuple[str, ...]
    says: tuple[str, ...]
    pacing: Pacing
    priority: int
    cores: Cores = "others"
    silence: float = 2.0
    source: bool = False
    answer: str = ""


PROCESSES: Final[dict[str, Process]] = {
    row.name: row
    for row in (
        Process(
            "rig",
            "vibrissa.processes.rig:RigNode",
            hears=("host.timer", "head.command", "arm.setpoint", "run.event"),
            says=("rig.sample", "rig.arm", "rig.event", "rig.clock"),
            pacing="timer",
            priority=50,
            source=True,
        ),
        Process(
            "sampler",
            "vibrissa.processes.sampler:SamplerNode",
            hears=(
                "rig.sample",
                "whisk.command",
                "whisk.failure",
                "run.order",
                "run.event",
                "rig.event",
                "host.event",
            ),
            says=(
                "head.sample",
                "head.command",
                "head.owner",
                "head.shadow",
                "node.answer",
                "node.event",
            ),
            pacing="arrival",
            priority=46,
            cores="reflex",
            answer="whisk.command",
        ),
        Process(
            "whisk",
            "vibrissa.processes.whisk:WhiskNode",
            hears=("head.sample", "head.owner", "run.order", "run.calibration", "run.event"),
            says=(
                "whisk.command",
                "whisk.cycle",
                "whisk.calibration",
                "whisk.failure",
                "node.answer",
                "node.event",
            ),
            pacing="arrival",
            priority=48,
            cores="reflex",
        ),
        Process(
            "arm",
            "vibrissa.processes.arm:ArmNode",
            hears=(
                "rig.arm",
                "whisk.calibration",
                "run.order",
                "run.event",
                "rig.event",
                "host.event",
            ),
            says=("arm.state", "arm.setpoint", "node.answer", "node.event"),
            pacing="arrival",
            priority=40,
        ),
        Process(
            "slam",
            "vibrissa.processes.slam:SlamNode",
            hears=(
                "head.sample",
                "whisk.cycle",
                "whisk.calibration",
                "arm.state",
                "slam.pose",
                "run.order",
                "run.event",
            ),
            says=(
                "slam.view",
                "slam.pose",
                "slam.map",
                "slam.owner",
                "slam.history",
                "eval.metrics",
                "node.answer",
                "node.event",
            ),
            pacing="drain",
            priority=0,
            silence=60.0,  # the map of a long run takes its time
        ),
    )
}

SLOTS: Final[dict[str, Process]] = {
    name: dataclasses.replace(PROCESSES["whisk"], name=name, priority=44, cores="any")
    for name in (f"whisk.{number}" for number in range(1, 8))
}
"""Empty places for controllers that are loaded while a run goes on: whisk processes that give way
to the first one. Everybody who listens to controllers listens here from the start, so that a
newcomer needs nothing from the 2 kHz loop."""

SLAM_SLOTS: Final[dict[str, Process]] = {
    name: Process(
        name,
        "vibrissa.processes.slam_shadow:SlamShadowNode",
        hears=("slam.view", "slam.pose", "slam.history", "run.order", "run.event"),
        says=("slam.view", "slam.pose", "slam.map", "eval.metrics", "node.answer", "node.event"),
        pacing="drain",
        priority=0,
        silence=60.0,  # the map of a long run takes its time
    )
    for name in (f"slam.{number}" for number in range(1, 4))
}
"""Empty places for SLAMs beside the first one."""

ALL_SLOTS: Final = SLOTS | SLAM_SLOTS

DEVICES: Final[dict[str, Process]] = {
    row.name: row
    for row in (
        Process(
            "head-device",
            "vibrissa.processes.head_device:HeadPump",
            hears=("head.command", "rig.arm", "run.event"),
            says=("rig.sample", "rig.event", "rig.clock"),
            pacing="device",
            priority=50,
        ),
        Process(
            "arm-device",
            "vibrissa.processes.arm_device:ArmPump",
            hears=("arm.setpoint", "rig.clock", "rig.event", "run.event"),
            says=("rig.arm", "rig.event", "rig.clock"),
            pacing="device",
            priority=40,
            cores="any",
            silence=20.0,  # enabling an arm may take long; its own watchdog is what stops it
        ),
    )
}
"""What takes the place of `rig` when a device is real or emulated. They are no nodes: what they say
is a recorded input, like a person's order, and no re-run computes it."""

ROWS: Final = PROCESSES | ALL_SLOTS | DEVICES

RECORDER_PRIORITY: Final = 20
"""Above ordinary work, which would starve it on a busy machine."""
RECORDER_SILENCE: Final = 10.0
"""Seconds a recorder may be stopped before the run ends; publishers hold its messages meanwhile."""

PUBLISHED_BY_HOSTS: Final = ("host.event", "node.receipt", "node.telemetry")
"""What every host says beside its nodes."""


def build(name: str, experiment: Experiment) -> Node:
    """A fresh node of the table in its initial state, made from the experiment alone."""
    module, _, attribute = ROWS[name].node.partition(":")
    make = getattr(importlib.import_module(module), attribute)
    node: Node = make(experiment, name) if name in ALL_SLOTS else make(experiment)
    return node


def listeners(topic: str) -> list[str]:
    """The processes that hear a topic from others."""
    return [p.name for p in PROCESSES.values() if topic in p.hears]


def producers(topic: str) -> list[str]:
    """The processes that may say a topic."""
    if topic in PUBLISHED_BY_HOSTS:
        return list(ROWS)
    row = TOPICS[topic]
    if row.producer == "supervisor":
        return ["supervisor"]
    return [p.name for p in ROWS.values() if topic in p.says]
