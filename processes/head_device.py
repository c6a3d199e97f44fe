"""The head's process: samples of a head on a wire become `rig.sample`, commands go down to it.

The head's own clock drives the run: tick n is its n-th sample after tick 0 was due, lost ones
included. Samples that are missing are told as a `rig.event` before the next one.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Final

from vibrissa.messages.codec import Message
from vibrissa.messages.types import TICK_NS, HeadReading
from vibrissa.processes.arm import make_path
from vibrissa.processes.layout import Layout
from vibrissa.processes.pump import Pump
from vibrissa.processes.rig import head_params
from vibrissa.rig.devices.addresses import make_head
from vibrissa.rig.devices.errors import DeviceRefused
from vibrissa.rig.devices.head import Reading
from vibrissa.rig.devices.watch import Watch
from vibrissa.rig.maze import parse_maze
from vibrissa.rig.scene import wall_boxes

WAIT_S: Final = 0.01
VIRTUAL_WAIT_S: Final = 0.00025
"""A virtual head has nothing to wait on."""
PROBES: Final = 4096
MANY: Final = 200
"""Times the head is read in a row before the run."""


class HeadPump(Pump):
    """Owns the head device of a run."""

    def __init__(self, layout: Layout) -> None:
        super().__init__("head-device", layout)
        experiment = self.experiment
        rig = experiment.rig
        self.watch = Watch({"sample": rig.sample_ticks, "command": rig.command_ticks})
        self._pose = make_path(experiment).pose(0)
        url = layout.devices["head"]
        if url == "virtual":
            maze = parse_maze(experiment.maze.text, experiment.maze.file)
            self.device = self._head = make_head(
                url,
                boxes=wall_boxes(maze),
                pose=lambda: self._pose,
                seed=experiment.run.seed,
                params=head_params(experiment),
            )
        else:
            self.device = self._head = make_head(url)
        self._base: int | None = None
        self._next = 0
        self._due = (0, 0, 1.0)
        self._came_in = [0] * PROBES
        self._told = dataclasses.asdict(self._head.counters)

    def opened(self) -> None:
        """A calibration is of one head only."""
        made_for = self.experiment.whisk.calibrated_head
        if made_for and made_for != self._head.info.serial:
            raise DeviceRefused(
                f"{self._head.name}: whisk.calibration is of head {made_for}, "
                f"found head {self._head.info.serial}"
            )

    def drain(self) -> None:
        for _ in range(MANY):
            if not self._head.poll():
                return

    def turn(self) -> None:
        wire = self._head.fileno()
        if wire >= 0:
            self.port.wait(wire, WAIT_S)
        for reading in self._head.poll(0.0 if wire >= 0 else VIRTUAL_WAIT_S):
            self._sampled(reading)
        self.hear()
        if not self.done:
            self.look(self.now)

    def heard(self, message: Message) -> None:
        match message.topic:
            case "head.command":
                self._command(message)
            case "rig.arm":
                x, y, z, yaw = message.body.pose.tolist()
                self._pose = x, y, z, yaw
            case "run.event" if message.body.kind == "start":
                self.watch.start(self.now)
                self.report("opened", f"{self._head.name}: {self._head.info.describe()}")

    def halt(self, cause: str) -> None:
        """The sampler retracts; where no command comes any more, the head does by itself."""

    def counters(self) -> dict[str, int]:
        return dataclasses.asdict(self._head.counters)

    def look_at_device(self) -> None:
        if self._base is not None:
            device_ns = self._reading.device_us * 1000
            host_ns = self.say_clock("head", self._head.clock, device_ns)
            self._due = (self.tick, host_ns, 1.0 + self._head.clock.drift)
        found = self.counters()
        for what, kind in (("resets", "reset"), ("reconnects", "replugged")):
            if found[what] > self._told[what]:
                self.report(kind, f"{self._head.name}: {what}: {found[what]}")
        self._told = found

    def _sampled(self, reading: Reading) -> None:
        start = time.monotonic_ns()
        if self._base is None:
            if reading.host_ns < self.t0:
                return
            self._base = reading.sample
            self._due = (0, reading.host_ns - self.t0, 1.0)
        tick = reading.sample - self._base
        if tick >= self.last_tick:
            self.done = True
            return
        self.tick, self._reading = tick, reading
        if tick > self._next:
            lost = tick - self._next
            self.report("gap", f"{self._head.name}: {lost} samples lost before tick {tick}")
        self._next = tick + 1
        body = HeadReading(tick, reading.answers, reading.theta, reading.x, reading.y)
        self._came_in[tick % PROBES] = start
        frame = self.publish("rig.sample", body)
        self.steps += 1
        self.watch.seen("sample", self.now)
        at, due, scale = self._due
        expected = self.t0 + due + int((tick - at) * TICK_NS * scale)
        self.clock.tick(expected, start, time.monotonic_ns())
        self._feed(frame)

    def _command(self, message: Message) -> None:
        tick, now = message.body.tick, time.monotonic_ns()
        self._head.write(tick, message.body.command)
        self.watch.seen("command", self.now)
        came = self._came_in[tick % PROBES]
        if came and self.tick - tick < PROBES:
            self.clock.latency.add((now - came) * 1e-3)
