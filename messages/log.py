"""The log: one MCAP file per run, written so that a crash loses little and damage is never silent.

Nothing in the file depends on the wall clock: the same calls give the same bytes.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any, BinaryIO, Self

from mcap.writer import CompressionType, Writer

from vibrissa import __version__
from vibrissa.messages.log_format import (
    CHUNK_BYTES,
    MAX_MESSAGE_BYTES,
    PROFILE,
    Channel,
    LogCutOffError,
    LogDamagedError,
    LogError,
    LogExistsError,
    LogWriteError,
    NotALogError,
    Record,
    sealed,
)
from vibrissa.messages.log_reader import LogReader

__all__ = [
    "Channel",
    "LogCutOffError",
    "LogDamagedError",
    "LogError",
    "LogExistsError",
    "LogReader",
    "LogWriteError",
    "LogWriter",
    "NotALogError",
    "Record",
]

MAX_SEQ = 2**32 - 1
MAX_T_NS = 2**63 - 1


class _Output:
    """The file below the MCAP writer: unbuffered, so that a closed chunk survives a SIGKILL."""

    def __init__(self, stream: Any, name: str) -> None:
        self.stream = stream
        self.name = name
        self.size = 0

    def write(self, data: bytes) -> None:
        view = memoryview(data)
        with self._naming_failures():
            while view:
                written = self.stream.write(view)
                self.size += written
                view = view[written:]

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        with self._naming_failures():
            self.stream.flush()

    def to_disk(self) -> None:
        with self._naming_failures():
            os.fsync(self.stream.fileno())

    @contextmanager
    def _naming_failures(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            cause = error.strerror or str(error)
            raise LogWriteError(f"{self.name}: {cause} after {self.size} bytes") from error


class LogWriter:
    """Writes a log.

    `target` is a path, created here and closed by `close`, or a binary stream, which stays open.
    `run_id` and `metadata` (configuration, versions, code hash) go to the start of the file.

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
        if not run_id or "run_id" in metadata:
            raise ValueError(f"run id {run_id!r}, expected a name that metadata does not repeat")
        keys = [(channel.topic, channel.source) for channel in channels]
        if twice := [key for i, key in enumerate(keys) if key in keys[:i]]:
            raise ValueError(f"channel {twice[0][0]} of {twice[0][1]} twice, expected once")
        run = sealed("run", {"run_id": run_id, **metadata})

        self._closed = False
        self._counts = [0] * len(channels)
        self._chunk_since: float | None = None
        self._owned: BinaryIO | None = None
        self.name = "stream"
        if isinstance(target, (str, os.PathLike)):
            self.name = os.fspath(target)
            try:
                self._owned = open(target, "xb", buffering=0)  # noqa: SIM115
            except FileExistsError as error:
                raise LogExistsError(f"{self.name}: exists, a log is never overwritten") from error
            except OSError as error:
                raise LogWriteError(f"{self.name}: {error.strerror}") from error
        self._out = _Output(self._owned or target, self.name)
        self._mcap: Any = Writer(
            self._out,  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.LZ4,
            enable_data_crcs=True,
        )
        try:
            self._mcap.start(profile=PROFILE, library=f"vibrissa {__version__}")
            self._mcap.add_metadata("run", run)
            self._ids = self._register(channels)
            self._out.flush()
        except BaseException:
            self._let_go()
            if self._owned is not None:  # nothing was accepted, so leave nothing in the way
                os.unlink(self.name)
            raise

    def _register(self, channels: Sequence[Channel]) -> list[int]:
        schemas: dict[tuple[str, str], int] = {}
        ids = []
        for channel in channels:
            name, schema = channel.schema_name, channel.schema_json
            if (name, schema) not in schemas:
                number = self._mcap.register_schema(name, "jsonschema", schema.encode())
                schemas[name, schema] = number
            source = {"source": channel.source}
            number = schemas[name, schema]
            ids.append(self._mcap.register_channel(channel.topic, "msgpack", number, source))
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
            if self._out.size != size:  # the message filled the chunk
                self._chunk_since = None
                self._out.flush()
        except LogWriteError:
            self._let_go()
            raise
        self._counts[channel] += 1

    def sync(self, max_age: float = 0.0) -> None:
        """Close the open chunk if its first message was accepted `max_age` s ago or earlier.

        Called every p seconds, a SIGKILL loses at most the last p + max_age seconds. With the
        default 0 the file does not depend on the clock, only on where the calls were made.
        """
        if self._closed or self._chunk_since is None:
            return
        if max_age <= 0 or time.monotonic() - self._chunk_since >= max_age:
            self._chunk_since = None
            with self._or_give_up():
                self._mcap.flush()

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Append a metadata record; the names `run` and `end` are the log's own."""
        if name in ("run", "end"):
            raise ValueError(f"{self.name}: metadata {name!r} is written by the log itself")
        entries = sealed(name, data)
        if self._closed:
            raise LogWriteError(f"{self.name}: closed, takes no more metadata")
        self.sync()
        with self._or_give_up():
            self._mcap.add_metadata(name, entries)

    def close(self, cause: str = "stop") -> None:
        """Write the rest, why the run ended and how many messages there are, and wait for the disk.

        Does nothing if the log is closed already or was given up after a LogWriteError.
        """
        if self._closed:
            return
        end = sealed("end", {"cause": cause, "counts": json.dumps(self._counts)})
        with self._or_give_up():
            self._mcap.flush()
            self._mcap.add_metadata("end", end)
            self._mcap.finish()
            self._out.flush()
            if self._owned is not None:
                self._out.to_disk()
        self._let_go()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close("stop" if kind is None else kind.__name__)

    @contextmanager
    def _or_give_up(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._let_go()
            raise

    def _let_go(self) -> None:
        self._closed = True
        if self._owned is not None:
            self._owned.close()
