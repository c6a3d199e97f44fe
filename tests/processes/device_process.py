"""A device's process on a bus and on time of the test's own: no sockets, no waiting."""

from __future__ import annotations

import collections
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.devices.stepped import TICK_NS, HandClock, MutableArm, stepped_head
from vibrissa.messages.codec import CODECS, Message, decode
from vibrissa.messages.types import ArmSetpoint, DeviceClock, Event, HeadCommand
from vibrissa.processes import arm_device, head_device, hosted, member, pump
from vibrissa.processes.arm import make_path
from vibrissa.processes.arm_device import ArmPump
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.head_device import HeadPump
from vibrissa.processes.layout import Layout
from vibrissa.processes.table import ALL_SLOTS, DEVICES, PROCESSES
from vibrissa.rig.devices.limits import ArmLimits, Pose

ZERO = np.zeros(18, np.float32)
LEAD_NS = 100_000_000


class Bus:
    """The process's port and control line, and the rest of the run behind them.

    said: what the process published; frames: all that was said; control: what it told its
    supervisor.
    """

    def __init__(self, clock: HandClock) -> None:
        self.clock = clock
        self.said: list[Message] = []
        self.frames: list[bytes] = []
        self.control: list[tuple[str, dict[str, Any]]] = []
        self.t0 = 0
        self._inbox: collections.deque[bytes] = collections.deque()
        self._seq: collections.Counter[tuple[str, str]] = collections.Counter()

    def tell(self, topic: str, source: str, body: Any) -> None:
        """Something that the process hears."""
        seq = self._seq[topic, source]
        self._seq[topic, source] += 1
        frame = CODECS[topic].encode(source, 0, seq, max(self.tick, 0) * TICK_NS, body)
        self.frames.append(frame)
        self._inbox.append(frame)

    def decide(self, kind: str, cause: str = "because") -> None:
        """The supervisor's word."""
        self.tell("run.event", "supervisor", Event(max(self.tick, 0), kind, "supervisor", cause))

    @property
    def tick(self) -> int:
        return (self.clock.ns - self.t0) // TICK_NS

    def of(self, topic: str) -> list[Any]:
        """Bodies of what was said of a topic."""
        return [m.body for m in self.said if m.topic == topic]

    def events(self, *kinds: str) -> list[Event]:
        """Its rig.events of these kinds."""
        return [e for e in self.of("rig.event") if e.kind in kinds]

    # the port

    def wait(self, other: int, timeout: float) -> None:
        self.clock.sleep(TICK_NS * 1e-9)

    def receive(self, timeout: float) -> bytes | None:
        return self._inbox.popleft() if self._inbox else None

    def publish(self, frame: bytes) -> None:
        self.frames.append(frame)
        self.said.append(decode(frame))

    def subscribers(self) -> dict[str, int]:
        return {}

    def flush(self) -> None:
        pass

    def close(self) -> None:
        pass

    # the control line

    def say(self, kind: str, **fields: Any) -> None:
        self.control.append((kind, fields))

    def wait_for_go(self, *_: object) -> Iterator[None]:
        yield
        self.t0 = self.clock.ns + LEAD_NS
        self.decide("start")
        return self.t0  # type: ignore[return-value]

    def wait_to_leave(self, parent: int) -> None:
        pass


