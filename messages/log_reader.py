"""Reading a log back: record by record, checked, and honest about where it ends."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NoReturn

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from vibrissa.messages.log_format import (
    CHUNK_BYTES,
    FOOTER,
    HEAD,
    MALFORMED,
    PROFILE,
    Channel,
    LogCutOffError,
    LogDamagedError,
    NotALogError,
    Record,
    chunk_span,
    frame_records,
    parse_channels,
    parse_chunk,
    parse_metadata,
    reason,
    summary_is_intact,
    unpack_chunk,
)


class LogReader:
    """Reads a log in file order; memory is bounded by the largest chunk.

    Iterating yields `Record`; every iteration starts over. `run_id`, `metadata` and `channels` are
    known at once. Once an iteration came to its end, `complete` says whether the log was closed,
    `cut_at` is the byte offset of the first incomplete record, `end` holds the cause and counts
    written at the close, `extra` the other metadata records by name.

    Raises NotALogError for foreign files, LogDamagedError where bytes have changed, and
    LogCutOffError for a log that was not closed. With `allow_cut` such a log is read up to its last
    complete chunk, and `complete` is False; it must still tell its run.
    """

    def __init__(self, path: str | os.PathLike[str], *, allow_cut: bool = False) -> None:
        self.path = Path(path)
        self.complete: bool | None = None
        self.cut_at: int | None = None
        self.end: dict[str, str] | None = None
        self.extra: dict[str, dict[str, str]] = {}
        with open(self.path, "rb") as stream:
            self.size = os.fstat(stream.fileno()).st_size
            self._data_start = self._check_header(stream)
            stream.seek(self.size - len(MCAP0_MAGIC))
            self._closed = stream.read() == MCAP0_MAGIC
            if not self._closed and not allow_cut:
                raise LogCutOffError(f"{path}: cut off, {self.size} bytes without an end mark")
            self.metadata = self._run_metadata(stream)
            self.run_id = self.metadata.pop("run_id")
            self._by_id = self._read_channels(stream)
            self.channels = tuple(self._by_id.values())

    def __iter__(self) -> Iterator[Record]:
        return self.records(_raise)

    def records(self, on_damage: Callable[[LogDamagedError], None]) -> Iterator[Record]:
        """Like iterating, but `on_damage` gets the error, and damage is skipped if it returns."""
        self.complete, self.cut_at, self.end, self.extra = None, None, None, {}
        lost: tuple[int, list[str]] | None = None  # a damaged chunk and what is known of it
        for offset, opcode, body in self._data_section(on_damage):
            if opcode == Opcode.MESSAGE_INDEX:
                if lost and (channel := self._by_id.get(int.from_bytes(body[:2], "little"))):
                    lost[1].append(f"{channel.topic} of {channel.source}")
                continue
            if lost:
                on_damage(self._damaged(lost[0], ", ".join(lost[1])))
                lost = None
            if opcode == Opcode.METADATA:
                self._take_metadata(offset, body, on_damage)
                continue
            try:
                found = parse_chunk(unpack_chunk(body), self._by_id)
            except MALFORMED as error:
                lost = offset, [f"{reason(error)} in the chunk of {chunk_span(body)}"]
                continue
            yield from found
        if lost:
            on_damage(self._damaged(lost[0], ", ".join(lost[1])))

    def _data_section(
        self, on_damage: Callable[[LogDamagedError], None]
    ) -> Iterator[tuple[int, int, bytes]]:
        """The records before DATA_END; checks the CRCs of the data section and of the summary."""
        damaged = False

        def on_broken(offset: int, following: int | None) -> None:
            nonlocal damaged
            if following is None and not self._closed:
                self.cut_at = offset
            else:
                damaged = True
                on_damage(self._damaged(offset, "no well-formed record"))

        with open(self.path, "rb") as stream:
            crc = zlib.crc32(stream.read(self._data_start))
            ended = None
            for offset, opcode, body in frame_records(
                stream, self._data_start, self.size, on_broken
            ):
                if opcode == Opcode.DATA_END:
                    ended = offset, int.from_bytes(body, "little")
                    break
                crc = zlib.crc32(body, zlib.crc32(HEAD.pack(opcode, len(body)), crc))
                yield offset, opcode, body
            self.complete = False
            if ended is None:
                return
            offset, expected = ended
            if expected not in (0, crc) and not damaged:
                on_damage(self._damaged(offset, f"CRC of the data {crc:08x}, not {expected:08x}"))
            summary = offset + HEAD.size + 4
            if not self._closed:
                self.cut_at = summary
            elif summary_is_intact(stream, summary, self.size):
                self.complete = True
            else:
                on_damage(self._damaged(summary, "CRC of the summary does not match"))

    def _take_metadata(
        self, offset: int, body: bytes, on_damage: Callable[[LogDamagedError], None]
    ) -> None:
        try:
            name, data = parse_metadata(body)
        except MALFORMED as error:
            on_damage(self._damaged(offset, reason(error)))
            return
        if name == "end":
            self.end = data
        elif name != "run":
            self.extra[name] = data
        elif data.get("run_id") != self.run_id:
            both = f"{self.run_id!r} and {data.get('run_id')!r}"
            raise NotALogError(f"{self.path}: holds the runs {both}, expected one")

    def _damaged(self, offset: int, what: str) -> LogDamagedError:
        return LogDamagedError(f"{self.path}: damaged at byte {offset}: {what}")

    def _check_header(self, stream: BinaryIO) -> int:
        """The offset behind the header of this profile."""
        start = stream.read(len(MCAP0_MAGIC) + HEAD.size)
        if not start or not (MCAP0_MAGIC.startswith(start) or start.startswith(MCAP0_MAGIC)):
            raise NotALogError(f"{self.path}: not an MCAP file, it starts with {start[:8]!r}")
        opcode, length = HEAD.unpack(start[8:]) if len(start) == 8 + HEAD.size else (0, 0)
        if opcode not in (0, Opcode.HEADER) or length > CHUNK_BYTES:
            raise NotALogError(f"{self.path}: no MCAP header at byte {len(MCAP0_MAGIC)}")
        body = stream.read(length)
        if opcode == 0 or len(body) < length:
            raise LogCutOffError(f"{self.path}: cut off at byte {self.size}, in its header")
        try:
            profile = records.Header.read(ReadDataStream(BytesIO(body))).profile
        except MALFORMED as error:
            raise NotALogError(f"{self.path}: malformed header: {reason(error)}") from error
        if profile != PROFILE:
            raise NotALogError(f"{self.path}: MCAP profile {profile!r}, expected {PROFILE!r}")
        return stream.tell()

    def _run_metadata(self, stream: BinaryIO) -> dict[str, str]:
        def on_broken(offset: int, following: int | None) -> None:
            if following is None and not self._closed:
                raise LogCutOffError(f"{self.path}: cut off at byte {offset}, before its run id")
            raise self._damaged(offset, "no well-formed record")

        for offset, opcode, body in frame_records(stream, self._data_start, self.size, on_broken):
            if opcode != Opcode.METADATA:
                break
            try:
                name, data = parse_metadata(body)
            except MALFORMED as error:
                raise self._damaged(offset, reason(error)) from error
            if name == "run" and "run_id" in data:
                return data
        raise NotALogError(f"{self.path}: no run id before the first message")

    def _read_channels(self, stream: BinaryIO) -> dict[int, Channel]:
        """The channels stand in the first chunk; the summary of a closed log repeats them."""
        first = frame_records(stream, self._data_start, self.size, lambda *_: None)
        chunk = next((body for _, opcode, body in first if opcode == Opcode.CHUNK), None)
        try:
            if chunk is not None and (channels := parse_channels(unpack_chunk(chunk))):
                return channels
        except MALFORMED as error:
            if not self._closed:
                raise self._damaged(self._data_start, f"first chunk: {reason(error)}") from error
        if not self._closed:
            return {}
        try:
            stream.seek(self.size - len(MCAP0_MAGIC) - FOOTER.size)
            stream.seek(FOOTER.unpack(stream.read(FOOTER.size))[2])
            return parse_channels(stream.read())
        except (*MALFORMED, OSError, OverflowError) as error:
            raise self._damaged(self.size, f"channels in summary: {reason(error)}") from error


def _raise(error: LogDamagedError) -> NoReturn:
    raise error
