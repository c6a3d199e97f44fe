"""The head as its users see it, over whatever wire: samples up, commands down, honest counters.

A back end carries messages; everything else is done here once: the handshake, counts and units, the
numbering of samples over gaps and resets, finding the device again.
"""

from __future__ import annotations

import collections
import contextlib
import random
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np

from vibrissa.control.kinematics import WHISKERS, Float32s
from vibrissa.rig.devices import protocol
from vibrissa.rig.devices.clock import ClockRelation
from vibrissa.rig.devices.errors import (
    DeviceLost,
    DeviceRefused,
    DeviceUnavailable,
)
from vibrissa.rig.devices.limits import HEAD
from vibrissa.rig.devices.protocol import (
    CHANNELS,
    NO_ANSWER,
    Command,
    Foreign,
    FromHead,
    FromHost,
    Hello,
    HelloPlease,
    RawSample,
    Start,
    Stop,
)

TICK_NS: Final = 500_000
ANSWER_S: Final = 2.0
"""How long a head may take to introduce itself."""
ASK_S: Final = 0.1
"""How often it is asked while it says nothing."""
OTHERS_S = 0.05
"""How long a second head may take to give itself away."""
SILENCE_S: Final = 0.1
RETRY_S: Final = 0.1
FAR: Final = 2000
"""Samples that may be missing, beside twice those of the time that has passed."""
_WRAP: Final = 2**32


class Reading(NamedTuple):
    """One sample of the head in SI units.

    sample     number of the 0.5 ms period since the stream began, by the device's clock; goes on
               over gaps, resets and replugging with the time that was lost
    device_us  the device's clock, us, made to go on in the same way
    host_ns    monotonic clock of the host when the sample arrived
    answers    tick of the command in force during the period, -1 for none
    flags      protocol.RETRACTING, protocol.BAD_COMMAND
    theta, x, y  float32[18]: rad, N m, N m
    """

    sample: int
    device_us: int
    host_ns: int
    answers: int
    flags: int
    theta: Float32s
    x: Float32s
    y: Float32s


@dataclass(slots=True)
class HeadCounters:
    """What became of everything that came up the wire.

    bytes, frames     of the wire
    crc_errors        frames that were damaged
    resyncs           times the parser was out of step and found back
    samples           handed to the caller
    gaps, lost        interruptions, and the samples missing in them
    strays            samples that fit nowhere: repeated, late, or of a device we don't know
    resets            of the device
    reconnects        times the link was opened again
    unsent            commands that could not be sent
    """

    bytes: int = 0
    frames: int = 0
    crc_errors: int = 0
    resyncs: int = 0
    samples: int = 0
    gaps: int = 0
    lost: int = 0
    strays: int = 0
    resets: int = 0
    reconnects: int = 0
    unsent: int = 0


