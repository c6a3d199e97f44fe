"""How the head's messages lie in CAN FD frames, and how much of the bus they need.

A sample does not fit into one frame and eighteen frames do not fit onto a 5 Mbit/s bus, so two
packed frames of 64 bytes carry it. All fields are little-endian.

| id    | length | from | bytes                                                         |
|-------|--------|------|---------------------------------------------------------------|
| 0x080 | 48     | host | tick u32, 18 x int16, 8 zero                                  |
| 0x100 | 64     | head | seq u32, time u32 (us), flags u8, version u8, channels 0-26   |
| 0x101 | 64     | head | seq u32, answers u32, 0 u8, version u8, channels 27-53        |
| 0x600 | 8      | host | version u8, type u8, batch u8, 0 u8, nonce u32                |
| 0x601 | <= 64  | head | version u8, index u8, count u8, used u8, 60 bytes of a hello  |
"""

from __future__ import annotations

import math
import struct
from typing import Final

from vibrissa.messages.types import TICK_HZ, WHISKERS
from vibrissa.rig.devices.errors import DeviceRefused
from vibrissa.rig.devices.protocol import (
    CHANNELS,
    HELLO_PLEASE,
    PROTOCOL,
    START,
    STOP,
    Command,
    Foreign,
    FromHead,
    FromHost,
    Hello,
    HelloPlease,
    RawSample,
    Start,
    Stop,
    pack_hello_body,
    unpack_hello_body,
)

COMMAND_ID, SAMPLE_A_ID, SAMPLE_B_ID, CONTROL_ID, HELLO_ID = 0x080, 0x100, 0x101, 0x600, 0x601
FROM_HOST, FROM_HEAD = (COMMAND_ID, CONTROL_ID), (SAMPLE_A_ID, SAMPLE_B_ID, HELLO_ID)
COMMAND_BYTES, SAMPLE_BYTES, CONTROL_BYTES = 48, 64, 8
HALF: Final = CHANNELS // 2
PART: Final = 60
"""Bytes of a hello per frame."""
FRAME_SIZES: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)

_HEAD_A = struct.Struct("<IIBB")
_HEAD_B = struct.Struct("<IIBB")
_COMMAND = struct.Struct("<I")
_CONTROL = struct.Struct("<BBBxI")

Frame = tuple[int, bytes]
"""(identifier, data)"""


def pack_sample(sample: RawSample, version: int = PROTOCOL) -> list[Frame]:
    """The two frames of a sample."""
    seq, time_us, answers, flags, counts = sample
    a = _HEAD_A.pack(seq, time_us, flags, version) + counts[: 2 * HALF]
    b = _HEAD_B.pack(seq, answers, 0, version) + counts[2 * HALF :]
    return [(SAMPLE_A_ID, a), (SAMPLE_B_ID, b)]


def pack_hello(hello: Hello, version: int = PROTOCOL) -> list[Frame]:
    """The frames of a hello."""
    body = pack_hello_body(hello)
    parts = [body[k : k + PART] for k in range(0, len(body), PART)]
    frames = []
    for index, part in enumerate(parts):
        data = bytes((version, index, len(parts), len(part))) + part
        frames.append((HELLO_ID, _padded(data)))
    return frames


def pack_from_host(item: FromHost, version: int = PROTOCOL) -> Frame:
    """A message down, one frame."""
    match item:
        case Command(tick, counts):
            data = _COMMAND.pack(tick) + counts
            return COMMAND_ID, data.ljust(COMMAND_BYTES, b"\0")
        case HelloPlease(nonce):
            return CONTROL_ID, _CONTROL.pack(version, HELLO_PLEASE, 0, nonce)
        case Start(batch):
            return CONTROL_ID, _CONTROL.pack(version, START, batch, 0)
        case Stop():
            return CONTROL_ID, _CONTROL.pack(version, STOP, 0, 0)


def unpack_from_host(frame: Frame) -> FromHost | None:
    """What a frame of the host says, None for anything else."""
    identifier, data = frame
    if identifier == COMMAND_ID and len(data) == COMMAND_BYTES:
        end = _COMMAND.size + 2 * WHISKERS
        return Command(_COMMAND.unpack_from(data)[0], bytes(data[_COMMAND.size : end]))
    if identifier != CONTROL_ID or len(data) != CONTROL_BYTES:
        return None
    version, kind, batch, nonce = _CONTROL.unpack(data)
    if kind == HELLO_PLEASE:
        return HelloPlease(nonce)  # whatever its version: it gets ours in return
    if version != PROTOCOL:
        return None
    if kind == START and batch:
        return Start(batch)
    return Stop() if kind == STOP else None


