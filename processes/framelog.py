"""The layout of a vibrissa log: which channels it has and how frames are put in and taken out."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from vibrissa.messages.codec import CODECS, header
from vibrissa.messages.log import LogWriter
from vibrissa.messages.log_format import Channel, Record
from vibrissa.messages.topics import TOPICS
from vibrissa.processes.table import producers


def channels() -> list[Channel]:
    """One channel per recorded topic and process that may say it, in table order."""
    return [
        Channel(topic.name, source, topic.type.__name__, CODECS[topic.name].json_schema())
        for topic in TOPICS.values()
        if topic.recorded
        for source in producers(topic.name)
    ]


class FrameLog:
    """Writes frames to a log; raises LogError when the file can't be made or written."""

    def __init__(self, path: Path | os.PathLike[str], run_id: str, meta: Mapping[str, str]) -> None:
        rows = channels()
        self._writer = LogWriter(path, run_id=run_id, channels=rows, metadata=meta)
        self._index = {(c.topic, c.source): i for i, c in enumerate(rows)}
        self.received: dict[str, int] = {}
        self.sync = self._writer.sync
        self.close = self._writer.close
        self.note = self._writer.add_metadata

    def write(self, frame: bytes) -> int:
        """Append a frame; returns its logical time. Raises DecodeError for what is no frame."""
        topic, source, _, seq, t = header(frame)
        index = self._index.get((topic, source))
        if index is None:
            return t
        self._writer.write(index, seq, max(t, 0), frame[len(topic) + 1 :])
        self.received[topic] = self.received.get(topic, 0) + 1
        return t


def frame_of(record: Record) -> bytes:
    """The frame that was recorded."""
    return record.topic.encode() + b"\0" + record.data
