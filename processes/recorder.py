"""The recorder: everything on the bus into one log.

It listens with unlimited queues, drains a few milliseconds at a time, and closes a chunk at least
every 50 ms, so that a crash of the recorder costs less than 0.1 s of data. It never acknowledges
anything: publishers hold what it has not taken yet, and the control loop does not notice it.
"""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Final

import zmq

from vibrissa.messages.errors import DecodeError, MessageError
from vibrissa.messages.log_format import LogError
from vibrissa.messages.transport import ZmqPort
from vibrissa.processes import realtime
from vibrissa.processes.control import ControlLine
from vibrissa.processes.framelog import FrameLog
from vibrissa.processes.gate import Gate
from vibrissa.processes.layout import Layout
from vibrissa.processes.table import RECORDER_PRIORITY

SYNC_S: Final = 0.03
DRAIN_S: Final = 0.005
FINISH_S: Final = 5.0
SILENCE_S: Final = 1.0
"""How long nobody may say anything before a recorder without a supervisor closes the log."""


class Recorder:
    """The recording process of a live run."""

    def __init__(self, layout: Layout) -> None:
        realtime.prepare(0)
        if json.loads(layout.experiment)["run"]["realtime"]:
            realtime.set_fifo(RECORDER_PRIORITY)
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.control = ControlLine(self.context, layout.endpoints["control"], "recorder")
        self.port = ZmqPort(
            self.context,
            layout.endpoints["recorder"],
            layout.hears("recorder"),
            layout.connections("recorder"),
            bundled=True,
        )
        meta = dict(layout.metadata)
        self.log = FrameLog(Path(layout.log), meta.pop("run_id"), meta)
        self.gate = Gate(limited=False)
        self.t = 0
        self._parent = os.getppid()

    def run(self) -> None:
        """Record until told to finish, or until the supervisor is gone and the bus is silent."""
        self.control.say("hello", pid=os.getpid(), missing=[])
        self.control.say("ready")
        self._cpu0 = time.process_time()
        self.port.subscribers()
        try:
            cause = self._record()
            self.log.close(cause)
        except (LogError, MessageError) as error:
            self.control.say("fault", cause=str(error)[:400])
            self._keep_draining()
        self.control.say(
            "closed", received=self.log.received, cpu_s=time.process_time() - self._cpu0
        )
        self.control.close()
        self.port.close()
        self.context.term()

    def _record(self) -> str:
        beat = 0.0
        cause = ""
        expected: dict[str, int] | None = None
        deadline = float("inf")
        heard = time.monotonic()
        while True:
            took = self._drain()
            now = time.monotonic()
            heard = now if took else heard
            self.log.sync(SYNC_S)
            if now - beat > 0.1:
                beat = now
                steps = sum(self.log.received.values())
                self.control.say("beat", t=self.t, steps=steps, done=False)
                for source, (count, why) in self.gate.take_refused().items():
                    self.control.say("refused", source=source, count=count, cause=why)
            order = self.control.hear(0)
            if order and order["kind"] == "finish":
                cause, expected, deadline = order["cause"], order["sent"], now + FINISH_S
                if order["died"]:
                    self.log.note("died", {"processes": order["died"]})
            if expected is not None and all(
                self.log.received.get(topic, 0) >= n for topic, n in expected.items()
            ):
                return cause
            if now > deadline:
                self.log.note("died", {"processes": "messages of a process were not delivered"})
                return cause
            if os.getppid() != self._parent and now - heard > SILENCE_S:
                return "supervisor gone"
            if not took:
                time.sleep(DRAIN_S)

    def _drain(self) -> int:
        took = 0
        while took < 5000 and (frame := self._receive()) is not None:
            if self.gate.admits(frame):
                self.t = max(self.t, self.log.write(frame))
            took += 1
        return took

    def _receive(self) -> bytes | None:
        """The next frame; b"" for a bundle that is none."""
        try:
            return self.port.receive(0)
        except DecodeError as error:
            self.gate.refuse("?", str(error))
            return b""

    def _keep_draining(self) -> None:
        """After a failed write: take messages off the publishers' hands until the run is over."""
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline and os.getppid() == self._parent:
            while self.port.receive(0) is not None:
                pass
            order = self.control.hear(DRAIN_S)
            if order and order["kind"] in ("finish", "leave"):
                return
            self.control.say("beat", t=self.t, steps=0, done=False)


def main(layout: Layout) -> None:
    """Entry point of the recorder process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    recorder = Recorder(layout)
    recorder.run()
