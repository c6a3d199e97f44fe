"""The arm's process: states of the arm become `rig.arm`, set-points go down to it.

Before the run the whole path is judged by the arm's own limits and joints. The arm is enabled by
the operator's start and by nothing else; whatever stops it, stops it for the rest of the run.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Final

import numpy as np

from vibrissa.control.arm_path import ArmPath
from vibrissa.messages.codec import Message
from vibrissa.messages.types import TICK_NS, ArmReading, DeviceClock
from vibrissa.processes.arm import make_path
from vibrissa.processes.layout import Layout
from vibrissa.processes.pump import Pump
from vibrissa.processes.results import RunError
from vibrissa.rig.devices.addresses import make_arm
from vibrissa.rig.devices.arm import ArmReport, State
from vibrissa.rig.devices.clock import CycleTicks
from vibrissa.rig.devices.emulation import PoseMouth
from vibrissa.rig.devices.errors import DeviceError, DeviceLimit
from vibrissa.rig.devices.limits import ARM, Pose
from vibrissa.rig.devices.watch import Phase, Watch

WAIT_S: Final = 0.02
VIRTUAL_WAIT_S: Final = 0.002
"""A virtual arm has nothing to wait on."""
REMEDY: Final = "a shorter run, another arm.sequence, or arm.unwind = true"


class ArmPump(Pump):
    """Owns the arm device of a run."""

    def __init__(self, layout: Layout) -> None:
        super().__init__("arm-device", layout)
        rig = self.experiment.rig
        self.watch = Watch({"news of the head": rig.news_ticks})
        self._path = make_path(self.experiment)
        self.device = self._arm = make_arm(
            layout.devices["arm"],
            start=self._path.pose(0),
            limits=ARM.within(stale=rig.state_ticks, setpoint=rig.setpoint_ticks),
        )
        tell = layout.devices.get("tell")
        self._mouth = PoseMouth(int(tell)) if tell else None
        self._head_clock: DeviceClock | None = None
        self._cycles: CycleTicks
        self._said = 0
        self._asked = False

    def opened(self) -> None:
        """Judge the path that this run will travel. Raises RunError naming a remedy."""
        self._cycles = CycleTicks(self._arm.info.period)
        try:
            self._arm.check(travelled(self._path, self.last_tick, self._arm.info.period))
        except DeviceLimit as error:
            x, y, z, yaw = self._path.pose(0)
            begin = f"the path begins at x {x:.4f}, y {y:.4f}, z {z:.4f} m, yaw {yaw:.4f} rad"
            helps = f"what helps: {REMEDY}" if " joint" in str(error) else begin
            raise RunError(f"rig.arm {self._arm.name}: {error}; {helps}") from None

    def drain(self) -> None:
        while (report := self._arm.read(0)) is not None:
            self._tell(report.pose)

    def turn(self) -> None:
        wire = self._arm.fileno()
        if wire >= 0:
            self.port.wait(wire, WAIT_S)
        report = self._arm.read(0 if wire >= 0 else VIRTUAL_WAIT_S)
        while report is not None:
            self._moved(report)
            report = self._arm.read(0)
        self.hear()
        if self._asked and time.monotonic_ns() >= self.t0:
            self._start()
        self.look(self.now)
        if self.watch.may_move and self._arm.state is not State.MOVING:
            self.give_up(f"{self._arm.name}: {self._arm.state.value}: {self._arm.cause}")

    def heard(self, message: Message) -> None:
        match message.topic:
            case "arm.setpoint" if self.watch.may_move:
                x, y, z, yaw = message.body.pose.tolist()
                try:
                    self._arm.write(message.body.tick, (x, y, z, yaw))
                except DeviceError as error:
                    self.give_up(str(error))
            case "rig.clock":
                if message.body.device == "head":
                    self._head_clock = message.body
                    self.watch.seen("news of the head", self.now)
            case "run.event" if message.body.kind == "start":
                self._asked = True

    def halt(self, cause: str) -> None:
        self._arm.stop(cause)

    def counters(self) -> dict[str, int]:
        return dataclasses.asdict(self._arm.counters)

    def look_at_device(self) -> None:
        if self._said:
            stamp = round(self._arm.report.stamp * 1e9)
            self.say_clock("arm", self._arm.clock, stamp)

    def _start(self) -> None:
        """The operator's start: only here is the arm enabled."""
        if self.watch.phase is not Phase.WAITING:
            return
        try:
            self._arm.enable()
        except DeviceError as error:
            self.give_up(str(error))
            return
        self.drain()  # states of that time need no answer
        self.hear()  # set-points of that time lapse, and a stop wins
        if not self.watch.start(self.now):
            self.halt(self.watch.cause)
            return
        who = f"{self._arm.info.name}, controller {self._arm.info.version}"
        self.report("enabled", f"{self._arm.name}: {who}: set-points go through from here on")

    def _moved(self, report: ArmReport) -> None:
        self._tell(report.pose)
        now = self._tick_at(report.host_ns - self.t0)
        if now < 0:
            return
        rate = _rate(self._arm.clock.drift) / self._head_rate
        tick = self._cycles.tick(report.stamp, now, rate)
        if tick > self.last_tick:
            self.watch.stop("the run is over")
            self.halt("the run is over")
            return
        self.tick = tick
        self.say("rig.arm", ArmReading(tick, np.array(report.pose, np.float64)))
        self._said += 1
        self.steps += 1

    def _tick_at(self, host_ns: int) -> int:
        """The head's tick at a time of the host, ns since t0."""
        clock = self._head_clock
        if clock is None:
            return host_ns // TICK_NS
        return clock.tick + round((host_ns - clock.host_ns) / (TICK_NS * self._head_rate))

    @property
    def _head_rate(self) -> float:
        """How much faster the host's clock runs than the head's; 1 until that is known."""
        return _rate(self._head_clock.drift) if self._head_clock else 1.0

    def _tell(self, pose: Pose) -> None:
        """An emulated head must feel the walls where this arm carries it."""
        if self._mouth is not None:
            self._mouth.tell(pose)


def _rate(drift: float) -> float:
    """The rate of a drift; no clock that is of use is off by more than half."""
    return 1.0 + min(max(drift, -0.5), 0.5)


def travelled(path: ArmPath, ticks: int, period: float) -> list[Pose]:
    """The poses of a path that a run of so many ticks can reach, one per period (s) of the arm."""
    step = round(period * 1e9)
    end = min(ticks * TICK_NS, path.duration_ns) + step
    return [(x, y, z, yaw) for x, y, z, yaw in path.poses(np.arange(0, end, step)).tolist()]
