"""What a log is made of: its errors, its records, and where they begin and end in the file.

A log is an MCAP file of profile ``vibrissa``: a ``run`` metadata record, lz4 chunks of 64 KiB with
their message indexes, an ``end`` metadata record, and the MCAP summary. Every byte that reading
depends on is covered by a CRC, also in a log that was cut off: chunks by their own, metadata by an
entry ``crc32``. A log that was closed has a CRC over all its data and one over its summary on top.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO, NamedTuple

import lz4.frame
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

PROFILE = "vibrissa"
CHUNK_BYTES = 64 * 1024
MAX_MESSAGE_BYTES = 64 << 20
MAX_CHUNK_BYTES = MAX_MESSAGE_BYTES + 2 * CHUNK_BYTES

HEAD = struct.Struct("<BQ")  # opcode, length of the body
FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of summary, of its offsets, CRC
_MESSAGE = struct.Struct("<QHIQQ")  # length of the body, channel, seq, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # first t, last t, size and CRC unpacked, length of compression
_CRC_KEY = "crc32"
_LZ4 = struct.pack("<I", 3) + b"lz4"

# What the bytes of a damaged record can make the parsers raise.
MALFORMED = (struct.error, ValueError, KeyError, IndexError, RuntimeError, MemoryError, McapError)


class LogError(ValueError):
    """Base of everything that can be wrong with a log."""


class LogExistsError(LogError):
    """The file to be written exists; a log is never overwritten."""


class LogWriteError(LogError):
    """The file takes no more: disk full, file too large, directory missing, already closed."""


class NotALogError(LogError):
    """The file is no MCAP file, not of this profile, or holds several runs."""


class LogDamagedError(LogError):
    """Bytes of the log changed after they were written."""


class LogCutOffError(LogError):
    """The log was not closed: its writer crashed, was killed, or is still writing."""


@dataclass(frozen=True, slots=True)
class Channel:
    """What one source sends on one topic; `schema_json` is a JSON Schema document."""

    topic: str
    source: str
    schema_name: str
    schema_json: str


class Record(NamedTuple):
    """One message as it was recorded; `t` is logical time in ns, `data` the encoded message."""

    topic: str
    source: str
    seq: int
    t: int
    data: bytes


def reason(error: BaseException) -> str:
    """The error in one line."""
    return (str(error) or type(error).__name__).splitlines()[0]


def sealed(name: str, data: Mapping[str, str]) -> dict[str, str]:
    """`data` in a fixed order with a CRC over it, as a metadata record stores it."""
    for key, value in data.items():
        if not isinstance(key, str) or not isinstance(value, str) or key == _CRC_KEY:
            raise ValueError(f"metadata {name!r}: {key!r}: {value!r}, expected text for a free key")
    ordered = dict(sorted(data.items()))
    return {**ordered, _CRC_KEY: _seal(name, ordered)}


def parse_metadata(body: bytes) -> tuple[str, dict[str, str]]:
    """Name and entries of a metadata record; raises one of MALFORMED."""
    record = records.Metadata.read(ReadDataStream(BytesIO(body)))
    data = dict(record.metadata)
    if data.pop(_CRC_KEY, None) != _seal(record.name, data):
        raise ValueError(f"CRC of metadata {record.name!r} does not match")
    return record.name, data


def _seal(name: str, data: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps([name, *data.items()]).encode()):08x}"


def parse_channels(data: bytes) -> dict[int, Channel]:
    """The channels by MCAP id that unpacked records begin with; raises one of MALFORMED."""
    schemas: dict[int, records.Schema] = {}
    channels: dict[int, Channel] = {}
    pos = 0
    while pos < len(data) and data[pos] in (Opcode.SCHEMA, Opcode.CHANNEL):
        opcode, length = HEAD.unpack_from(data, pos)
        body = ReadDataStream(BytesIO(data[pos + HEAD.size : pos + HEAD.size + length]))
        pos += HEAD.size + length
        if opcode == Opcode.SCHEMA:
            schema = records.Schema.read(body)
            schemas[schema.id] = schema
        else:
            channel = records.Channel.read(body)
            schema = schemas[channel.schema_id]
            channels[channel.id] = Channel(
                channel.topic, channel.metadata["source"], schema.name, schema.data.decode()
            )
    return channels


def unpack_chunk(body: bytes) -> bytes:
    """The records in a chunk, decompressed and checked; raises one of MALFORMED."""
    _, _, size, crc, name_length = _CHUNK.unpack_from(body)
    start = _CHUNK.size + name_length + 8
    if body[_CHUNK.size - 4 : start - 8] != _LZ4:
        raise ValueError(f"compression {body[_CHUNK.size : start - 8]!r}, expected b'lz4'")
    packed = body[start:]
    # A wrong size here would otherwise be allocated before anything else notices.
    if lz4.frame.get_frame_info(packed)["content_size"] not in (0, size) or size > MAX_CHUNK_BYTES:
        raise ValueError(f"unpacked size {size} is not that of the content")
    data: bytes = lz4.frame.decompress(packed)
    if zlib.crc32(data) != crc:
        raise ValueError(f"CRC {zlib.crc32(data):08x}, expected {crc:08x}")
    return data


def parse_chunk(data: bytes, channels: Mapping[int, Channel]) -> list[Record]:
    """The messages among the records of an unpacked chunk; raises one of MALFORMED."""
    keys = {number: (channel.topic, channel.source) for number, channel in channels.items()}
    found: list[Record] = []
    pos = 0
    while pos < len(data):
        if data[pos] == Opcode.MESSAGE:
            length, number, seq, t, _ = _MESSAGE.unpack_from(data, pos + 1)
            start, pos = pos + 1 + _MESSAGE.size, pos + HEAD.size + length
            topic, source = keys[number]
            found.append(Record(topic, source, seq, t, data[start:pos]))
        else:
            pos += HEAD.size + HEAD.unpack_from(data, pos)[1]
    if pos != len(data):
        raise ValueError(f"last record ends at {pos}, expected {len(data)}")
    return found


def chunk_span(body: bytes) -> str:
    """When the messages of a chunk were sent, for error messages."""
    first, last, *_ = _CHUNK.unpack_from(body)
    return f"t {first} to {last} ns"


def frame_records(
    stream: BinaryIO,
    start: int,
    size: int,
    on_broken: Callable[[int, int | None], None],
) -> Iterator[tuple[int, int, bytes]]:
    """The records of the data section as (offset, opcode, body), up to and with DATA_END.

    Where no whole, well-formed record starts, `on_broken` is called with the offset and that of
    the next chunk, or None if none follows. Reading goes on there if it returns.
    """
    offset: int | None = start
    while offset is not None:
        stream.seek(offset)
        head = stream.read(HEAD.size)
        if len(head) == HEAD.size:
            opcode, length = HEAD.unpack(head)
            if offset + HEAD.size + length <= size and length <= MAX_CHUNK_BYTES:
                body = stream.read(length)
                if _is_well_formed(opcode, body):
                    yield offset, opcode, body
                    if opcode == Opcode.DATA_END:
                        return
                    offset += HEAD.size + length
                    continue
        following = _next_chunk(stream, offset + 1, size)
        on_broken(offset, following)
        offset = following


def _is_well_formed(opcode: int, body: bytes) -> bool:
    """Whether the lengths inside a record add up; also refuses records that no log contains."""
    try:
        if opcode == Opcode.CHUNK:
            at = _CHUNK.size + int.from_bytes(body[_CHUNK.size - 4 : _CHUNK.size], "little")
            return at + 8 + int.from_bytes(body[at : at + 8], "little") == len(body)
        if opcode == Opcode.MESSAGE_INDEX:
            return 6 + int.from_bytes(body[2:6], "little") == len(body)
        if opcode == Opcode.METADATA:
            at = 4 + int.from_bytes(body[:4], "little")
            return at + 4 + int.from_bytes(body[at : at + 4], "little") == len(body)
    except OverflowError:
        return False
    return opcode == Opcode.DATA_END and len(body) == 4


def _next_chunk(stream: BinaryIO, offset: int, size: int) -> int | None:
    """Offset of the next chunk at or after `offset`, recognised by its fixed bytes and lengths."""
    before = HEAD.size + _CHUNK.size - 4
    fixed = before + len(_LZ4) + 8
    stream.seek(offset)
    block = stream.read(4 * CHUNK_BYTES)
    while len(block) >= fixed:
        at = block.find(_LZ4, before)
        while 0 <= at <= len(block) - len(_LZ4) - 8:
            opcode, length = HEAD.unpack_from(block, at - before)
            (packed,) = struct.unpack_from("<Q", block, at + len(_LZ4))
            ends = offset + at - before + HEAD.size + length
            if opcode == Opcode.CHUNK and length == fixed - HEAD.size + packed and ends <= size:
                return offset + at - before
            at = block.find(_LZ4, at + 1)
        step = len(block) - fixed + 1
        offset += step
        block = block[step:] + stream.read(4 * CHUNK_BYTES)
    return None


def summary_is_intact(stream: BinaryIO, start: int, size: int) -> bool:
    """Whether the summary from `start` to the end of the file agrees with its CRC."""
    footer_at = size - len(MCAP0_MAGIC) - FOOTER.size
    if footer_at < start:
        return False
    stream.seek(start)
    crc = 0
    while (left := footer_at - stream.tell()) > 0:
        crc = zlib.crc32(stream.read(min(left, 1 << 20)), crc)
    footer = stream.read(FOOTER.size)
    opcode, length, summary_start, _, expected = FOOTER.unpack(footer)
    return (
        (opcode, length) == (Opcode.FOOTER, FOOTER.size - HEAD.size)
        and summary_start in (0, start)
        and zlib.crc32(footer[:-4], crc) == expected
    )
