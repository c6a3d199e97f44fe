"""A process that stands between a device and the bus: what the device says becomes messages.

It takes the place of `rig` where a device is real or emulated. It is no node: what it publishes is
a recorded input of the run, and every decision it takes about the device is a `rig.event`. It opens
its device while the run warms up, reads it from then on, and lets nothing move before the start.
Nodes may share its process: they and the device then hear each other in memory.
"""

from __future__ import annotations

import collections
import signal
import time
import traceback
from abc import abstractmethod
from typing import Any, Final

from vibrissa.messages.codec import CODECS, Message, decode, header
from vibrissa.messages.errors import DecodeError, MessageError
from vibrissa.messages.types import TICK_NS, DeviceClock, Event
from vibrissa.processes.config import Experiment
from vibrissa.processes.hosted import TELEMETRY_NS, Hosted, wanted
from vibrissa.processes.layout import Layout
from vibrissa.processes.member import Member, telemetry
from vibrissa.processes.node import Step
from vibrissa.processes.rehearsal import rehearse
from vibrissa.processes.results import RunError, one_line
from vibrissa.processes.stats import Clocking
from vibrissa.processes.table import DEVICES, ROWS
from vibrissa.rig.devices.arm import ArmDevice
from vibrissa.rig.devices.clock import ClockRelation
from vibrissa.rig.devices.errors import DeviceError
from vibrissa.rig.devices.head import HeadDevice
from vibrissa.rig.devices.watch import Watch

PARTING_S: Final = 0.02


