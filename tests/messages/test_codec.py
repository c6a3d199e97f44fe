"""Frames: what goes in comes out, and nothing else gets in or out."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.messages.strategies import bits, frame, messages, plain, same
from vibrissa.messages.codec import (
    CODECS,
    MAX_FRAME_BYTES,
    Message,
    decode,
    encode,
    header,
    topic_of,
)
from vibrissa.messages.errors import DecodeError, EncodeError
from vibrissa.messages.fields import Array, Int, Real, Text
from vibrissa.messages.types import HeadCommand, HeadSample

every_topic = pytest.mark.parametrize("topic", CODECS)
few = settings(max_examples=25, deadline=None)

FIELDS = [(topic, name) for topic, codec in CODECS.items() for name in codec.fields]
every_field = pytest.mark.parametrize(("topic", "name"), FIELDS)
ARRAYS = [(t, n) for t, n in FIELDS if isinstance(CODECS[t].fields[n], Array)]
every_array = pytest.mark.parametrize(("topic", "name"), ARRAYS)


def refusal(kind: type[Exception], call: Any, *arguments: Any) -> str:
    """The one line of the error that a call raises, which must be of exactly this kind."""
    with pytest.raises(Exception) as caught:
        call(*arguments)
    assert caught.type is kind, f"{caught.type.__name__}: {caught.value}"
    line = str(caught.value)
    assert line.isprintable() and 0 < len(line) < 300
    return line


def with_field(message: Message, name: str, value: Any) -> Message:
    return message._replace(body=dataclasses.replace(message.body, **{name: value}))


def packed(topic: str, values: list[Any]) -> bytes:
    return CODECS[topic].prefix + msgpack.packb(values)


def unpacked(topic: str) -> list[Any]:
    """The msgpack values of the plain message of a topic."""
    values: list[Any] = msgpack.unpackb(frame(plain(topic))[len(CODECS[topic].prefix) :])
    return values


def position(topic: str, name: str) -> int:
    """Where a field that is no part of the shared block stands in the msgpack array."""
    return 5 + CODECS[topic]._others.index(name)


def outcome(call: Any, *arguments: Any) -> Any:
    """What a call gives, or how it refuses; comparable."""
    try:
        result = call(*arguments)
    except (DecodeError, EncodeError) as error:
        return type(error), str(error)
    return [*result[:5], *bits(result.body)] if isinstance(result, Message) else result


@every_topic
@few
@given(st.data())
def test_a_message_comes_out_as_it_went_in(topic: str, data: st.DataObject) -> None:
    message = data.draw(messages(topic))
    raw = encode(message)
    assert same(decode(raw), message)
    assert header(raw) == message[:5]
    assert topic_of(raw) == topic
    assert len(raw) <= MAX_FRAME_BYTES


@every_topic
@few
@given(st.data())
def test_both_encoders_give_the_same_bytes_and_both_decoders_the_same_message(
    topic: str, data: st.DataObject
) -> None:
    codec = CODECS[topic]
    _, *identity, body = data.draw(messages(topic))
    raw = codec.encode(*identity, body)
    assert raw == codec._encode_carefully(*identity, body)
    assert same(codec.decode(raw), codec._decode_carefully(raw))


@every_topic
def test_limits_themselves_are_allowed_and_the_next_number_beyond_is_not(topic: str) -> None:
    codec = CODECS[topic]
    for name, field in codec.fields.items():
        inside: list[Any]
        match field:
            case Int():
                inside = [field.low, field.high]
                outside = [field.low - 1, field.high + 1]
            case Real():
                inside = [-field.limit, field.limit]
                outside = [math.nextafter(x, x * 2) for x in inside]
            case Text():
                inside = ["", "x" * field.longest]
                outside = ["x" * (field.longest + 1)]
            case Array() if field.numpy_dtype.kind == "f":
                shape = tuple(max(n, 1) for n in field.shape)
                ends = [np.full(shape, sign * field.limit, field.dtype) for sign in (-1, 1)]
                inside = list(ends)
                outside = [np.nextafter(x, x * 2, dtype=field.dtype) for x in ends]
            case _:
                continue
        for value in inside:
            message = with_field(plain(topic), name, value)
            assert same(decode(encode(message)), message)
        for value in outside:
            assert name in refusal(EncodeError, encode, with_field(plain(topic), name, value))


@every_array
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_goes_neither_out_nor_in(topic: str, name: str, value: float) -> None:
    field = CODECS[topic].fields[name]
    assert isinstance(field, Array)
    message = plain(topic)
    array = getattr(message.body, name).copy()
    if array.dtype.kind != "f":
        pytest.skip("whole numbers are finite")
    good = array.tobytes()
    array.reshape(-1)[1] = value
    line = refusal(EncodeError, encode, with_field(message, name, array))
    assert name in line and topic in line and "element 1" in line
    raw = frame(message)
    assert raw.count(good) == 1
    line = refusal(DecodeError, decode, raw.replace(good, array.tobytes()))
    assert name in line and topic in line and "element 1" in line


@every_field
@pytest.mark.parametrize(
    "value", [None, "1", b"1", 1, 1.5, True, [1.0], {}, np.float32(1), object()]
)
def test_a_value_of_another_kind_is_refused_by_name(topic: str, name: str, value: Any) -> None:
    field = CODECS[topic].fields[name]
    right = {Int: int, Real: float, Text: str, Array: np.ndarray}[type(field)]
    if type(value) is right:
        pytest.skip("this is the right kind")
    line = refusal(EncodeError, encode, with_field(plain(topic), name, value))
    assert line.startswith(f"{topic}.{name}: ") and type(value).__name__ in line


@every_array
def test_an_array_of_another_dtype_or_shape_is_refused_by_name(topic: str, name: str) -> None:
    array = getattr(plain(topic).body, name)
    other = np.float64 if array.dtype == np.float32 else np.float32
    swapped = array.astype(array.dtype.newbyteorder(">"))
    wrong = [array.astype(other), array[None], array.reshape(-1)[0], array.astype(object)]
    wrong += [swapped] if array.dtype.itemsize > 1 else []
    wrong += [array[1:]] if -1 not in CODECS[topic].fields[name].shape else []
    wrong += [array[:, 1:]] if array.ndim == 2 else []
    for value in wrong:
        line = refusal(EncodeError, encode, with_field(plain(topic), name, value))
        assert line.startswith(f"{topic}.{name}: expected")


@every_array
def test_a_view_is_encoded_like_a_copy_of_it(topic: str, name: str) -> None:
    array = getattr(plain(topic).body, name)
    view = np.repeat(array, 2, axis=0)[::2]
    assert not view.flags.c_contiguous
    assert frame(with_field(plain(topic), name, view)) == frame(plain(topic))


@every_topic
def test_a_body_of_another_type_is_refused(topic: str) -> None:
    codec = CODECS[topic]
    for other in (None, 5, {}, plain("run.event").body, plain("host.timer").body):
        if type(other) is not codec.type:
            line = refusal(EncodeError, codec.encode, "someone", 0, 0, 0, other)
            assert line.startswith(f"{topic}: expected {codec.type.__name__}, found")


@every_topic
@pytest.mark.parametrize(
    "identity",
    [
        ("", 0, 0, 0),
        ("x" * 41, 0, 0, 0),
        ("two lines\nof text", 0, 0, 0),
        ("two words", 0, 0, 0),
        ("m\u00e4use", 0, 0, 0),
        ("\ud800", 0, 0, 0),
        (b"rig", 0, 0, 0),
        (None, 0, 0, 0),
        ("rig", -1, 0, 0),
        ("rig", 2**63, 0, 0),
        ("rig", True, 0, 0),
        ("rig", 0, -1, 0),
        ("rig", 0, 2**32, 0),
        ("rig", 0, 1.0, 0),
        ("rig", 0, 0, 2**63),
        ("rig", 0, 0, -(2**63) - 1),
        ("rig", 0, 0, 0.5),
    ],
)
def test_an_identity_that_could_not_be_read_is_not_written_and_not_read(
    topic: str, identity: tuple[Any, ...]
) -> None:
    codec = CODECS[topic]
    assert topic in refusal(EncodeError, codec.encode, *identity, plain(topic).body)
    values = unpacked(topic)
    values[1:5] = identity
    try:
        raw = packed(topic, values)
    except (OverflowError, UnicodeEncodeError):
        return  # msgpack itself can't say it
    assert topic in refusal(DecodeError, decode, raw)
    assert topic in refusal(DecodeError, header, raw)


@every_topic
def test_another_version_is_refused_with_both_numbers(topic: str) -> None:
    version = CODECS[topic].version
    for other in (version + 1, 0, -1, float(version), True, "1", None, [version]):
        values = unpacked(topic)
        values[0] = other
        line = refusal(DecodeError, decode, packed(topic, values))
        assert f"expected version {version}" in line and repr(other) in line


@every_topic
def test_a_missing_or_an_additional_value_is_refused(topic: str) -> None:
    values = unpacked(topic)
    for wrong in (values[:-1], [*values, 0], values[:5], values[:3], []):
        if len(wrong) != len(values):
            assert topic in refusal(DecodeError, decode, packed(topic, wrong))


@every_field
@pytest.mark.parametrize(
    "value", [None, True, "1", b"1", 2.5, -(2**62), [], {}, msgpack.ExtType(4, b"x")]
)
def test_a_field_of_another_kind_or_range_is_refused_when_read(
    topic: str, name: str, value: Any
) -> None:
    field = CODECS[topic].fields[name]
    values = unpacked(topic)
    if isinstance(field, Text) and value == "1":
        pytest.skip("this is text")
    if isinstance(field, Real) and value == 2.5 and field.limit >= 2.5:
        pytest.skip("this is in range")
    where = -1 if name in CODECS[topic]._block_names else position(topic, name)
    values[where] = value
    block_of_one = isinstance(field, Array) and value == b"1" and field.bytes_per_row == 1
    if block_of_one and not field.fixed:
        pytest.skip("one byte is one row")
    assert topic in refusal(DecodeError, decode, packed(topic, values))


@every_array
def test_a_block_of_another_length_is_refused(topic: str, name: str) -> None:
    field = CODECS[topic].fields[name]
    assert isinstance(field, Array)
    where = -1 if name in CODECS[topic]._block_names else position(topic, name)
    values = unpacked(topic)
    good = values[where]
    for raw in (good[:-1], good + b"\0", b"\0"):
        if field.bytes_per_row == 1 and not field.fixed:
            continue  # every length is a whole number of rows
        values[where] = raw
        line = refusal(DecodeError, decode, packed(topic, values))
        assert topic in line and str(len(raw)) in line


@every_topic
def test_a_frame_cut_at_any_byte_is_refused(topic: str) -> None:
    raw = frame(plain(topic))
    for length in range(len(raw)):
        refusal(DecodeError, decode, raw[:length])
        refusal(DecodeError, header, raw[:length])


@every_topic
def test_a_frame_with_something_behind_it_is_refused(topic: str) -> None:
    raw = frame(plain(topic))
    for more in (b"\0", b"\xc0", raw):
        refusal(DecodeError, decode, raw + more)


@every_topic
def test_one_flipped_bit_gives_a_named_refusal_or_a_message_within_its_limits(topic: str) -> None:
    codec = CODECS[topic]
    raw = frame(plain(topic))
    for bit in range(8 * len(raw)):
        damaged = bytearray(raw)
        damaged[bit // 8] ^= 1 << bit % 8
        _accepts_or_refuses(bytes(damaged))
        if damaged.startswith(codec.prefix):
            by_both = outcome(codec.decode, bytes(damaged))
            assert by_both == outcome(codec._decode_carefully, bytes(damaged))


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200))
def test_random_bytes_are_refused(garbage: bytes) -> None:
    refusal(DecodeError, decode, garbage)
    assume(garbage.partition(b"\0")[0] not in {topic.encode() for topic in CODECS})
    refusal(DecodeError, topic_of, garbage + b"\0")


@every_topic
@settings(max_examples=60, deadline=None)
@given(st.data())
def test_random_bytes_behind_a_topic_are_refused_or_a_valid_message(
    topic: str, data: st.DataObject
) -> None:
    codec = CODECS[topic]
    leaves = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats()
    leaves |= st.text(max_size=8) | st.binary(max_size=300)
    trees = st.recursive(leaves, lambda inner: st.lists(inner, max_size=10), max_leaves=12)
    damaged = st.tuples(st.integers(0, len(unpacked(topic)) - 1), trees)

    def replaced(change: tuple[int, Any]) -> bytes:
        values = unpacked(topic)
        values[change[0]] = change[1]
        return bytes(msgpack.packb(values))

    tail = data.draw(st.binary(max_size=100) | trees.map(msgpack.packb) | damaged.map(replaced))
    _accepts_or_refuses(codec.prefix + tail)
    by_both = outcome(codec.decode, codec.prefix + tail)
    assert by_both == outcome(codec._decode_carefully, codec.prefix + tail)


def _accepts_or_refuses(raw: bytes) -> None:
    """Refused by name; or a message that can be sent on, to the same message."""
    try:
        message = decode(raw)
    except DecodeError as error:
        assert str(error).isprintable() and len(str(error)) < 300
        return
    assert same(decode(encode(message)), message)


def test_a_frame_of_no_topic_of_the_table_is_refused_and_named() -> None:
    for raw in (b"head.other\0\x90", b"head.sampl\0\x90", b"head.samples\0\x90", b"\0", b"", b"x"):
        assert "topic of the table" in refusal(DecodeError, decode, raw)
    assert "topic of the table" in refusal(DecodeError, topic_of, b"head.sampleX")


def test_an_oversized_frame_is_refused_before_it_is_looked_into() -> None:
    raw = frame(plain("slam.map")) + bytes(MAX_FRAME_BYTES)
    assert str(MAX_FRAME_BYTES) in refusal(DecodeError, decode, raw)
    assert str(MAX_FRAME_BYTES) in refusal(DecodeError, header, raw)


def test_a_length_that_promises_more_than_there_is_is_refused_without_allocating() -> None:
    for bomb in (b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff"):
        refusal(DecodeError, decode, b"run.event\0" + bomb)
    refusal(DecodeError, decode, b"run.event\0" + b"\x91" * 100_000)


def test_an_array_longer_than_its_field_allows_is_refused_on_both_sides() -> None:
    field = CODECS["slam.map"].fields["poses"]
    assert isinstance(field, Array)
    rows = field.longest // 3 + 1
    message = with_field(plain("slam.map"), "poses", np.zeros((rows, 3)))
    assert "at most" in refusal(EncodeError, encode, message)
    values = unpacked("slam.map")
    values[position("slam.map", "poses")] = bytes(24 * rows)
    assert "at most" in refusal(DecodeError, decode, packed("slam.map", values))


def test_text_that_has_no_utf8_form_is_refused() -> None:
    line = refusal(EncodeError, encode, with_field(plain("run.event"), "cause", "\udcff"))
    assert line.startswith("run.event.cause: ")


def test_a_decoded_message_can_not_be_changed_and_an_encoded_one_does_not_change() -> None:
    command = np.zeros(18, np.float32)
    raw = CODECS["head.command"].encode("sampler", 0, 0, 0, HeadCommand(0, "rcp", command))
    command[:] = 1
    read = decode(raw).body.command
    assert not read.any()
    with pytest.raises(ValueError, match="read-only"):
        read[0] = 1


def test_arrays_travel_as_little_endian_float32_in_the_order_of_the_type() -> None:
    message = plain("head.sample")
    body: HeadSample = message.body
    block = b"".join(a.astype("<f4").tobytes() for a in (body.theta, body.x, body.y, body.command))
    assert frame(message).endswith(block) and len(block) == 4 * 4 * 18


@every_topic
def test_the_schema_of_a_channel_is_json_that_describes_the_array_that_travels(topic: str) -> None:
    schema = json.loads(CODECS[topic].json_schema())
    values = unpacked(topic)
    kinds = {int: "integer", float: "number", str: "string", bytes: "string"}
    assert schema["type"] == "array" and schema["items"] is False
    assert len(schema["prefixItems"]) == len(values)
    assert schema["prefixItems"][0] == {"title": "version", "const": values[0]}
    for item, value in zip(schema["prefixItems"][1:], values[1:], strict=True):
        assert item["type"] == kinds[type(value)]
        assert (item.get("contentEncoding") == "binary") == (type(value) is bytes)
        if type(value) is int and "minimum" in item:
            assert item["minimum"] <= value <= item["maximum"]
    titles = [item["title"] for item in schema["prefixItems"]]
    told = [*titles, schema["prefixItems"][-1].get("description", "")]
    for name in CODECS[topic].fields:
        assert any(name in text for text in told)