class Assembler:
    """Puts samples and hellos together from the frames that come in.

    frames      that belong to a head
    incomplete  samples of which one frame is missing
    """

    def __init__(self) -> None:
        self.frames = 0
        self.incomplete = 0
        self._a: tuple[int, int, int, bytes] | None = None
        self._hello: dict[int, bytes] = {}

    @property
    def halfway(self) -> bool:
        """Whether the other frame of a sample is to come."""
        return self._a is not None

    def restart(self) -> None:
        """Forget what was begun."""
        self._a = None
        self._hello.clear()

    def take(self, frame: Frame) -> FromHead | None:
        """What a frame completes, if anything. Never raises; holds one sample and one hello."""
        identifier, data = frame
        if identifier == SAMPLE_A_ID and len(data) == SAMPLE_BYTES:
            self.frames += 1
            if data[9] != PROTOCOL:
                return Foreign(data[9])
            self.incomplete += self._a is not None
            seq, time_us, flags, _ = _HEAD_A.unpack_from(data)
            self._a = (seq, time_us, flags, bytes(data[_HEAD_A.size :]))
        elif identifier == SAMPLE_B_ID and len(data) == SAMPLE_BYTES:
            self.frames += 1
            return self._second(data)
        elif identifier == HELLO_ID and len(data) > 4:
            self.frames += 1
            return self._greeting(data)
        return None

    def _second(self, data: bytes) -> FromHead | None:
        if data[9] != PROTOCOL:
            return Foreign(data[9])
        seq, answers, _, _ = _HEAD_B.unpack_from(data)
        first, self._a = self._a, None
        if first is None or first[0] != seq:
            self.incomplete += 1
            return None
        return RawSample(seq, first[1], answers, first[2], first[3] + bytes(data[_HEAD_B.size :]))

    def _greeting(self, data: bytes) -> FromHead | None:
        version, index, count, used = data[:4]
        if version != PROTOCOL:
            return Foreign(version)
        if index >= count or used > len(data) - 4:
            return None
        if index == 0:
            self._hello.clear()
        self._hello[index] = bytes(data[4 : 4 + used])
        if len(self._hello) < count or index != count - 1:
            return None
        parts = [self._hello.get(k) for k in range(count)]
        self._hello.clear()
        return None if None in parts else unpack_hello_body(b"".join(p or b"" for p in parts))


def _padded(data: bytes) -> bytes:
    size = next(n for n in FRAME_SIZES if n >= len(data))
    return data.ljust(size, b"\0")


# The bus load


def frame_seconds(data: int, bitrate: float, data_bitrate: float, *, stuffed: bool) -> float:
    """How long an FD frame with bit rate switch and 11-bit identifier occupies the bus.

    data: bytes; stuffed: with the most stuff bits that can occur, else with none but the fixed
    ones. Bits per ISO 11898-1: at the nominal rate SOF, identifier, RRS, IDE, FDF, res, BRS (17)
    and ACK, its delimiter, EOF, intermission (12); at the data rate ESI, DLC, data, stuff count,
    CRC of 17 or 21 bits with a fixed stuff bit every 4, CRC delimiter.
    """
    crc = 17 if data <= 16 else 21
    slow = 17 + 12
    before_crc = 1 + 4 + 8 * data
    fast = before_crc + 4 + crc + math.ceil((4 + crc) / 4) + 1
    if stuffed:
        slow += 17 // 4
        fast += (before_crc + 17 % 4) // 4
    return slow / bitrate + fast / data_bitrate


def bus_load(bitrate: float, data_bitrate: float) -> tuple[float, float]:
    """(least, most) share of the bus that samples and commands at 2 kHz need."""
    sizes = (SAMPLE_BYTES, SAMPLE_BYTES, COMMAND_BYTES)
    least, most = (
        TICK_HZ * sum(frame_seconds(n, bitrate, data_bitrate, stuffed=s) for n in sizes)
        for s in (False, True)
    )
    return least, most


def check_bus_load(name: str, bitrate: float, data_bitrate: float) -> tuple[float, float]:
    """The load, when the bus can bear it. Raises DeviceRefused."""
    least, most = bus_load(bitrate, data_bitrate)
    if not most < 1.0:
        raise DeviceRefused(
            f"{name}: bus load at {bitrate:g} and {data_bitrate:g} bit/s: expected less than "
            f"100 %, found {100 * least:.0f} to {100 * most:.0f} %"
        )
    return least, most
