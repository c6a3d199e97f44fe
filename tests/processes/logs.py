"""Logs made worse on purpose: altered, incomplete, cut; their CRCs are right again."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vibrissa.messages.codec import Message, decode, encode
from vibrissa.messages.log import LogWriter
from vibrissa.messages.log_format import Record
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes.framelog import frame_of


def write(
    like: Path, out: Path, records: Iterable[Record], metadata: Mapping[str, str] | None = None
) -> Path:
    """A whole, closed log with the run, the channels and (unless given) the metadata of `like`."""
    reader = LogReader(like)
    index = {(c.topic, c.source): i for i, c in enumerate(reader.channels)}
    meta = reader.metadata if metadata is None else metadata
    with LogWriter(out, run_id=reader.run_id, channels=reader.channels, metadata=meta) as writer:
        for record in records:
            writer.write(index[record.topic, record.source], record.seq, record.t, record.data)
    return out


def message(record: Record) -> Message:
    return decode(frame_of(record))


def with_body(record: Record, **fields: Any) -> Record:
    """A record whose message has other values in some fields."""
    changed = message(record)
    body = dataclasses.replace(changed.body, **fields)
    return record._replace(data=encode(changed._replace(body=body))[len(record.topic) + 1 :])


def find(records: list[Record], topic: str, number: int = 0, source: str = "") -> int:
    """Where the message of a topic with this number (negative: from the end) stands."""
    found = [
        i for i, r in enumerate(records) if r.topic == topic and (not source or r.source == source)
    ]
    return found[number]


def replaced(records: list[Record], at: int, *new: Record) -> list[Record]:
    """The records with one of them replaced by others, or by none."""
    return [*records[:at], *new, *records[at + 1 :]]


def one_byte_changed(record: Record) -> tuple[Record, str]:
    """A record with one byte of its payload changed so little that it still can be read.

    Also gives the name of the field that changed: the last array, number or text that has room.
    """
    for at in reversed(range(len(record.data))):
        for bit in (0x01, 0x02, 0x04):
            data = bytearray(record.data)
            data[at] ^= bit
            changed = record._replace(data=bytes(data))
            try:
                field = _changed_field(message(record).body, message(changed).body)
            except ValueError:
                continue
            if field:
                return changed, field
    raise AssertionError(f"no byte of a {record.topic} can be changed")


def _changed_field(before: Any, after: Any) -> str:
    for field in dataclasses.fields(before):
        a, b = getattr(before, field.name), getattr(after, field.name)
        if isinstance(a, np.ndarray):
            if a.shape != b.shape or a.tobytes() != b.tobytes():
                return field.name
        elif a != b:
            return field.name
    return ""
