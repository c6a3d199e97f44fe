"""The log: one MCAP file per run, written so that a crash loses little and damage is never silent.

Layout of a log (MCAP profile ``vibrissa``): a ``run`` metadata record, then lz4 chunks of 64 KiB
with their message indexes, then an ``end`` metadata record and the usual MCAP summary. Every byte
that reading depends on is covered by a CRC, also in a log that was cut off: chunks by their own,
metadata by an entry ``crc32``; a log that was closed has a CRC over the whole file on top.
Nothing in the file depends on the wall clock: the same calls give the same bytes.
"""

from __future__ import annotations

import json
import os
import struct
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple, NoReturn, Self

import lz4.frame
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from vibrissa import __version__

PROFILE = "vibrissa"
CHUNK_BYTES = 64 * 1024
MAX_MESSAGE_BYTES = 128 * 1024 * 1024
MAX_SEQ = 2**32 - 1
MAX_T_NS = 2**63 - 1

_HEAD = struct.Struct("<BQ")  # opcode, length of the body
_MESSAGE = struct.Struct("<QHIQQ")  # length of the body, channel, seq, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # first t, last t, size and CRC unpacked, length of "lz4"
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, offsets start, CRC
_LZ4 = struct.pack("<I", 3) + b"lz4"


class LogError(ValueError):
    """Base of everything that can be wrong with a log."""


class LogExistsError(LogError):
    """The file to be written exists; a log is never overwritten."""


class LogWriteError(LogError):
    """The file can't take more: disk full, file too large, directory missing, already closed."""


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