class Pump(Member):
    """One device of a live run. A subclass opens and reads it, and takes what the bus says."""

    device: HeadDevice | ArmDevice
    watch: Watch

    def __init__(self, who: str, layout: Layout) -> None:
        """who: the row of the device; its process may host nodes, too."""
        self.who = who
        self.experiment = Experiment.model_validate_json(layout.experiment)
        name, members = next((p, nodes) for p, nodes in layout.hosts.items() if who in nodes)
        nodes = [n for n in members if n != who]
        for node in nodes:
            rehearse(node, self.experiment)
        priority, cores = wanted([DEVICES[who], *(ROWS[n] for n in nodes)])
        super().__init__(name, layout, priority if self.experiment.run.realtime else 0, cores)
        self.nodes = Hosted(nodes, self.experiment, self.port.publish, self._overhear)
        self._hears = {topic.encode() for topic in DEVICES[who].hears}
        self._lost = self._nodes_failed = False
        self._trouble: DeviceError | None = None
        self.sent: collections.Counter[str] = collections.Counter()
        self.clock = Clocking()
        self.last_tick = self.experiment.ticks
        self.tick = 0
        self.steps = 0
        self._accounted = 0

    def run(self) -> None:
        """Open, barrier, loop, farewell; SystemExit when the device can't be used."""
        try:
            self._prepare()
        except (DeviceError, RunError) as error:
            self.control.say("fault", cause=str(error)[:400])
            self.leave()
            raise SystemExit(2) from None
        cpu = time.process_time()
        try:
            while not self.stopping:
                self.turn()
                self.housekeep()
        except DeviceError as error:
            self._lose(str(error))
        except Exception as error:
            traceback.print_exc()
            self._lose(f"{type(error).__name__}: {error}")
        finally:
            self.device.close()
        self._see_out()
        self._account()
        self.nodes.hand_in(final=True)
        self.port.flush()
        self.control.say(
            "bye",
            sent=dict(self.sent + self.nodes.sent()),
            stats={self.who: self.clock.summary()} | self.nodes.stats(),
            cpu_s=time.process_time() - cpu,
            counters={self.who: self.counters()} | self.nodes.counters(),
        )
        self.control.wait_to_leave(self.parent)
        self.leave()

    def _prepare(self) -> None:
        """Open the device, wait for the others and for the go, reading on meanwhile."""
        self.device.open()
        try:
            self.opened()
            heard = self.layout.audience(self.name)
            waiting = self.control.wait_for_go(self.parent, self.port.subscribers, heard)
            while True:
                next(waiting)
                self.drain()
        except StopIteration as end:
            self.t0 = self.nodes.t0 = end.value
        except BaseException:
            self.device.close()
            raise

    @abstractmethod
    def opened(self) -> None:
        """Look at the open device before anything may move. Raises DeviceError or RunError."""

    @abstractmethod
    def drain(self) -> None:
        """Take what the device says before the run, for nobody."""

    @abstractmethod
    def turn(self) -> None:
        """Wait a little, read the device, hear the bus, look after both."""

    @abstractmethod
    def heard(self, message: Message) -> None:
        """Take a message of the bus that is no decision about the run."""

    @abstractmethod
    def halt(self, cause: str) -> None:
        """Bring what moves to rest; never raises."""

    @abstractmethod
    def counters(self) -> dict[str, int]:
        """What the summary says of the device."""

    @property
    def now(self) -> int:
        """The present tick of the host's clock."""
        return max((time.monotonic_ns() - self.t0) // TICK_NS, 0)

    def hear(self) -> None:
        """Take everything that was said on the bus; nodes of this process come first."""
        while (frame := self.port.receive(0)) is not None:
            if not self.gate.admits(frame):
                continue
            try:
                self._feed(frame)
                message = decode(frame) if _topic(frame) in self._hears else None
            except DecodeError as error:
                self.gate.refuse(header(frame)[1], str(error))
                continue
            if message is not None:
                self._take(message)

    def _feed(self, frame: bytes) -> None:
        """Have the nodes of this process hear a frame, and the device what they say to that.

        A node that fails ends all of them, and the run. Raises DeviceError when the device could
        not do what they said, once everybody has heard it.
        """
        if self._nodes_failed:
            return
        try:
            self.nodes.feed(frame)
        except DecodeError:
            raise
        except MessageError as error:
            self._end_nodes(str(error))
        except Exception as error:
            traceback.print_exc()
            self._end_nodes(f"{type(error).__name__}: {error}")
        if self._trouble is not None:
            trouble, self._trouble = self._trouble, None
            raise trouble

    def _end_nodes(self, cause: str) -> None:
        self._nodes_failed = True
        self.control.say("fault", cause=cause[:400])
        self.give_up(cause)

    def _overhear(self, _frame: bytes, step: Step) -> None:
        """What a node of this process has just said reaches the device before anything else."""
        for output in step.outputs:
            if _topic(output) in self._hears:
                try:
                    self._take(decode(output))
                except DeviceError as error:
                    self._trouble = self._trouble or error

    def _take(self, message: Message) -> None:
        if message.topic not in ("run.event", "rig.event"):
            if not self._lost:
                self.heard(message)
            return
        event: Event = message.body
        if event.kind in ("retract", "stop"):
            self.watch.stop(event.cause)
            self.halt(event.cause)
            self.stopping |= message.topic == "run.event" and event.kind == "stop"
        elif message.topic == "run.event" and not self._lost:
            self.heard(message)

    def _lose(self, cause: str) -> None:
        """Go on without the device, which is not to be used any more."""
        self._lost = True
        self.give_up(cause)

    def _see_out(self) -> None:
        """Nodes of this process take the last decisions of the run even if the device is lost."""
        while self.nodes.names and not (self.stopping or self._nodes_failed):
            self.port.wait(-1, PARTING_S)
            self.hear()
            self.housekeep()

    def give_up(self, cause: str) -> None:
        """Stop for good, and tell everybody: whiskers retract, the arm brakes, the run ends."""
        if self.watch.stop(cause):
            self.halt(cause)
            self.report("retract", cause)

    def look(self, now: int) -> None:
        """Give up when something that must keep coming is overdue."""
        if self.watch.look(now):
            self.halt(self.watch.cause)
            self.report("retract", self.watch.cause)

    def report(self, kind: str, cause: str) -> None:
        """Say what happened to the device, for every node and the log."""
        self.say("rig.event", Event(self.tick, kind, self.who, one_line(cause)))

    def say(self, topic: str, body: Any) -> None:
        """Say something in the name of the device, to the bus and to the nodes of this process."""
        self._feed(self.publish(topic, body))

    def publish(self, topic: str, body: Any) -> bytes:
        """Put something on the bus in the name of the device; gives the frame."""
        seq = self.sent[topic]
        self.sent[topic] += 1
        frame = CODECS[topic].encode(self.who, 0, seq, self.tick * TICK_NS, body)
        self.port.publish(frame)
        return frame

    def say_clock(self, device: str, relation: ClockRelation, device_ns: int) -> int:
        """Publish how the device's clock reads on the host's; gives the host's ns since t0."""
        host_ns = relation.host_ns(device_ns) - self.t0
        drift = max(-1.0, min(relation.drift, 1.0))
        self.say("rig.clock", DeviceClock(device, self.tick, device_ns, host_ns, drift))
        return host_ns

    def progress(self) -> tuple[int, int]:
        return self.tick * TICK_NS, self.steps + self.nodes.steps

    def look_after(self) -> None:
        self.nodes.hand_in(final=False)
        if not self._lost:
            self.look_at_device()
        now = time.monotonic_ns()
        if now - self._accounted > TELEMETRY_NS:
            self._accounted = now
            self._account()

    def orphaned(self) -> None:
        self.give_up("supervisor gone")
        if not self._nodes_failed:
            self.nodes.inject("stop", "supervisor gone")

    def look_at_device(self) -> None:
        """Some twenty times a second."""

    def _account(self) -> None:
        self.say("node.telemetry", telemetry(self.clock, self.steps))


def _topic(frame: bytes) -> bytes:
    return frame[: frame.find(b"\0")]


def main(name: str, layout: Layout) -> None:
    """Entry point of a device process."""
    from vibrissa.processes.arm_device import ArmPump
    from vibrissa.processes.head_device import HeadPump

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    (HeadPump if "head-device" in layout.hosts[name] else ArmPump)(layout).run()
