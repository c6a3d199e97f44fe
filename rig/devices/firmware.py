"""The emulated head without its wire: what the firmware of a head does, step by step.

It stands in for hardware in tests. The serial and the CAN emulator put it on a wire; the virtual
head uses it as it is. Physics, servos and the 20 ms watchdog are those of `rig.plant.HeadPlant`.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vibrissa.control.kinematics import WHISKERS, Float32s
from vibrissa.rig.devices.protocol import (
    BAD_COMMAND,
    NO_ANSWER,
    RETRACTING,
    Command,
    FromHost,
    Hello,
    HelloPlease,
    RawSample,
    Start,
    Stop,
)
from vibrissa.rig.plant import WATCHDOG_TICKS, HeadPlant, Pose

_WRAP = 2**32
PERIOD_US = 500


class Firmware:
    """A head: hears messages, takes a sample per tick of its own clock.

    plant   the physics; its ticks are counted here
    pose    where the arm holds the head now
    hello   how it introduces itself; boot and nonce are filled in here
    seed    of the boot numbers
    """

    def __init__(
        self, plant: HeadPlant, pose: Callable[[], Pose], hello: Hello, seed: int = 0
    ) -> None:
        self.hello = hello
        self._plant = plant
        self._pose = pose
        self._random = random.Random(seed)
        self._tick = 0
        # The wire's channels in terms of theta, x, y of whiskers 0..17.
        self._order = np.array(
            [(c.kind - 1) % 3 * WHISKERS + c.whisker % WHISKERS for c in hello.channels]
        )
        self._per_unit = np.array([1.0 / c.scale for c in hello.channels], np.float64)
        self.reset()

    def reset(self) -> Hello:
        """As by the reset button: sample numbers, clock, boot number and stream start afresh.

        The whiskers stay where they are. Returns what the head then says unasked.
        """
        self.streaming = False
        self.batch = 1
        self._seq = 0
        self._answers = NO_ANSWER
        self._command: Float32s | None = None
        self._commanded = -WATCHDOG_TICKS
        self._bad = False
        self.hello = replace(self.hello, boot=self._random.randrange(1, _WRAP), nonce=0)
        return self.hello

    def hear(self, item: FromHost | None) -> Hello | None:
        """Take a message of the host, None for a damaged one; what to answer, if anything."""
        match item:
            case HelloPlease(nonce):
                return replace(self.hello, nonce=nonce)
            case Start(batch):
                self.streaming, self.batch = True, batch
            case Stop():
                self.streaming = False
            case Command(tick, counts):
                scale = np.float32(self.hello.command_scale)
                self._command = np.frombuffer(counts, "<i2") * scale
                self._answers = tick
            case None:
                self._bad = True
        return None

    def sample(self) -> RawSample | None:
        """Live through one tick; the sample at its end, None when nobody asked for samples."""
        if self._command is not None:
            self._commanded = self._tick
        theta, x, y = self._plant.step(self._tick, self._pose(), self._command)
        self._command = None
        retracting = self._tick - self._commanded >= WATCHDOG_TICKS
        if retracting:
            self._answers = NO_ANSWER
        self._tick += 1
        seq = self._seq
        self._seq = (seq + 1) % _WRAP
        if not self.streaming:
            return None
        flags = RETRACTING * retracting + BAD_COMMAND * self._bad
        self._bad = False
        values = np.concatenate((theta, x, y))[self._order] * self._per_unit
        np.rint(values, out=values)
        np.minimum(np.maximum(values, -32768.0, out=values), 32767.0, out=values)
        counts = values.astype("<i2").tobytes()
        return RawSample(seq, seq * PERIOD_US % _WRAP, self._answers, flags, counts)