class _Output:
    """The file below the MCAP writer: unbuffered, so that a closed chunk survives a SIGKILL."""

    def __init__(self, stream: Any, name: str) -> None:
        self.stream = stream
        self.name = name
        self.size = 0

    def write(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            while view:
                written = self.stream.write(view)
                self.size += written
                view = view[written:]
        except OSError as error:
            raise LogWriteError(f"{self.name}: {error.strerror}, {self.size} bytes in") from error

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        try:
            self.stream.flush()
        except OSError as error:
            raise LogWriteError(f"{self.name}: {error.strerror}, {self.size} bytes in") from error


class LogWriter:
    """Writes a log.

    `target` is a path, created here and closed by `close`, or a binary stream, which stays open.
    `metadata` (configuration, versions, code hash) and `run_id` go to the start of the file.

    Raises LogExistsError if the path exists, LogWriteError (here and in every later call) if the
    file can't be written, ValueError for bad arguments. After a LogWriteError nothing more is
    accepted; what was written before is readable with ``LogReader(path, allow_cut=True)``.
    """

    def __init__(
        self,
        target: str | os.PathLike[str] | BinaryIO,
        *,
        run_id: str,
        channels: Sequence[Channel],
        metadata: Mapping[str, str],
    ) -> None:
        if not run_id:
            raise ValueError("run id is empty, expected a name")
        keys = [(channel.topic, channel.source) for channel in channels]
        for topic, source in keys:
            if keys.count((topic, source)) > 1:
                raise ValueError(f"channel {topic} of {source} is given twice, expected once")
        run = _sealed({"run_id": run_id}, metadata)

        self._closed = False
        self._counts = [0] * len(channels)
        self._chunk_since: float | None = None
        self._owned: BinaryIO | None = None
        if isinstance(target, (str, os.PathLike)):
            self.name = os.fspath(target)
            try:
                self._owned = open(target, "xb", buffering=0)  # noqa: SIM115
            except FileExistsError as error:
                raise LogExistsError(f"{self.name}: exists, a log is never overwritten") from error
            except OSError as error:
                raise LogWriteError(f"{self.name}: {error.strerror}") from error
            self._out = _Output(self._owned, self.name)
        else:
            self.name = "stream"
            self._out = _Output(target, self.name)
        self._mcap: Any = Writer(
            self._out,  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.LZ4,
            enable_data_crcs=True,
        )
        with self._abandon_on_error():
            self._mcap.start(profile=PROFILE, library=f"vibrissa {__version__}")
            self._mcap.add_metadata("run", run)
            self._ids = self._register(channels)
            self._out.flush()

    def _register(self, channels: Sequence[Channel]) -> list[int]:
        schemas: dict[tuple[str, str], int] = {}
        ids = []
        for channel in channels:
            key = (channel.schema_name, channel.schema_json)
            if key not in schemas:
                schemas[key] = self._mcap.register_schema(
                    channel.schema_name, "jsonschema", channel.schema_json.encode()
                )
            ids.append(
                self._mcap.register_channel(
                    channel.topic, "msgpack", schemas[key], {"source": channel.source}
                )
            )
        return ids

    def write(self, channel: int, seq: int, t_ns: int, data: bytes) -> None:
        """Append one message of `channels[channel]`; `t_ns` is logical time since the start, ns."""
        if not 0 <= channel < len(self._ids):
            raise ValueError(f"{self.name}: channel {channel}, expected 0..{len(self._ids) - 1}")
        if not 0 <= seq <= MAX_SEQ:
            raise ValueError(f"{self.name}: seq {seq}, expected 0..{MAX_SEQ}")
        if not 0 <= t_ns <= MAX_T_NS:
            raise ValueError(f"{self.name}: t {t_ns} ns, expected 0..{MAX_T_NS}")
        if len(data) > MAX_MESSAGE_BYTES:
            raise ValueError(f"{self.name}: {len(data)} bytes, expected <= {MAX_MESSAGE_BYTES}")
        if self._closed:
            raise LogWriteError(f"{self.name}: closed, takes no more messages")
        if self._chunk_since is None:
            self._chunk_since = time.monotonic()
        size = self._out.size
        try:
            self._mcap.add_message(self._ids[channel], t_ns, data, t_ns, seq)
            if self._out.size != size:
                self._chunk_since = None
                self._out.flush()
        except LogWriteError:
            self._abandon()
            raise
        self._counts[channel] += 1

    def sync(self, max_age: float = 0.0) -> None:
        """Close the open chunk if its first message was accepted `max_age` s ago or earlier.

        Called every p seconds, a SIGKILL loses at most the last p + max_age seconds. With the
        default 0 the file does not depend on the clock, only on where the calls were made.
        """
        if self._chunk_since is None or self._closed:
            return
        if time.monotonic() - self._chunk_since >= max_age:
            self._chunk_since = None
            with self._abandon_on_error():
                self._mcap.flush()

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Append a metadata record; `run` and `end` are the writer's own names."""
        if name in ("run", "end"):
            raise ValueError(f"{self.name}: metadata {name!r} is written by the log itself")
        sealed = _sealed({}, data)
        if self._closed:
            raise LogWriteError(f"{self.name}: closed, takes no more metadata")
        self.sync()
        with self._abandon_on_error():
            self._mcap.add_metadata(name, sealed)

    def close(self, cause: str = "stop") -> None:
        """Write the rest, why the run ended and how much there is; to disk, not only to the cache.

        Does nothing if the log is closed already or was given up after a LogWriteError.
        """
        if self._closed:
            return
        with self._abandon_on_error():
            self._mcap.flush()
            counts = {"cause": cause, "counts": json.dumps(self._counts)}
            self._mcap.add_metadata("end", _sealed(counts, {}))
            self._mcap.finish()
            self._out.flush()
            if self._owned is not None:
                try:
                    os.fsync(self._owned.fileno())
                except OSError as error:
                    raise LogWriteError(f"{self.name}: {error.strerror}") from error
        self._abandon()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close("stop" if kind is None else kind.__name__)

    def _abandon(self) -> None:
        self._closed = True
        if self._owned is not None:
            self._owned.close()

    def _abandon_on_error(self) -> _Abandon:
        return _Abandon(self._abandon)


class _Abandon:
    def __init__(self, abandon: Callable[[], None]) -> None:
        self.abandon = abandon

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if kind is not None:
            self.abandon()


class LogReader:
    """Reads a log in file order; memory is bounded by the largest chunk.

    Iterating yields `Record`; each iteration starts over. `run_id`, `metadata` and `channels` are
    known at once; `complete`, `cut_at` (byte offset of the first incomplete record, or None), `end`
    (why and with which counts the log was closed) and `extra` (other metadata records by name) once
    an iteration came to its end, None or empty before.

    Raises NotALogError for foreign files, LogDamagedError where bytes have changed, and
    LogCutOffError for a log that was not closed: with `allow_cut` only if not even the run is
    known, otherwise up to the last complete chunk is read and `complete` is False.
    """

    def __init__(self, path: str | os.PathLike[str], *, allow_cut: bool = False) -> None:
        self.path = Path(path)
        self.complete: bool | None = None
        self.cut_at: int | None = None
        self.end: dict[str, str] | None = None
        self.extra: dict[str, dict[str, str]] = {}
        self.channels: tuple[Channel, ...] = ()
        self._by_id: dict[int, tuple[str, str]] = {}
        with open(self.path, "rb") as stream:
            self.size = os.fstat(stream.fileno()).st_size
            self._check_profile(stream)
            stream.seek(max(0, self.size - len(MCAP0_MAGIC)))
            self._has_end_mark = stream.read() == MCAP0_MAGIC and self.size > len(MCAP0_MAGIC)
            if not self._has_end_mark and not allow_cut:
                raise LogCutOffError(f"{path}: cut off, no end mark after {self.size} bytes")
            run = self._first_metadata(stream)
            self.run_id = run.pop("run_id")
            self.metadata = run
            self._read_channels(stream)

    def __iter__(self) -> Iterator[Record]:
        return self.records(_raise)

    def records(self, on_damage: Callable[[LogDamagedError], None]) -> Iterator[Record]:
        """Like iterating, but damage is given to `on_damage`; if that returns, it is skipped."""
        self.extra, self.end, self.cut_at, self.complete = {}, None, None, None
        damage: tuple[int, str] | None = None
        topics: list[str] = []
        for offset, opcode, body in self._data_section(on_damage):
            if opcode == Opcode.MESSAGE_INDEX:
                if damage:  # the index behind a damaged chunk tells what it held
                    key = self._by_id.get(int.from_bytes(body[:2], "little"))
                    topics += [] if key is None else [f"{key[0]} of {key[1]}"]
                continue
            if damage:
                on_damage(self._chunk_damage(*damage, topics))
                damage, topics = None, []
            if opcode == Opcode.METADATA:
                self._take_metadata(offset, body, on_damage)
            elif opcode == Opcode.CHUNK:
                try:
                    chunk = _parse_chunk(_unpack_chunk(body), self._by_id)
                except _BAD as error:
                    span = _span(body)
                    damage = (offset, f"{_reason(error)}, chunk of {span}")
                    continue
                yield from chunk
        if damage:
            on_damage(self._chunk_damage(*damage, topics))

    def _chunk_damage(self, offset: int, what: str, topics: list[str]) -> LogDamagedError:
        holding = f" holding {', '.join(topics)}" if topics else ""
        return self._damaged(offset, what + holding)

    def _damaged(self, offset: int, what: str) -> LogDamagedError:
        return LogDamagedError(f"{self.path}: damaged at byte {offset}: {what}")

    def _check_profile(self, stream: BinaryIO) -> None:
        magic = stream.read(len(MCAP0_MAGIC))
        head = stream.read(_HEAD.size)
        if not MCAP0_MAGIC.startswith(magic):
            raise NotALogError(f"{self.path}: not an MCAP file, it starts with {magic!r}")
        if len(head) < _HEAD.size:
            raise LogCutOffError(f"{self.path}: cut off at byte {self.size}, before its header")
        opcode, length = _HEAD.unpack(head)
        if opcode != Opcode.HEADER or length > 1024:
            raise NotALogError(f"{self.path}: no MCAP header record at byte {len(MCAP0_MAGIC)}")
        body = stream.read(length)
        if len(body) < length:
            raise LogCutOffError(f"{self.path}: cut off at byte {self.size}, in its header")
        try:
            header = records.Header.read(ReadDataStream(BytesIO(body)))
        except _BAD as error:
            raise NotALogError(f"{self.path}: unreadable MCAP header: {_reason(error)}") from error
        if header.profile != PROFILE:
            raise NotALogError(
                f"{self.path}: MCAP profile {header.profile!r}, expected {PROFILE!r}"
            )
        self._data_start = stream.tell()

    def _first_metadata(self, stream: BinaryIO) -> dict[str, str]:
        for offset, opcode, body in self._framed(stream, self._data_start):
            if opcode != Opcode.METADATA:
                break
            name, data = self._parse_metadata(offset, body)
            if name == "run" and "run_id" in data:
                return data
            break
        else:
            raise LogCutOffError(f"{self.path}: cut off at byte {self.cut_at}, before its run id")
        raise NotALogError(f"{self.path}: does not start with the metadata of a run")

    def _read_channels(self, stream: BinaryIO) -> None:
        """The channels stand in the first chunk; the summary repeats them if the log was closed."""
        for _, opcode, body in self._framed(stream, self._data_start):
            if opcode == Opcode.CHUNK:
                try:
                    return self._take_channels(_unpack_chunk(body))
                except _BAD:
                    break
            if opcode == Opcode.DATA_END:
                break
        if self._has_end_mark:
            try:
                stream.seek(self.size - len(MCAP0_MAGIC) - _FOOTER.size)
                start = _FOOTER.unpack(stream.read(_FOOTER.size))[2]
                stream.seek(start)
                self._take_channels(stream.read(self.size - start))
            except _BAD as error:
                raise self._damaged(self.size, f"no channels in summary: {_reason(error)}") from error

    def _take_channels(self, data: bytes) -> None:
        schemas: dict[int, records.Schema] = {}
        channels = []
        pos = 0
        while pos < len(data) and data[pos] in (Opcode.SCHEMA, Opcode.CHANNEL):
            opcode, length = _HEAD.unpack_from(data, pos)
            body = ReadDataStream(BytesIO(data[pos + _HEAD.size : pos + _HEAD.size + length]))
            pos += _HEAD.size + length
            if opcode == Opcode.SCHEMA:
                schema = records.Schema.read(body)
                schemas[schema.id] = schema
                continue
            channel = records.Channel.read(body)
            source = channel.metadata["source"]
            schema = schemas[channel.schema_id]
            channels.append(Channel(channel.topic, source, schema.name, schema.data.decode()))
            self._by_id[channel.id] = (channel.topic, source)
        self.channels = tuple(channels)

    def _parse_metadata(self, offset: int, body: bytes) -> tuple[str, dict[str, str]]:
        try:
            stream = ReadDataStream(BytesIO(body))
            record = records.Metadata.read(stream)
            if stream.count != len(body):
                raise ValueError(f"{len(body)} bytes, expected {stream.count}")
            return record.name, _unsealed(record.name, record.metadata)
        except _BAD as error:
            raise self._damaged(offset, f"metadata record: {_reason(error)}") from error

    def _take_metadata(
        self, offset: int, body: bytes, on_damage: Callable[[LogDamagedError], None]
    ) -> None:
        try:
            name, data = self._parse_metadata(offset, body)
        except LogDamagedError as error:
            return on_damage(error)
        if name == "end":
            self.end = data
        elif name != "run":
            self.extra[name] = data
        elif data.get("run_id") != self.run_id:
            raise NotALogError(
                f"{self.path}: holds the runs {self.run_id!r} and {data.get('run_id')!r}, expected one"
            )

    def _framed(
        self, stream: BinaryIO, offset: int, resync: Callable[[LogDamagedError], None] | None = None
    ) -> Iterator[tuple[int, int, bytes]]:
        """The records of the data section as (offset, opcode, body), DATA_END included.

        Stops with `cut_at` set where the file was cut off; `resync` is told of broken framing,
        reading goes on at the next chunk if it returns.
        """
        while True:
            stream.seek(offset)
            head = stream.read(_HEAD.size)
            opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, self.size)
            body = b"" if offset + _HEAD.size + length > self.size else stream.read(length)
            if len(head) == _HEAD.size and len(body) == length and _is_record(opcode, body):
                yield offset, opcode, body
                offset += _HEAD.size + length
                if opcode == Opcode.DATA_END:
                    return
                continue
            found = self._next_chunk(stream, offset + 1)
            overrun = offset + _HEAD.size + length > self.size
            if overrun and found is None and not self._has_end_mark:
                self.cut_at = offset
                return
            (resync or _raise)(self._damaged(offset, "no valid MCAP record starts here"))
            if found is None:
                return
            offset = found

    def _data_section(
        self, on_damage: Callable[[LogDamagedError], None]
    ) -> Iterator[tuple[int, int, bytes]]:
        """Like `_framed`, with the CRC over the section and the end of the file checked."""
        damages = 0

        def count(error: LogDamagedError) -> None:
            nonlocal damages
            damages += 1
            on_damage(error)

        with open(self.path, "rb") as stream:
            start = stream.read(self._data_start)
            crc = zlib.crc32(start)
            ended = None
            for offset, opcode, body in self._framed(stream, self._data_start, count):
                if opcode == Opcode.DATA_END:
                    ended = (offset, int.from_bytes(body, "little"))
                    break
                crc = zlib.crc32(body, zlib.crc32(_HEAD.pack(opcode, len(body)), crc))
                yield offset, opcode, body
            self.complete = False
            if ended is None:
                return
            offset, expected = ended
            if expected not in (0, crc) and damages == 0:
                on_damage(self._damaged(offset, "CRC of the data section does not match"))
            summary = offset + _HEAD.size + 4
            if not self._has_end_mark:
                self.cut_at = summary
            elif self._summary_is_intact(stream, summary):
                self.complete = True
            else:
                on_damage(self._damaged(summary, "CRC of the summary does not match"))

    def _summary_is_intact(self, stream: BinaryIO, start: int) -> bool:
        footer_at = self.size - len(MCAP0_MAGIC) - _FOOTER.size
        if footer_at < start:
            return False
        stream.seek(start)
        crc = 0
        while (left := footer_at - stream.tell()) > 0:
            crc = zlib.crc32(stream.read(min(left, 1 << 20)), crc)
        footer = stream.read(_FOOTER.size)
        opcode, length, summary_start, _, expected = _FOOTER.unpack(footer)
        if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - _HEAD.size):
            return False
        at_start = summary_start in (0, start)
        return at_start and zlib.crc32(footer[:-4], crc) == expected

    def _next_chunk(self, stream: BinaryIO, offset: int) -> int | None:
        """Offset of the next thing that looks like a whole chunk, found by its fixed bytes."""
        before = _HEAD.size + _CHUNK.size - 4
        needed = _HEAD.size + _CHUNK.size + len(_LZ4) - 4 + 8
        stream.seek(offset)
        block = stream.read(4 * CHUNK_BYTES)
        while len(block) >= needed:
            at = block.find(_LZ4, before)
            while at >= 0:
                begin = at - before
                opcode, length = _HEAD.unpack_from(block, begin)
                size = block[at + len(_LZ4) : at + len(_LZ4) + 8]
                fits = offset + begin + _HEAD.size + length <= self.size
                same = length == needed - _HEAD.size + int.from_bytes(size, "little")
                if opcode == Opcode.CHUNK and fits and same and len(size) == 8:
                    return offset + begin
                at = block.find(_LZ4, at + 1)
            step = len(block) - needed + 1
            offset += step
            block = block[step:] + stream.read(4 * CHUNK_BYTES)
        return None


_BAD = (struct.error, ValueError, KeyError, IndexError, RuntimeError, MemoryError, McapError)


def _raise(error: LogDamagedError) -> NoReturn:
    raise error


def _reason(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
