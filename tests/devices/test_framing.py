"""Frames on the serial line: what one end writes the other reads, whatever happens between."""

from __future__ import annotations

import random
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from tests.devices import reference
from vibrissa.rig.devices.framing import LONGEST, FrameParser, frame
from vibrissa.rig.devices.protocol import (
    CHANNELS,
    Command,
    Foreign,
    Hello,
    HelloPlease,
    RawSample,
    Start,
    Stop,
    pack_from_head,
    pack_from_host,
    unpack_from_head,
    unpack_from_host,
)

u32 = st.integers(0, 2**32 - 1)
samples = st.builds(
    RawSample, u32, u32, u32, st.integers(0, 255), st.binary(min_size=108, max_size=108)
)
commands = st.builds(Command, u32, st.binary(min_size=36, max_size=36))
orders = st.one_of(
    commands, st.builds(HelloPlease, u32), st.builds(Start, st.integers(1, 255)), st.just(Stop())
)


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = sorted({0, len(data), *(c % (len(data) + 1) for c in cuts)})
    return [data[a:b] for a, b in pairwise(edges)]


@given(st.lists(st.binary(min_size=1, max_size=300), max_size=8), st.lists(st.integers(0, 5000)))
def test_messages_survive_any_cutting_of_the_stream(messages: list[bytes], cuts: list[int]) -> None:
    parser, found = FrameParser(), []
    for piece in pieces(b"".join(map(frame, messages)), cuts):
        found += parser.feed(piece)
    assert found == messages
    assert parser.frames == len(messages)
    assert parser.crc_errors == parser.resyncs == 0


@given(st.binary(min_size=1, max_size=400))
def test_frames_are_what_the_documentation_says(message: bytes) -> None:
    data = frame(message)
    assert data[0] == data[-1] == 0 and 0 not in data[1:-1]
    assert reference.unframe(data[1:-1]) == message
    assert reference.crc16(b"123456789") == 0x29B1  # the published check value


@given(samples)
def test_samples_are_laid_out_as_documented(sample: RawSample) -> None:
    message = pack_from_head(sample)
    assert reference.sample(message) == sample
    assert unpack_from_head(message) == sample
    assert len(frame(message)) == 128


@given(commands)
def test_commands_are_laid_out_as_documented(command: Command) -> None:
    message = pack_from_host(command)
    assert reference.command(message) == command
    assert unpack_from_host(message) == command


def test_hellos_are_laid_out_as_documented() -> None:
    hello = Hello(7, 9, (1, 2, 3), "VIB-1")
    found = reference.hello(pack_from_head(hello))
    assert found["nonce"] == 7 and found["boot"] == 9 and found["firmware"] == (1, 2, 3)
    assert found["serial"] == "VIB-1" and found["rate"] == 2000 and found["watchdog_ms"] == 20
    assert len(found["channels"]) == CHANNELS
    back = unpack_from_head(pack_from_head(hello))
    assert isinstance(back, Hello) and back.serial == "VIB-1"
    back.check()


@given(orders)
def test_orders_come_back(order: Command | HelloPlease | Start | Stop) -> None:
    assert unpack_from_host(pack_from_host(order)) == order


@given(samples, st.integers(2, 255))
def test_another_version_is_recognised(sample: RawSample, version: int) -> None:
    assert unpack_from_head(pack_from_head(sample, version)) == Foreign(version)


@given(st.binary(max_size=3000), st.binary(min_size=1, max_size=300))
def test_after_any_garbage_the_next_frame_is_found(garbage: bytes, message: bytes) -> None:
    parser = FrameParser()
    parser.feed(garbage)
    assert parser.feed(frame(message))[-1:] == [message]


@given(st.lists(st.binary(max_size=2000), max_size=30))
def test_the_parser_never_keeps_more_than_one_frame(chunks: list[bytes]) -> None:
    parser = FrameParser()
    for chunk in chunks:
        parser.feed(chunk)
        assert len(parser._rest) <= LONGEST


def test_a_run_of_damage_is_one_resync_and_every_frame_of_it_an_error() -> None:
    parser = FrameParser()
    good = frame(b"good message")
    bad = bytearray(good)
    bad[5] ^= 8
    found = parser.feed(good + bytes(bad) * 3 + good + bytes(bad) + good)
    assert found == [b"good message"] * 3
    assert (parser.frames, parser.crc_errors, parser.resyncs) == (3, 4, 2)


def test_single_and_double_bit_errors_are_always_found() -> None:
    message = pack_from_head(RawSample(1, 2, 3, 4, bytes(range(108))))
    data = frame(message)
    rng = random.Random(1)
    bits = range(8, 8 * (len(data) - 1))
    cases = [(b,) for b in bits] + [tuple(rng.sample(bits, 2)) for _ in range(2000)]
    for case in cases:
        hurt = bytearray(data)
        for bit in case:
            hurt[bit >> 3] ^= 1 << (bit & 7)
        assert message not in FrameParser().feed(bytes(hurt))


@given(st.binary(max_size=200))
def test_unpacking_anything_raises_nothing(message: bytes) -> None:
    unpack_from_head(message)
    unpack_from_host(message)
