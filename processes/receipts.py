"""Receipts: the record of which messages a node consumed, in which order, and what came of them."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from vibrissa.messages.codec import CODECS, Message
from vibrissa.messages.types import Receipt
from vibrissa.processes.node import Step

Stream = tuple[str, str, int]
"""(topic, source, epoch): messages of a stream are numbered without gaps."""


class ReceiptBook:
    """Collects a node's steps and turns them into receipt frames."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._streams: list[Stream] = []
        self._index: dict[Stream, int] = {}
        self._columns = (array("B"), array("I"), array("I"))
        self._first = 0
        self._seq = 0

    def __len__(self) -> int:
        return len(self._columns[0])

    def add(self, step: Step) -> None:
        index = self._index.get(step.stream)
        if index is None:
            index = self._index[step.stream] = len(self._streams)
            self._streams.append(step.stream)
        streams, seqs, digests = self._columns
        streams.append(index)
        seqs.append(step.seq)
        digests.append(step.digest)

    def frame(self, t: int) -> bytes:
        """The receipts since the last call as one frame stamped `t`."""
        streams, seqs, digests = self._columns
        body = Receipt(
            first_step=self._first,
            streams="\n".join(
                f"{topic} {source} {epoch}" for topic, source, epoch in self._streams
            ),
            stream=np.frombuffer(streams, np.uint8),
            seq=np.frombuffer(seqs, np.uint32),
            digest=np.frombuffer(digests, np.uint32),
        )
        frame = CODECS["node.receipt"].encode(self._name, 0, self._seq, t, body)
        self._first += len(streams)
        self._seq += 1
        self._columns = (array("B"), array("I"), array("I"))
        return frame


class Entry(NamedTuple):
    """One line of a receipt: the node's step number, what it consumed, its digest afterwards."""

    step: int
    stream: Stream
    seq: int
    digest: int


def entries(message: Message) -> Iterator[Entry]:
    """The lines of a receipt message, in order. Raises ValueError when it contradicts itself."""
    receipt: Receipt = message.body
    streams: list[Stream] = []
    for line in receipt.streams.splitlines():
        topic, source, epoch = line.split(" ")
        streams.append((topic, source, int(epoch)))
    if not receipt.stream.size == receipt.seq.size == receipt.digest.size:
        raise ValueError(
            f"receipt of {message.source} at step {receipt.first_step}: uneven columns"
        )
    rows = zip(receipt.stream.tolist(), receipt.seq.tolist(), receipt.digest.tolist(), strict=True)
    for offset, (index, seq, digest) in enumerate(rows):
        if index >= len(streams):
            raise ValueError(
                f"receipt of {message.source} at step {receipt.first_step + offset}: "
                f"stream {index} of {len(streams)}"
            )
        yield Entry(receipt.first_step + offset, streams[index], seq, digest)
