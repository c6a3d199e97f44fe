"""The supervisor: starts the process table, holds the start barrier, watches, ends runs in order.

A run passes through these phases: warming (every process imports, compiles, rehearses, connects),
running, and, whatever ended it, retracting (whiskers retract, the arm holds), stopping (every node
takes the stop as its last input and hands in its receipts) and closing (the recorder writes out
what was sent). Ctrl-C, a fault, a silent or a dead process all lead through the same end, which
names the cause.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import json
import time
from pathlib import Path
from typing import Any, Final

import zmq

from vibrissa.messages.codec import CODECS, decode
from vibrissa.messages.errors import MessageError
from vibrissa.messages.transport import ZmqPort
from vibrissa.messages.types import TICK_HZ, TICK_NS, Event, Order, WhiskCalibration
from vibrissa.processes.children import Child, dead, start_process, summary
from vibrissa.processes.config import RETRACT_S, Experiment
from vibrissa.processes.control import ControlDesk
from vibrissa.processes.emulators import devices
from vibrissa.processes.gate import Gate
from vibrissa.processes.kinds import scheduled_slots
from vibrissa.processes.registry import listed
from vibrissa.processes.requests import Requests
from vibrissa.processes.results import OnProgress, Progress, RunError, one_line, silent
from vibrissa.processes.run_plan import layout_of_run, on_signals, run_folder
from vibrissa.processes.table import ALL_SLOTS

LEAD_S: Final = 0.25
"""From the go to tick 0."""
WARM_S: Final = 300.0
LOAD_S = 120.0
"""How long a newcomer may take to get ready while a run goes on."""
BYE_S: Final = 5.0
CLOSE_S: Final = 12.0
CATCH_UP_S: Final = 60.0
"""How long a node may take to finish what it heard before the run is stopped."""
CAUGHT_UP_TICKS: Final = 16
"""One arm cycle: the arm, at 125 Hz, is never nearer to the end than this."""
MOST_FRAMES: Final = 1000
"""Heard from the bus at a time."""
FLOOD: Final = 10_000
"""Refused frames after which a slot is ended."""
POLL_S: Final = 0.02
FATAL: Final = ("fault",)
"""Kinds of node.event that end a run."""


class Supervisor:
    """One live run, from the first process to the summary."""

    def __init__(
        self,
        experiment: Experiment,
        out: Path,
        on_progress: OnProgress = silent,
        *,
        start: bool = False,
    ) -> None:
        """start: the operator's start of real devices is given already."""
        self.experiment = experiment
        self.out = out
        self.on_progress = on_progress
        self.children: dict[str, Child] = {}
        self.lost: dict[str, Child] = {}
        self.left: list[Child] = []
        self.events: list[dict[str, Any]] = []
        self.sent: collections.Counter[str] = collections.Counter()
        self.cause: str | None = None
        self.requests = Requests(self)
        self.calibration: WhiskCalibration | None = None
        self._seq: collections.Counter[str] = collections.Counter()
        self._interrupted = 0
        self.started = start or not experiment.rig.real
        self.gate = Gate(limited=False)
        self._refused: collections.Counter[str] = collections.Counter()
        self.t0 = 0
        self._cpu0 = 0.0
        self._wall = 0.0

    def interrupt(self) -> None:
        """End the run in order, as its operator would."""
        self._interrupted += 1

    def run(self) -> dict[str, Any]:
        """The whole run. Raises RunError when it can't start; otherwise always gives a summary."""
        with (
            run_folder(self.out, lambda: bool(self.t0)) as folder,
            on_signals(self.interrupt),
            devices(self.experiment, folder) as self.devices,
        ):
            self.folder = folder
            self.layout = layout_of_run(self.experiment, folder, self.out, self.devices.urls)
            self.layout.write(folder / "layout.json")
            context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
            try:
                self._serve(context)
            finally:
                self._kill_all()
                context.destroy(linger=0)
        found = self._summary()
        (self.out / "summary.json").write_text(json.dumps(found, indent=1) + "\n")
        return found

    def _serve(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self.desk = ControlDesk(context, self.layout.endpoints["control"])
        self.port = ZmqPort(
            context,
            self.layout.endpoints["supervisor"],
            self.layout.hears("supervisor"),
            self.layout.connections("supervisor"),
        )
        try:
            for name in [*self.layout.hosts, "recorder"]:
                self.children[name] = start_process(name, self.layout, self.folder)
            for slot, controller in scheduled_slots(self.experiment).items():
                self.start_slot(slot, controller)
            self._warm()
            with listed(self.out, self.layout.endpoints["control"]):
                self._await_start()
                self._go()
                self._watch()
            self._end()
        finally:
            self.port.close()
            self.desk.close()

    def _warm(self) -> None:
        """Wait until everybody is warm, connected and heard by everybody they talk to."""
        deadline = time.monotonic() + WARM_S
        wanted = self.layout.audience("supervisor")
        while True:
            self._listen()
            ready = [c.name for c in self.children.values() if c.ready]
            self._report("warming up", 0.0, f"{len(ready)} of {len(self.children)} ready")
            heard = self.port.subscribers()
            if len(ready) == len(self.children) and all(
                heard.get(topic, 0) >= n for topic, n in wanted.items()
            ):
                return
            self._check_all_there()
            if time.monotonic() > deadline:
                late = ", ".join(n for n in self.children if n not in ready)
                raise RunError(f"not ready after {WARM_S:g} s: {late}")

    def _check_all_there(self) -> None:
        """Raises RunError when a run that has not begun has lost a process or its operator."""
        for child in self.children.values():
            if child.popen.poll() is not None:
                self._listen()  # its last words
                why = self.cause or child.last_words or f"{child.name} could not start (see above)"
                raise RunError(why)
        if self._interrupted:
            raise RunError("interrupted before the run started")

    def _await_start(self) -> None:
        """Hold everything until the operator's explicit start; devices that are real need one."""
        while not self.started:
            self._listen()
            self._report("waiting", 0.0, "real devices: nothing moves before `vibrissa start`")
            self._check_all_there()

    def _go(self) -> None:
        self.t0 = time.monotonic_ns() + int(LEAD_S * 1e9)
        self._wall = time.monotonic()
        self._cpu0 = time.process_time()
        for child in self.children.values():
            child.heard = time.monotonic()
            if child.name in ALL_SLOTS:
                child.silence = ALL_SLOTS[child.name].silence
            if child.name != "recorder":
                self.desk.say(child.name, "go", t0_ns=self.t0)
        missing = sorted({m for c in self.children.values() for m in c.missing})
        if missing:
            self._note(0, "degraded", "supervisor", f"not granted: {', '.join(missing)}")
        self._decide("start", "operator started the run")
        for swap in self.experiment.swap:
            self.requests.schedule(swap)

    def _watch(self) -> None:
        """Until the run is complete or something ends it."""
        while self.cause is None:
            self._listen()
            self._report("running", self.tick / TICK_HZ)
            for source, (count, cause) in self.gate.take_refused().items():
                self._count_refused("supervisor", source, count, cause)
            now = time.monotonic()
            self.requests.poll()
            for child in list(self.children.values()):
                if child.name in ALL_SLOTS and child.bye and not child.last_words:
                    self._part(child)
                elif trouble := child.trouble(now, self.tick * TICK_NS):
                    self._listen()  # its last words
                    if self._expendable(child.name):
                        self._lose(child, child.last_words or trouble)
                    else:
                        self.cause = self.cause or trouble
            if self._interrupted:
                self.cause = "interrupted by the operator"
            drivers = [c for c in self.children.values() if c.done]
            if self.cause is None and drivers:
                self.cause = "completed"

    def _end(self) -> None:
        """Retract, stop, close; what is dead or silent is not waited for."""
        hosts = [c for n, c in self.children.items() if n != "recorder"]
        if self.cause == "completed":
            end = (self.experiment.ticks - CAUGHT_UP_TICKS) * TICK_NS
            self._until(
                CATCH_UP_S, "catching up", lambda: all(c.t >= end or dead(c) for c in hosts)
            )
        else:
            self._decide("retract", str(self.cause))
            self.requests.end("the run is ending")
            self._until(RETRACT_S, "retracting", lambda: False)
        self.requests.end("the run has ended")
        self._decide("stop", str(self.cause))
        self._until(BYE_S, "stopping", lambda: all(c.bye or dead(c) for c in hosts))
        recorder = self.children["recorder"]
        for child in hosts:
            if child.bye:
                self.sent.update(child.bye["sent"])
        died = ", ".join([*(c.name for c in hosts if not c.bye), *self.lost])
        self.desk.say("recorder", "finish", sent=dict(self.sent), cause=str(self.cause), died=died)
        self._until(CLOSE_S, "closing the log", lambda: bool(recorder.closed) or dead(recorder))
        for child in hosts:
            self.desk.say(child.name, "leave")
        self._until(1.0, "leaving", lambda: all(dead(c) for c in self.children.values()))
        self._wall = time.monotonic() - self._wall

    @property
    def tick(self) -> int:
        """The present tick, from the common clock."""
        if not self.t0:
            return 0
        tick = (time.monotonic_ns() - self.t0) // TICK_NS
        return min(max(tick, 0), self.experiment.ticks)

    def order(self, order: Order) -> None:
        """Put an order on the bus."""
        self._publish("run.order", order)

    def start_slot(self, slot: str, controller: str) -> None:
        """Start the process of a slot, warm for a controller; scheduled ones have been started."""
        if slot in self.children:
            return
        layout = dataclasses.replace(
            self.layout,
            hosts=self.layout.hosts | {slot: [slot]},
            controllers={slot: controller},
        )
        layout.write(self.folder / f"layout-{slot}.json")
        self.children[slot] = start_process(slot, self.layout, self.folder)
        self.children[slot].silence = LOAD_S

    def slot_ready(self, slot: str) -> bool:
        """Whether a slot's process is warm and heard; it then joins the run. Raises RunError."""
        child = self.children.get(slot)
        if child is None:
            raise RunError(self.lost[slot].last_words)
        if not child.ready:
            return False
        if child.silence != ALL_SLOTS[slot].silence:
            child.silence = ALL_SLOTS[slot].silence
            child.heard = time.monotonic()
            self.desk.say(slot, "go", t0_ns=self.t0)
        return True

    def hand_over_calibration(self) -> bool:
        """Repeat the calibration for newcomers; False when there is none yet."""
        if self.calibration is None:
            return False
        self._publish("run.calibration", self.calibration)
        return True

    def _expendable(self, name: str) -> bool:
        """Whether the run goes on without this process: it hosts one controller of several."""
        others = self.requests.slots.keys() - {name}
        return name in ALL_SLOTS or (
            name == "whisk" and self.calibration is not None and bool(others)
        )

    def _lose(self, child: Child, why: str) -> None:
        """A controller is lost; the arbiter falls back if it had the drives; the run goes on."""
        child.last_words = why
        self._decide("lost", why, child.name)
        if child.popen.poll() is None:
            child.popen.kill()
        child.popen.wait()
        del self.children[child.name]
        self.lost[child.name] = child
        self.requests.lost(child.name)
        self._check_controllers(why)

    def _part(self, child: Child) -> None:
        """A slot that was told to close has handed in everything."""
        assert child.bye is not None
        self.sent.update(child.bye["sent"])
        self.desk.say(child.name, "leave")
        self.left.append(self.children.pop(child.name))

    def _failed(self, name: str, event: Event) -> None:
        """A controller failed; its process goes on without it, or ends if it is a slot."""
        self._note(event.tick, event.kind, event.node, event.cause)
        self.requests.failed(name)
        self._check_controllers(event.cause)

    def _check_controllers(self, why: str) -> None:
        """End a run that has no controller left, or none that could be calibrated."""
        slots = self.requests.slots
        if not slots or ("whisk" not in slots and self.calibration is None):
            self.cause = self.cause or f"no controller left: {why}"

    def _until(self, seconds: float, phase: str, done: Any) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and not done():
            self._listen()
            self._report(phase, self.tick / TICK_HZ)

    def _listen(self) -> None:
        """Take everything that was said on the control channel and the bus."""
        wait = POLL_S
        while True:
            try:
                heard = self.desk.hear(wait)
            except MessageError as error:
                self._note(self.tick, "refused", "control", str(error))
                continue
            if heard is None:
                break
            wait = 0.0
            self._take(*heard)
        for _ in range(MOST_FRAMES):
            frame = self.port.receive(0)
            if frame is None:
                break
            if not self.gate.admits(frame):
                continue
            try:
                message = decode(frame)
            except MessageError as error:
                self.gate.refuse("?", str(error))
                continue
            self.requests.heard(message)
            if message.topic == "whisk.calibration":
                self.calibration = message.body
            if message.topic == "whisk.failure":
                self._failed(message.source, message.body)
            if message.topic == "rig.event":
                self._device(message.body)
            if message.topic == "node.event":
                event: Event = message.body
                self._note(event.tick, event.kind, event.node, event.cause)
                if event.kind == "failed":
                    self.requests.failed(message.source)
                if event.kind in FATAL:
                    self.cause = self.cause or f"{event.node}: {event.cause}"

    def _device(self, event: Event) -> None:
        """What a device's process decided; one that makes the rig retract ends the run."""
        self._note(event.tick, event.kind, event.node, event.cause)
        if event.kind == "retract":
            self.cause = self.cause or f"{event.node}: {event.cause}"

    def _take(self, name: str, message: dict[str, Any]) -> None:
        if message["kind"] == "ask":
            self._answer_client(name, message["verb"], message["arguments"])
            return
        child = self.children.get(name)
        if child is None:
            self._note(self.tick, "refused", "control", f"a stranger calls itself {name[:40]!r}")
            return
        child.heard = time.monotonic()
        match message["kind"]:
            case "hello":
                child.missing = message["missing"]
            case "ready":
                child.ready = True
            case "beat":
                child.t, child.steps, child.done = message["t"], message["steps"], message["done"]
            case "fault":
                child.last_words = message["cause"] or "fault"
                if not self._expendable(name):
                    self.cause = self.cause or f"{name}: {message['cause']}"
            case "refused":
                count, cause = message["count"], message["cause"]
                self._count_refused(name, message["source"], count, cause)
            case "bye":
                child.bye = message
            case "closed":
                child.closed = message

    def _count_refused(self, name: str, source: str, count: int, cause: str) -> None:
        """Note what a process would not listen to; a slot that floods others is ended."""
        self._refused[source] += count
        if self._refused[source] == count:  # the first time
            self._note(self.tick, "refused", name, f"{count} frames of {source}: {cause}")
        if self._refused[source] > FLOOD and source in ALL_SLOTS and source in self.children:
            self._lose(self.children[source], f"{source} flooded {name}: {cause}")

    def _answer_client(self, name: str, verb: str, arguments: dict[str, Any]) -> None:
        def reply(accepted: bool, text: str, data: dict[str, Any]) -> None:
            self._note(self.tick, verb if accepted else "refused", "client", text)
            with contextlib.suppress(zmq.ZMQError):  # a client that is gone needs no answer
                self.desk.say(name, "answer", accepted=accepted, text=text, data=data)

        if verb == "start":
            waited, self.started = not self.started, True
            reply(waited, "started" if waited else "the run has started already", {})
        elif not self.started:
            reply(False, "the run waits for its start", {})
        elif self.cause is None:
            self.requests.ask(verb, arguments, reply)
        else:
            reply(False, "the run is ending", {})

    def _decide(self, kind: str, cause: str, node: str = "supervisor") -> None:
        """Put a decision on the bus, where every node takes it as an input and it is recorded."""
        tick = self.tick
        self._publish("run.event", Event(tick, kind, node, one_line(cause)))
        self._note(tick, kind, node, cause)

    def _publish(self, topic: str, body: Any) -> None:
        seq = self._seq[topic]
        self._seq[topic] += 1
        self.port.publish(CODECS[topic].encode("supervisor", 0, seq, self.tick * TICK_NS, body))
        self.port.flush()
        self.sent[topic] += 1

    def _note(self, tick: int, kind: str, node: str, cause: str) -> None:
        if len(self.events) < 10_000:
            self.events.append({"tick": tick, "kind": kind, "node": node, "cause": cause})

    def _report(self, phase: str, done: float, note: str = "") -> None:
        self.on_progress(Progress(phase, done, self.experiment.run.duration, note))

    def _kill_all(self) -> None:
        for child in [*self.children.values(), *self.left]:
            if child.popen.poll() is None:
                child.popen.kill()
            child.popen.wait()

    def _summary(self) -> dict[str, Any]:
        cpu = time.process_time() - self._cpu0
        parts = summary(self.children.values(), self.sent, self.cause, self._wall, cpu)
        return parts | {
            "events": self.events,
            "log": self.layout.log,
            "run_id": self.layout.metadata["run_id"],
            "seed": self.experiment.run.seed,
        }


def run_live(
    experiment: Experiment, out: Path, on_progress: OnProgress = silent, *, start: bool = False
) -> dict[str, Any]:
    """Run an experiment live; write out/run.mcap and out/summary.json; return the summary.

    start: the operator's explicit start, without which a run with real devices waits for one.

    Raises RunError when the run can't start: the directory exists, a port is in use, a process
    does not come up. Once it runs it always ends in order, and the summary names the cause.
    """
    return Supervisor(experiment, out, on_progress, start=start).run()
