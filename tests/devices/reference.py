"""The serial protocol read from its documentation alone, slowly: `docs/devices.md`, no driver."""

from __future__ import annotations

import struct
from typing import Any

from vibrissa.rig.devices.protocol import Command, RawSample


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE, bit by bit: polynomial 0x1021, from 0xFFFF, nothing reflected."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def unframe(encoded: bytes) -> bytes:
    """The message between two zero bytes: COBS undone, CRC checked and taken off."""
    data = b""
    at = 0
    while at < len(encoded):
        code = encoded[at]
        assert code and at + code <= len(encoded)
        data += encoded[at + 1 : at + code]
        at += code
        if code < 255 and at < len(encoded):
            data += b"\0"
    assert crc16(data[:-2]) == int.from_bytes(data[-2:], "big")
    return data[:-2]


def sample(message: bytes) -> RawSample:
    """Type 0x82."""
    assert message[0] == 1 and message[1] == 0x82 and len(message) == 123
    seq, time_us, answers = (int.from_bytes(message[k : k + 4], "little") for k in (2, 6, 10))
    return RawSample(seq, time_us, answers, message[14], message[15:])


def command(message: bytes) -> Command:
    """Type 0x04."""
    assert message[0] == 1 and message[1] == 0x04 and len(message) == 42
    return Command(int.from_bytes(message[2:6], "little"), message[6:])


def hello(message: bytes) -> dict[str, Any]:
    """Type 0x81."""
    assert message[0] == 1 and message[1] == 0x81
    body = message[2:]
    count = int.from_bytes(body[31:33], "little")
    assert len(body) == 33 + 6 * count
    return {
        "nonce": int.from_bytes(body[0:4], "little"),
        "boot": int.from_bytes(body[4:8], "little"),
        "firmware": tuple(body[8:11]),
        "serial": body[11:23].rstrip(b"\0").decode(),
        "rate": int.from_bytes(body[23:25], "little"),
        "watchdog_ms": int.from_bytes(body[25:27], "little"),
        "command_scale": struct.unpack("<f", body[27:31])[0],
        "channels": [
            (body[k], body[k + 1], struct.unpack("<f", body[k + 2 : k + 6])[0])
            for k in range(33, len(body), 6)
        ],
    }