class HeadDevice(ABC):
    """A whisker head. Use it as a context manager, from one thread.

    `info` is the head's own introduction, `clock` the relation of its clock to the host's.
    A link that breaks is opened again by `read`; only when that has failed for `limits.HEAD
    .patience` seconds, or when another head answers, does `read` raise.
    """

    info: Hello
    _others_s = OTHERS_S

    def __init__(self, name: str, *, batch: int = 1, patience: float = HEAD.patience) -> None:
        """name: for messages; batch: samples the device may send in one write, 1 to 100."""
        if not 1 <= batch <= 100:
            raise DeviceUnavailable(f"{name}: batch: expected 1 to 100, found {batch}")
        self.name = name
        self.counters = HeadCounters()
        self.clock = ClockRelation()
        self.limits = HEAD
        self._batch = batch
        self._patience = patience
        self._ready: collections.deque[Reading] = collections.deque()
        self._linked = False
        self._nonce = 0
        self._seq: int | None = None
        self._astray = False
        self._sample = -1
        self._device_us = 0
        self._time_us = 0
        self._heard_ns = 0
        self._asked_ns = 0
        self._tried_ns = 0

    def open(self) -> Self:
        """Connect, shake hands, ask for samples. Nothing moves.

        Raises DeviceUnavailable or DeviceRefused, and then everything is closed again.
        """
        self._open_link()
        self._linked = True
        try:
            self._shake_hands()
            self._send(Start(self._batch))
        except OSError as error:
            self.close()
            raise DeviceUnavailable(f"{self.name}: {error.strerror or error}") from None
        except BaseException:
            self.close()
            raise
        self._heard_ns = time.monotonic_ns()
        return self

    def close(self) -> None:
        """Stop the samples and let go; the drives retract by their watchdog. May be repeated."""
        if self._linked:
            with contextlib.suppress(OSError):
                self._send(Stop())
            self._linked = False
            self._close_link()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, timeout: float) -> Reading | None:
        """The next sample, or None after `timeout` s; 0 takes only what is there.

        Raises DeviceLost after `patience` s without a sample, DeviceRefused when what comes back
        after an interruption is not the head that was there before.
        """
        ready = self._ready
        deadline = time.monotonic_ns() + int(timeout * 1e9)
        while not ready:
            left = max(deadline - time.monotonic_ns(), 0) * 1e-9
            self._listen(min(left, SILENCE_S))
            if not ready and time.monotonic_ns() >= deadline:
                return None
        return ready.popleft()

    def poll(self, timeout: float = 0.0) -> list[Reading]:
        """All that one look at the wire brings, waiting for it no longer than `timeout` s.

        What is left comes with the next. Raises as `read` does.
        """
        self._listen(timeout)
        found = list(self._ready)
        self._ready.clear()
        return found

    def _listen(self, timeout: float) -> None:
        self._look_after(time.monotonic_ns())
        if self._linked:
            try:
                self._take(self._receive(timeout))
            except OSError:
                self._unlink()
        elif timeout > 0.0:
            time.sleep(min(timeout, 0.01))

    def write(self, tick: int, command: Float32s) -> bool:
        """Send the drives their set-points float32[18], rad, that answer the sample of `tick`.

        True when it is on its way, False when the link is down (counted as unsent). Raises
        DeviceLimit before anything is sent.
        """
        self.limits.check(tick, command)
        counts = np.rint(command / self._command_scale).astype("<i2")
        if not self._linked or not self._try_to_send(Command(tick % _WRAP, counts.tobytes())):
            self.counters.unsent += 1
            return False
        return True

    def silent_ticks(self) -> int:
        """Ticks of host time since the last sample arrived."""
        return (time.monotonic_ns() - self._heard_ns) // TICK_NS

    def fileno(self) -> int:
        """What to wait on for samples beside other things; -1 where there is nothing."""
        return -1

    # What a back end must do. Each may raise OSError when the wire is gone.

    @abstractmethod
    def _open_link(self) -> None:
        """Open the wire. Raises DeviceUnavailable."""

    @abstractmethod
    def _close_link(self) -> None:
        """Let go of the wire; never raises."""

    @abstractmethod
    def _receive(self, timeout: float) -> Iterable[FromHead]:
        """What has come up, waiting for it no longer than `timeout` s; keeps the counters."""

    @abstractmethod
    def _send(self, item: FromHost) -> None:
        """Send one message down."""

    def _shake_hands(self) -> None:
        self._nonce = random.SystemRandom().randrange(1, _WRAP)
        answers: list[Hello] = []
        start = asked = time.monotonic()
        until = start + ANSWER_S
        self._send(HelloPlease(self._nonce))
        foreign: int | None = None
        while (now := time.monotonic()) < until:
            if not answers and now - asked > ASK_S:
                asked = now
                self._send(HelloPlease(self._nonce))
            for item in self._receive(0.02):
                if isinstance(item, Hello) and item.nonce == self._nonce:
                    until = min(until, now + self._others_s) if not answers else until
                    answers.append(item)
                elif isinstance(item, Foreign):
                    foreign = item.version
                    until = min(until, now + OTHERS_S)
        if not answers:
            if foreign is not None:
                raise DeviceRefused(
                    f"{self.name}: protocol version: expected {protocol.PROTOCOL}, found {foreign}"
                )
            raise DeviceUnavailable(f"{self.name}: no head answered within {ANSWER_S:g} s")
        found = sorted({hello.serial for hello in answers})
        if len(found) > 1 or len({hello.boot for hello in answers}) > 1:
            raise DeviceRefused(f"{self.name}: expected one head, found several: {found}")
        answers[0].check()
        self._adopt(answers[0])

    def _adopt(self, hello: Hello) -> None:
        self.info = hello
        self._command_scale = np.float32(hello.command_scale)
        where = {(c.kind, c.whisker): k for k, c in enumerate(hello.channels)}
        kinds = (protocol.THETA, protocol.X, protocol.Y)
        order = [where[kind, i] for kind in kinds for i in range(WHISKERS)]
        self._order = None if order == list(range(CHANNELS)) else np.array(order)
        self._scale = np.array([hello.channels[k].scale for k in order], np.float32)

    def _look_after(self, now: int) -> None:
        """Ask a silent head, look for a lost one, give up when it is time."""
        if now - self._heard_ns < SILENCE_S * 1e9:
            return
        if now - self._heard_ns > self._patience * 1e9:
            raise DeviceLost(f"{self.name}: no sample for {self._patience:g} s")
        if not self._linked and now - self._tried_ns > RETRY_S * 1e9:
            self._tried_ns = now
            try:
                self._open_link()
            except DeviceUnavailable:
                return
            self._linked = True
            self.counters.reconnects += 1
        if self._linked and now - self._asked_ns > ASK_S * 1e9:
            self._ask(now)

    def _ask(self, now: int) -> None:
        self._asked_ns = now
        self._try_to_send(HelloPlease(self._nonce))

    def _try_to_send(self, item: FromHost) -> bool:
        try:
            self._send(item)
        except OSError:
            self._unlink()
            return False
        return True

    def _unlink(self) -> None:
        if self._linked:
            self._linked = False
            self._tried_ns = time.monotonic_ns()
            self._close_link()

    def _take(self, items: Iterable[FromHead]) -> None:
        host_ns = time.monotonic_ns()
        for item in items:
            if isinstance(item, RawSample):
                self._sampled(item, host_ns)
            elif isinstance(item, Hello):
                self._greeted(item)
            else:
                self.counters.strays += 1

    def _greeted(self, hello: Hello) -> None:
        """An introduction in the middle of a stream: it was reset, replugged, or asked."""
        if hello.nonce not in (0, self._nonce):
            return
        known = self.info
        if hello.serial != known.serial:
            raise DeviceRefused(
                f"{self.name}: expected head {known.serial} only, found head {hello.serial} too"
            )
        if hello.channels != known.channels or hello.command_scale != known.command_scale:
            hello.check()
            raise DeviceRefused(
                f"{self.name}: head {known.serial} has come back with another channel map"
            )
        if hello.boot != known.boot:
            self.counters.resets += 1
            self.info = hello
            self._seq = None
        elif self._astray:
            self._seq = None
        self._try_to_send(Start(self._batch))

    def _sampled(self, raw: RawSample, host_ns: int) -> None:
        seq, time_us, answers, flags, counts = raw
        if self._seq is None:
            steps = max(self._elapsed(host_ns), 1) if self._sample >= 0 else 1
            self._device_us += steps * (TICK_NS // 1000)
            self.clock.forget()
        else:
            steps = (seq - self._seq) % _WRAP
            if steps == 0 or (steps > FAR and steps > FAR + 2 * self._elapsed(host_ns)):
                self.counters.strays += 1
                self._astray = steps != 0
                if steps and host_ns - self._asked_ns > ASK_S * 1e9:
                    self._ask(host_ns)
                return
            self._device_us += (time_us - self._time_us) % _WRAP
        if steps > 1:
            self.counters.gaps += 1
            self.counters.lost += steps - 1
        self._sample += steps
        self._seq, self._time_us = seq, time_us
        self._astray = False
        self._heard_ns = host_ns
        self.clock.see(self._device_us * 1000, host_ns)
        self.counters.samples += 1
        values = np.frombuffer(counts, "<i2")
        if self._order is not None:
            values = values[self._order]
        si = values * self._scale
        self._ready.append(
            Reading(
                self._sample,
                self._device_us,
                host_ns,
                -1 if answers == NO_ANSWER else answers,
                flags,
                si[:WHISKERS],
                si[WHISKERS : 2 * WHISKERS],
                si[2 * WHISKERS :],
            )
        )

    def _elapsed(self, host_ns: int) -> int:
        """Ticks of host time from when the last sample was taken, however late it was read."""
        return round((host_ns - self.clock.host_ns(self._device_us * 1000)) / TICK_NS)