class World:
    """One run of one device process, from its opening to its farewell; it may host nodes."""

    def __init__(
        self,
        patch: pytest.MonkeyPatch,
        experiment: Experiment,
        name: str,
        nodes: tuple[str, ...] = (),
    ) -> None:
        self.clock = HandClock()
        self.clock.put_into(patch, member, hosted, pump, head_device, arm_device)
        self.bus = Bus(self.clock)
        patch.setattr(member, "ControlLine", lambda *_: self.bus)
        patch.setattr(member, "ZmqPort", lambda *_, **__: self.bus)
        patch.setattr(member.realtime, "prepare", lambda *_: [])
        patch.setattr(pump, "rehearse", lambda *_: None)
        others = [n for n in (*DEVICES, *PROCESSES) if n not in ("rig", name, *nodes)]
        hosts = {"+".join((name, *nodes)): [name, *nodes]} | {n: [n] for n in others}
        names = ("control", "supervisor", "recorder", *hosts, *ALL_SLOTS)
        self.layout = Layout(
            hosts=hosts,
            endpoints=dict.fromkeys(names, "ipc:///nowhere"),
            experiment=experiment.model_dump_json(),
            log="",
            metadata={},
            devices={"head": "can:virtual:test", "arm": "virtual"},
        )
        self.patch = patch
        self.experiment = experiment
        self.name = name
        self.end = experiment.ticks + 400
        self.orders: dict[int, Callable[[], object]] = {}
        self.clock.lives.append(self.live)

    def live(self) -> None:
        """The rest of the run, in every tick; orders are carried out at their tick, once."""
        if not self.bus.t0:
            return
        for tick in [t for t in self.orders if t <= self.bus.tick]:
            self.orders.pop(tick)()
        if self.bus.tick == self.end:
            self.bus.decide("stop")

    def leave_alone(self) -> None:
        """The process that started this one is no more."""
        self.patch.setattr(os, "getppid", lambda: 1)

    def run(self) -> Bus:
        """The whole life of the process."""
        made: HeadPump | ArmPump
        made = HeadPump(self.layout) if self.name == "head-device" else ArmPump(self.layout)
        made.run()
        return self.bus


class HeadWorld(World):
    """A head's process; the sampler answers every sample at once, until it is told not to.

    nodes: those that share its process, the sampler among them if there are any.
    """

    def __init__(
        self,
        patch: pytest.MonkeyPatch,
        folder: Path,
        rig: str = "",
        *arguments: str,
        nodes: tuple[str, ...] = (),
    ) -> None:
        super().__init__(patch, loaded(folder, rig), "head-device", nodes)
        self.head, self.far_end = stepped_head(self.clock, f"{id(self)}", *arguments)
        patch.setattr(head_device, "make_head", lambda *_, **__: self.head)
        self.answering = not nodes
        self._answered = 0

    def live(self) -> None:
        super().live()
        fresh = self.bus.said[self._answered :]
        self._answered = len(self.bus.said)
        for message in fresh if self.answering else ():
            if message.topic == "rig.sample":
                body = HeadCommand(message.body.tick, "test", ZERO)
                self.bus.tell("head.command", "sampler", body)

    def run(self) -> Bus:
        try:
            return super().run()
        finally:
            self.far_end.close()


class ArmWorld(World):
    """An arm's process; set-points answer states along x, and the head has news, until not."""

    def __init__(self, patch: pytest.MonkeyPatch, folder: Path, rig: str = "") -> None:
        experiment = loaded(folder, rig)
        super().__init__(patch, experiment, "arm-device")
        self.goal: Pose = make_path(experiment).pose(0)
        self.speed = 0.0  # m/s
        self.drift = 0.0  # of the head's clock
        self.guiding = self.news = True

        def make(_url: str, *, start: Pose, limits: ArmLimits) -> MutableArm:
            self.arm = MutableArm(start, limits=limits)
            return self.arm

        patch.setattr(arm_device, "make_arm", make)
        self._answered = 0

    def live(self) -> None:
        super().live()
        tick = self.bus.tick
        if self.news and tick >= 0 and tick % 100 == 0:
            sample = round(tick / (1 + self.drift))
            told = DeviceClock("head", sample, sample * TICK_NS, tick * TICK_NS, self.drift)
            self.bus.tell("rig.clock", "head-device", told)
        fresh = self.bus.said[self._answered :]
        self._answered = len(self.bus.said)
        for message in fresh if self.guiding else ():
            if message.topic == "rig.arm":
                self.guide(message.body.tick)

    def guide(self, tick: int) -> None:
        """The set-point that answers the state of a tick."""
        x, y, z, yaw = self.goal
        self.speed = min(self.speed + 0.004, 0.05) if self.bus.events("enabled") else 0.0
        self.goal = x + self.speed * 0.008, y, z, yaw
        self.bus.tell("arm.setpoint", "arm", ArmSetpoint(tick, np.array(self.goal)))


def loaded(folder: Path, rig: str) -> Experiment:
    """Two seconds, with these lines in [rig]."""
    path = folder / "device.toml"
    path.write_text(f'[run]\nduration = 2.0\n[rig]\nhead = "can:virtual:test"\n{rig}\n')
    return load_experiment(path)
