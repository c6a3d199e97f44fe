"""What the head and its host say to each other, whatever carries it.

Everything is little-endian. A message begins with the protocol version (uint8) and its type
(uint8); `docs/devices.md` shows every layout. Samples carry 54 int16 counts; which channel is which
whisker's angle or moment, and how much a count is worth, the head says itself in its hello.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from vibrissa.messages.types import TICK_HZ, WHISKERS
from vibrissa.rig.devices.errors import DeviceRefused

PROTOCOL: Final = 1
CHANNELS: Final = 3 * WHISKERS
WATCHDOG_MS: Final = 20

HELLO_PLEASE, START, STOP, COMMAND = 0x01, 0x02, 0x03, 0x04
HELLO, SAMPLE = 0x81, 0x82

NO_ANSWER: Final = 0xFFFFFFFF
"""`answers` of a sample that no command drove."""
RETRACTING: Final = 0x01
"""Flag: the watchdog has fired, the drives retract by themselves."""
BAD_COMMAND: Final = 0x02
"""Flag: something damaged came down since the last sample."""

THETA, X, Y = 1, 2, 3
_KINDS: Final = {THETA: "theta", X: "x", Y: "y"}

_HELLO = struct.Struct("<IIBBB12sHHfH")
_CHANNEL = struct.Struct("<BBf")
_SAMPLE = struct.Struct("<IIIB")
_COMMAND = struct.Struct("<I")

Counts = npt.NDArray[np.int16]


class Channel(NamedTuple):
    """One of the 54: kind (THETA rad, X or Y N m), whisker 0..17, SI units per count."""

    kind: int
    whisker: int
    scale: float

    @property
    def name(self) -> str:
        """As the CAN database and messages call it, e.g. `theta_07`."""
        return f"{_KINDS[self.kind]}_{self.whisker:02d}"


def standard_map() -> tuple[Channel, ...]:
    """theta, x, y of whiskers 0..17; 1e-4 rad and 1e-6 N m per count."""
    scales = {THETA: 1e-4, X: 1e-6, Y: 1e-6}
    return tuple(Channel(kind, i, s) for kind, s in scales.items() for i in range(WHISKERS))


@dataclass(frozen=True, slots=True)
class Hello:
    """How a head introduces itself.

    nonce        of the request it answers, 0 when it speaks up after a reset
    boot         random, another one after every reset
    firmware     (major, minor, patch)
    serial       which head this is
    rate         Hz, samples per second
    watchdog_ms  silence of the host after which the drives retract
    command_scale  rad per count of a command
    channels     the channel map
    """

    nonce: int
    boot: int
    firmware: tuple[int, int, int]
    serial: str
    rate: int = TICK_HZ
    watchdog_ms: int = WATCHDOG_MS
    command_scale: float = 1e-4
    channels: tuple[Channel, ...] = standard_map()

    def check(self) -> None:
        """Raises DeviceRefused when this is no head of eighteen whiskers at 2 kHz."""
        if self.rate != TICK_HZ:
            raise DeviceRefused(
                f"head {self.serial}: sample rate: expected {TICK_HZ} Hz, found {self.rate}"
            )
        if len(self.channels) != CHANNELS:
            raise DeviceRefused(
                f"head {self.serial}: channel map: expected {CHANNELS} channels "
                f"({WHISKERS} x theta, x, y), found {len(self.channels)}"
            )
        seen: set[tuple[int, int]] = set()
        for number, channel in enumerate(self.channels):
            kind, whisker, scale = channel
            if kind not in _KINDS or whisker >= WHISKERS or not 0.0 < scale < math.inf:
                raise DeviceRefused(
                    f"head {self.serial}: channel {number}: expected theta, x or y of whisker "
                    f"0..{WHISKERS - 1}, found kind {kind}, whisker {whisker}, scale {scale:g}"
                )
            if (kind, whisker) in seen:
                raise DeviceRefused(
                    f"head {self.serial}: channel {number}: {channel.name} is there twice"
                )
            seen.add((kind, whisker))
        if not 0.0 < self.command_scale < math.inf:
            raise DeviceRefused(
                f"head {self.serial}: command scale: expected > 0, found {self.command_scale}"
            )

    def describe(self) -> str:
        """One line for people."""
        version = ".".join(map(str, self.firmware))
        return f"head {self.serial}, firmware {version}, {len(self.channels)} channels"


class RawSample(NamedTuple):
    """A sample as it travels: device sample number and clock (us), both uint32 that wrap."""

    seq: int
    time_us: int
    answers: int
    flags: int
    counts: bytes


class HelloPlease(NamedTuple):
    """The host asks who is there."""

    nonce: int


class Start(NamedTuple):
    """The host asks for samples, so many of them per write."""

    batch: int


class Stop(NamedTuple):
    """The host has had enough samples."""


class Command(NamedTuple):
    """Drive set-points in counts, 18 x int16, and the tick they answer."""

    tick: int
    counts: bytes


class Foreign(NamedTuple):
    """A sound message of another protocol version."""

    version: int


FromHead = Hello | RawSample | Foreign
FromHost = HelloPlease | Start | Stop | Command


def pack_hello_body(hello: Hello) -> bytes:
    """The body of a hello, which CAN sends in fragments."""
    head = _HELLO.pack(
        hello.nonce,
        hello.boot,
        *hello.firmware,
        hello.serial.encode("ascii")[:12],
        hello.rate,
        hello.watchdog_ms,
        hello.command_scale,
        len(hello.channels),
    )
    return head + b"".join(_CHANNEL.pack(*channel) for channel in hello.channels)


def unpack_hello_body(body: bytes) -> Hello | None:
    """The hello of a body, None when it is none."""
    if len(body) < _HELLO.size:
        return None
    nonce, boot, *firmware, serial, rate, watchdog, scale, channels = _HELLO.unpack_from(body)
    if len(body) != _HELLO.size + channels * _CHANNEL.size:
        return None
    entries = _CHANNEL.iter_unpack(body[_HELLO.size :])
    name = serial.rstrip(b"\0").decode("ascii", "replace")
    major, minor, patch = firmware
    return Hello(
        nonce,
        boot,
        (major, minor, patch),
        name if name.isprintable() else ascii(name),
        rate,
        watchdog,
        scale,
        tuple(Channel(*entry) for entry in entries),
    )


def pack_from_head(item: Hello | RawSample, version: int = PROTOCOL) -> bytes:
    """A message up: version, type, body."""
    if isinstance(item, Hello):
        return bytes((version, HELLO)) + pack_hello_body(item)
    seq, time_us, answers, flags, counts = item
    return bytes((version, SAMPLE)) + _SAMPLE.pack(seq, time_us, answers, flags) + counts


def unpack_from_head(payload: bytes) -> FromHead | None:
    """What came up, None when it makes no sense."""
    if len(payload) < 2:
        return None
    if payload[0] != PROTOCOL:
        return Foreign(payload[0])
    kind = payload[1]
    if kind == SAMPLE and len(payload) == 2 + _SAMPLE.size + 2 * CHANNELS:
        seq, time_us, answers, flags = _SAMPLE.unpack_from(payload, 2)
        return RawSample(seq, time_us, answers, flags, payload[2 + _SAMPLE.size :])
    if kind == HELLO:
        return unpack_hello_body(payload[2:])
    return None


def pack_from_host(item: FromHost, version: int = PROTOCOL) -> bytes:
    """A message down: version, type, body."""
    match item:
        case Command(tick, counts):
            return bytes((version, COMMAND)) + _COMMAND.pack(tick) + counts
        case HelloPlease(nonce):
            return bytes((version, HELLO_PLEASE)) + _COMMAND.pack(nonce)
        case Start(batch):
            return bytes((version, START, batch))
        case Stop():
            return bytes((version, STOP))


def unpack_from_host(payload: bytes) -> FromHost | None:
    """What came down, None when it makes no sense."""
    if len(payload) < 2:
        return None
    kind, body = payload[1], payload[2:]
    if kind == HELLO_PLEASE and len(body) == _COMMAND.size:
        return HelloPlease(*_COMMAND.unpack(body))  # whatever its version: it gets ours in return
    if payload[0] != PROTOCOL:
        return None
    if kind == COMMAND and len(body) == _COMMAND.size + 2 * WHISKERS:
        return Command(_COMMAND.unpack_from(body)[0], body[_COMMAND.size :])
    if kind == START and len(body) == 1 and body[0] > 0:
        return Start(body[0])
    if kind == STOP and not body:
        return Stop()
    return None
