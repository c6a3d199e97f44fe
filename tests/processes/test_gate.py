"""A process hears whole frames of the table only, each stream in its order, and no flood."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.messages.codec import CODECS, header, stream_of
from vibrissa.messages.errors import DecodeError
from vibrissa.messages.topics import TOPICS
from vibrissa.messages.types import WhiskCommand
from vibrissa.processes.gate import BURST, Gate


def command(source: str, seq: int, epoch: int = 0) -> bytes:
    return CODECS["whisk.command"].encode(
        source, epoch, seq, 0, WhiskCommand(seq, np.zeros(18, np.float32))
    )


def test_a_stream_is_heard_from_any_number_on_without_repeats_or_gaps() -> None:
    gate = Gate()
    heard = [seq for seq in (7, 8, 8, 6, 9, 11, 10, 11) if gate.admits(command("whisk", seq))]
    assert heard == [7, 8, 9, 10, 11]
    assert gate.take_refused() == {"whisk": (3, "expected #10 of whisk.command whisk, found #11")}
    assert gate.take_refused() == {}


def test_somebody_elses_name_does_not_disturb_its_owner() -> None:
    gate = Gate()
    assert all(gate.admits(command("whisk", seq)) for seq in range(500))
    assert not gate.admits(command("whisk", 0))
    assert not gate.admits(command("whisk", 4_000_000))
    assert gate.admits(command("whisk", 500))


def test_what_runs_in_this_process_is_not_heard_from_the_bus() -> None:
    gate = Gate(own=["sampler", "whisk"])
    assert not gate.admits(command("whisk", 0))
    assert gate.admits(command("whisk.1", 0))
    assert gate.take_refused() == {
        "whisk": (1, "expected no whisk.command whisk from the bus, found #0")
    }


def test_streams_are_told_apart_by_topic_source_and_epoch() -> None:
    gate = Gate()
    assert gate.admits(command("whisk", 3))
    assert gate.admits(command("whisk.1", 0))
    assert gate.admits(command("whisk", 100, epoch=1))
    assert gate.admits(command("whisk", 4))


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (b"", "expected a topic"),
        (b"whisk.command\0", "expected a msgpack array"),
        (b"whisk.command\0\xff\xff", "whisk.command"),
        (b"nonsense", "expected a topic"),
        (command("stranger", 0), "whisk.command from stranger: expected one of whisk, whisk.1"),
    ],
)
def test_what_is_no_frame_of_the_table_is_refused(frame: bytes, words: str) -> None:
    gate = Gate()
    assert not gate.admits(frame)
    ((count, cause),) = gate.refused.values()
    assert count == 1 and words in cause


@given(st.binary(max_size=60))
def test_no_bytes_end_a_process(raw: bytes) -> None:
    gate = Gate()
    gate.admits(raw)
    gate.admits(b"whisk.command\0" + raw)


def test_a_flood_of_a_slot_is_cut_off_and_ends_when_it_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0]
    monkeypatch.setattr("time.monotonic_ns", lambda: now[0])
    gate = Gate()
    heard = sum(gate.admits(command("whisk.7", seq)) for seq in range(20_000))
    assert BURST <= heard <= BURST + 2
    assert gate.take_refused()["whisk.7"][0] == 20_000 - heard
    now[0] = 1_000_000_000
    assert gate.admits(command("whisk.7", 20_000))


def test_who_is_not_limited_is_heard_in_full() -> None:
    gate = Gate(limited=False)
    assert all(gate.admits(command("whisk.7", seq)) for seq in range(5000))


@pytest.mark.parametrize("topic", TOPICS)
@given(
    st.text("abcdefghijklmnopqrstuvwxyz.0123456789", min_size=1, max_size=40),
    st.integers(0, 2**40),
    st.integers(0, 2**32 - 1),
)
def test_a_stream_is_what_its_header_says(topic: str, source: str, epoch: int, seq: int) -> None:
    from tests.messages.strategies import plain

    body = plain(topic).body
    frame = CODECS[topic].encode(source, epoch, seq, 5, body)
    stream, found = stream_of(frame)
    again, _ = stream_of(CODECS[topic].encode(source, epoch, (seq + 1) % 2**32, 6, body))
    other, _ = stream_of(CODECS[topic].encode(source, (epoch + 1) % 2**40, seq, 5, body))
    assert found == seq == header(frame)[3]
    assert stream == again
    assert stream != other


def test_a_header_that_can_not_be_read_is_named() -> None:
    with pytest.raises(DecodeError):
        stream_of(b"head.sample\0\x01")
