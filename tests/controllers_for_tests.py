"""Controllers with faults, for tests of what a run does about them.

Each whisks in open loop like `open_loop` until its moment has come. `activate` is called once when
a controller gets into shadow and once more when it gets the drives, which is how it tells.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from vibrissa.control.calibration import Calibration
from vibrissa.control.kinematics import Float32s
from vibrissa.control.open_loop import OpenLoop
from vibrissa.control.whisk_pattern import WhiskParams
from vibrissa.messages.codec import CODECS, Message
from vibrissa.messages.types import TICK_NS, WhiskCommand
from vibrissa.processes.host import Host
from vibrissa.processes.whisk import WhiskNode

SHADOW_TICKS = 2000
"""More than a rehearsal has."""
ACTIVE_TICKS = 100


class Faulty(OpenLoop):
    """Goes wrong `after` ticks in shadow (when=1) or with the drives (when=2)."""

    when, after = 2, ACTIVE_TICKS

    def __init__(self, whisk: WhiskParams) -> None:
        super().__init__(whisk)
        self._activations = 0
        self._since = 0

    def activate(self, tick: int, last_command: Float32s, theta: Float32s) -> None:
        super().activate(tick, last_command, theta)
        self._activations += 1
        self._since = tick

    def step(self, tick: int, theta: Float32s, x: Float32s, y: Float32s) -> Float32s:
        command = super().step(tick, theta, x, y)
        if self._activations >= self.when and tick >= self._since + self.after:
            return self.fault(command)
        return command

    def fault(self, command: Float32s) -> Any:
        raise RuntimeError("whisker motors are on fire")


class ThrowsWhenActive(Faulty):
    """Raises an error while it has the drives."""


class ThrowsInShadow(Faulty):
    """Raises an error before it has the drives."""

    when, after = 1, SHADOW_TICKS


class ThrowsAtOnce(OpenLoop):
    """Raises an error in its first step."""

    def step(self, tick: int, theta: Float32s, x: Float32s, y: Float32s) -> Float32s:
        raise ZeroDivisionError("no first step")


class SaysNaN(Faulty):
    def fault(self, command: Float32s) -> Any:
        command[4] = np.nan
        return command


class SaysTooMuch(Faulty):
    """A command that travels, but not within the travel of the drives."""

    def fault(self, command: Float32s) -> Any:
        return command + np.float32(1.5)


class SaysFarTooMuch(Faulty):
    """A command that is no angle."""

    def fault(self, command: Float32s) -> Any:
        return command + np.float32(1e6)


class SaysTooLittle(Faulty):
    """A command of the wrong length."""

    def fault(self, command: Float32s) -> Any:
        return command[:17]


class SaysNothing(Faulty):
    def fault(self, command: Float32s) -> Any:
        return None


class SaysWords(Faulty):
    def fault(self, command: Float32s) -> Any:
        return "fast"


class Killed(Faulty):
    """Its process is gone at once, without a word."""

    def fault(self, command: Float32s) -> Any:
        os.kill(os.getpid(), signal.SIGKILL)


def caller(kind: type) -> Any:
    """The nearest object of a class whose method is running; None when there is none.

    What a controller must not do: reach for the process around it. A re-run has no live host.
    """
    frame = sys._getframe()
    while frame is not None:
        if isinstance(found := frame.f_locals.get("self"), kind):
            return found
        frame = frame.f_back
    return None


class Ailing(OpenLoop):
    """A first controller that, once calibrated, is late, then stale, then stands still for good.

    In between it is well for long enough to get the drives back, on a machine that is not too busy.
    """

    LATE, STALE, STILL = 400, 2000, 3600
    """Ticks after the calibration at which it happens."""
    TICKS = 60
    """How long the first two last."""

    def __init__(self, whisk: WhiskParams) -> None:
        super().__init__(whisk)
        self._calibrated: int | None = None
        self._now = 0

    def calibrate(self, calibration: Calibration) -> None:
        super().calibrate(calibration)
        self._calibrated = self._now

    def step(self, tick: int, theta: Float32s, x: Float32s, y: Float32s) -> Float32s:
        self._now = tick
        command = super().step(tick, theta, x, y)
        if self._calibrated is None:
            return command
        since = tick - self._calibrated
        if self.LATE <= since < self.LATE + self.TICKS:
            time.sleep(0.01)
        if since == self.STALE:
            self._say_stale(caller(WhiskNode), tick)
        if since == self.STILL:
            os.kill(os.getpid(), signal.SIGSTOP)
        return command

    def _say_stale(self, node: Any, start: int) -> None:
        """Have answers bear the tick of five samples ago for a while."""
        fresh = node.step

        def step(message: Message) -> Iterator[tuple[str, Any]]:
            for topic, body in fresh(message):
                stale = topic == "whisk.command" and start <= body.tick < start + self.TICKS
                yield topic, WhiskCommand(body.tick - 5, body.command) if stale else body

        node.step = step


class Forger(Faulty):
    """Sends commands in the name of the run's first controller beside its own."""

    copies, source = 1, "whisk"

    def step(self, tick: int, theta: Float32s, x: Float32s, y: Float32s) -> Float32s:
        self._tick = tick
        return super().step(tick, theta, x, y)

    def fault(self, command: Float32s) -> Any:
        host = caller(Host)
        if host is not None:
            source = self.source or host.name
            body = WhiskCommand(self._tick, np.zeros(18, np.float32))
            forged = CODECS["whisk.command"].encode(source, 0, 10**6, self._tick * TICK_NS, body)
            for _ in range(self.copies):
                host.port.publish(forged)
        return command


class Floods(Forger):
    """Fills everybody's sockets while it is in shadow."""

    when, after = 1, SHADOW_TICKS
    copies, source = 2000, ""


class KilledInShadow(Killed):
    when, after = 1, SHADOW_TICKS


class NeverReady(OpenLoop):
    """Does not come back from its making."""

    def __init__(self, whisk: WhiskParams) -> None:
        time.sleep(600)
