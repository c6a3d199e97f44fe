"""Frames on a serial line: COBS( message, CRC-16 ), then one zero byte.

A zero byte never occurs inside a frame, so whoever joins late, or lost bytes, is in step again at
the next one. The CRC is CRC-16/CCITT-FALSE of the message, big-endian: taken over message and CRC
together it is zero.
"""

from __future__ import annotations

import binascii
from dataclasses import dataclass
from typing import Final

from cobs import cobs

LONGEST: Final = 1024
"""Bytes of the longest frame; more without a zero byte is noise."""


def frame(message: bytes) -> bytes:
    """A message as it goes over the line, with zero bytes around it.

    The leading one ends whatever noise the line has picked up since the last frame.
    """
    crc = binascii.crc_hqx(message, 0xFFFF)
    encoded: bytes = cobs.encode(message + crc.to_bytes(2, "big"))
    return b"\0" + encoded + b"\0"


@dataclass(slots=True)
class FrameParser:
    """Finds the messages in a stream of bytes that comes in pieces, damaged or not.

    taken       bytes so far
    frames      messages found
    crc_errors  frames that were damaged (COBS or CRC)
    resyncs     times it was out of step and found back: a run of damaged frames counts once
    """

    taken: int = 0
    frames: int = 0
    crc_errors: int = 0
    resyncs: int = 0
    _rest: bytes = b""
    _skipping: bool = False
    _lost: bool = False

    def restart(self) -> None:
        """A new line: what was left of the old one's last frame is forgotten."""
        self._rest = b""
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """The messages completed by `data`. Never raises; holds at most LONGEST bytes."""
        self.taken += len(data)
        *pieces, rest = (self._rest + data).split(b"\0")
        messages = []
        for piece in pieces:
            if self._skipping:
                self._skipping = False
                continue
            if not piece:
                continue
            message = _unframe(piece)
            if message is None:
                self.crc_errors += 1
                self._lost = True
                continue
            if self._lost:
                self.resyncs += 1
                self._lost = False
            messages.append(message)
        if len(rest) > LONGEST:
            if not self._skipping:
                self.crc_errors += 1
            self._skipping = self._lost = True
            rest = b""
        self._rest = rest
        self.frames += len(messages)
        return messages


def _unframe(piece: bytes) -> bytes | None:
    if len(piece) > LONGEST:
        return None
    try:
        content: bytes = cobs.decode(piece)
    except cobs.DecodeError:
        return None
    if len(content) < 3 or binascii.crc_hqx(content, 0xFFFF):
        return None
    return content[:-2]
