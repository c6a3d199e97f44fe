"""What a log holds, and what is left of one that was cut off or damaged."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from vibrissa.messages.log import LogDamagedError, LogReader, LogWriter, Record


@dataclass
class ChannelSummary:
    """One channel of a log: first and last `seq` and `t` (ns); None while `count` is 0.

    `gaps` is the number of places where seq jumps forward and `missing` the seqs left out there;
    `restarts` counts the places where it does not grow.
    """

    topic: str
    source: str
    count: int = 0
    first_seq: int | None = None
    last_seq: int | None = None
    first_t: int | None = None
    last_t: int | None = None
    gaps: int = 0
    missing: int = 0
    restarts: int = 0

    def add(self, record: Record) -> None:
        if self.last_seq is None:
            self.first_seq, self.first_t = record.seq, record.t
        elif record.seq <= self.last_seq:
            self.restarts += 1
        elif record.seq > self.last_seq + 1:
            self.gaps += 1
            self.missing += record.seq - self.last_seq - 1
        self.last_seq, self.last_t = record.seq, record.t
        self.count += 1


@dataclass(frozen=True)
class LogSummary:
    """What a log holds. `duration` is from the earliest to the latest message, ns."""

    run_id: str
    metadata: dict[str, str]
    extra: dict[str, dict[str, str]]
    end: dict[str, str] | None
    channels: tuple[ChannelSummary, ...]
    records: int
    duration: int
    size: int
    complete: bool
    cut_at: int | None
    damage: tuple[str, ...]


def summarise(path: str | os.PathLike[str]) -> LogSummary:
    """Read the whole log and count; damage and a missing end are reported, not raised.

    Raises NotALogError for a foreign file and LogError if not even its run can be read.
    """
    reader = LogReader(path, allow_cut=True)
    damage: list[LogDamagedError] = []
    channels = {(c.topic, c.source): ChannelSummary(c.topic, c.source) for c in reader.channels}
    first, last = None, 0
    for record in reader.records(damage.append):
        channels[record.topic, record.source].add(record)
        first = record.t if first is None else min(first, record.t)
        last = max(last, record.t)
    return LogSummary(
        run_id=reader.run_id,
        metadata=reader.metadata,
        extra=reader.extra,
        end=reader.end,
        channels=tuple(channels.values()),
        records=sum(channel.count for channel in channels.values()),
        duration=0 if first is None else last - first,
        size=reader.size,
        complete=bool(reader.complete) and not damage,
        cut_at=reader.cut_at,
        damage=tuple(str(error) for error in damage),
    )


@dataclass(frozen=True)
class Recovery:
    """What `recover` saved: `kept` records of `readable`; the rest was beyond the usable prefix."""

    kept: int
    readable: int
    cut_at: int | None
    lost_bytes: int
    damage: tuple[str, ...]

    @property
    def lossless(self) -> bool:
        return self.kept == self.readable and self.cut_at is None and not self.damage


def recover(
    src: str | os.PathLike[str],
    dst: str | os.PathLike[str],
    complete_prefix: Callable[[Iterable[Record]], int] | None = None,
) -> Recovery:
    """Copy every readable record of `src` into a new, closed log `dst`, and say what was lost.

    `complete_prefix` gets the readable records and returns how many from the start are usable;
    without it all are kept. The run's metadata stays, a metadata record `recovered` tells the loss.
    `lost_bytes` counts the incomplete end of the file.

    Raises LogExistsError if `dst` exists, LogWriteError (leaving no `dst`) if it can't be written,
    LogError if not even the run of `src` can be read.
    """
    reader = LogReader(src, allow_cut=True)
    damage: list[LogDamagedError] = []
    usable = None
    if complete_prefix is not None:
        usable = complete_prefix(reader.records(lambda _: None))
    index = {(c.topic, c.source): i for i, c in enumerate(reader.channels)}
    writer = LogWriter(
        dst, run_id=reader.run_id, channels=reader.channels, metadata=reader.metadata
    )
    try:
        records = reader.records(damage.append)
        kept = 0
        for record in islice(records, usable):
            writer.write(index[record.topic, record.source], record.seq, record.t, record.data)
            kept += 1
        readable = kept + sum(1 for _ in records)
        found = Recovery(
            kept=kept,
            readable=readable,
            cut_at=reader.cut_at,
            lost_bytes=0 if reader.cut_at is None else reader.size - reader.cut_at,
            damage=tuple(str(error) for error in damage),
        )
        for name, data in reader.extra.items():
            if name != "recovered":
                writer.add_metadata(name, data)
        writer.add_metadata("recovered", _told(reader, found))
        writer.close((reader.end or {}).get("cause", "recovered"))
    except BaseException:
        writer.close("failed")
        Path(dst).unlink()
        raise
    return found


def _told(reader: LogReader, found: Recovery) -> dict[str, str]:
    return {
        "from": reader.path.name,
        "kept": str(found.kept),
        "readable": str(found.readable),
        "cut_at": "" if found.cut_at is None else str(found.cut_at),
        "lost_bytes": str(found.lost_bytes),
        "damage": "\n".join(found.damage),
    }
