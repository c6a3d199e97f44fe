"""Frames: how a message is laid out in bytes.

    frame = topic name, one zero byte, msgpack array [version, source, epoch, seq, t, fields ...]

The topic comes first so that subscriptions filter on it. Scalars are msgpack values; all float32
arrays of fixed length share one raw little-endian block, every other array is a block of its own
with its row count implied by its length. Fields follow the order of the type. Encoding and decoding
check kind, length, version and range and name what is wrong in one line.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from typing import Any, Final, NamedTuple, get_type_hints

import msgpack
import numpy as np

from vibrissa.messages import fastpath
from vibrissa.messages.errors import DecodeError, EncodeError
from vibrissa.messages.fields import Array, Field, Int
from vibrissa.messages.topics import TOPICS, Topic

MAX_FRAME_BYTES: Final = 16 << 20
_HEADER: Final = 5  # version, source, epoch, seq, t
_NUMBERS: Final = {
    "epoch": Int(0, 2**63 - 1),
    "seq": Int(0, 2**32 - 1),
    "t": Int(-(2**63), 2**63 - 1),
}


class Message(NamedTuple):
    """An identified message: (topic, source, epoch, seq) is unique in a run; t in ns is logical."""

    topic: str
    source: str
    epoch: int
    seq: int
    t: int
    body: Any


Encode = Callable[[str, int, int, int, Any], bytes]
"""(source, epoch, seq, t, body) -> frame"""
Decode = Callable[[bytes], Message]


class Codec:
    """Packs and unpacks the bodies of one message type."""

    def __init__(self, topic: Topic) -> None:
        self.topic = topic.name
        self.type: Any = topic.type
        self.version: int = self.type.version
        self.prefix = topic.name.encode() + b"\0"
        hints = get_type_hints(self.type, include_extras=True)
        self.fields: dict[str, Field] = {
            f.name: hints[f.name].__metadata__[0] for f in dataclasses.fields(self.type)
        }
        block = [n for n, f in self.fields.items() if isinstance(f, Array) and _shared(f)]
        self._block_names = block
        self._block_slices: list[tuple[str, int, int]] = []
        offset = 0
        for name in block:
            size = self._array(name).shape[0]
            self._block_slices.append((name, offset, offset + size))
            offset += size
        self._block_floats = offset
        self._others = [n for n in self.fields if n not in block]
        self._length = _HEADER + len(self._others) + bool(block)
        order = (self._others, self._block_names)
        self.encode: Encode = fastpath.encoder(
            self.prefix, self.version, self.type, self.fields, order, self._encode_carefully
        )
        """Frame a body. Raises EncodeError when a field breaks its declaration."""
        self.decode: Decode = fastpath.decoder(
            self.prefix,
            self.topic,
            self.version,
            self.type,
            Message,
            self.fields,
            order,
            self._decode_carefully,
        )
        """Unframe a message. Raises DecodeError naming topic, field, expectation and finding."""

    def _encode_carefully(self, source: str, epoch: int, seq: int, t: int, body: Any) -> bytes:
        if type(body) is not self.type:
            raise EncodeError(
                f"{self.topic}: expected {self.type.__name__}, found {type(body).__name__}"
            )
        fault = _identity_fault(source, epoch, seq, t)
        if fault:
            raise EncodeError(f"{self.topic}: {fault}")
        values: list[Any] = [self.version, source, epoch, seq, t]
        for name in self._others:
            field = self.fields[name]
            value = getattr(body, name)
            fault = field.fault(value)
            if fault:
                raise EncodeError(f"{self.topic}.{name}: {fault}")
            values.append(value.tobytes() if isinstance(field, Array) else value)
        if self._block_names:
            values.append(self._join(body))
        packed: bytes = msgpack.packb(values)
        return self.prefix + packed

    def _decode_carefully(self, frame: bytes) -> Message:
        values = self._unpack(frame)
        _, source, epoch, seq, t = values[:_HEADER]
        found: dict[str, Any] = {}
        for name, value in zip(self._others, values[_HEADER:], strict=False):
            field = self.fields[name]
            if isinstance(field, Array):
                value = self._array_from(name, field, value)  # noqa: PLW2901
            else:
                fault = field.fault(value)
                if fault:
                    raise DecodeError(f"{self.topic}.{name} from {source} #{seq}: {fault}")
            found[name] = value
        if self._block_names:
            self._split(values[-1], found, source, seq)
        return Message(self.topic, source, epoch, seq, t, self.type(**found))

    def json_schema(self) -> str:
        """A JSON Schema of the msgpack array, attached to every channel of a log."""
        items: list[dict[str, Any]] = [
            {"title": "version", "const": self.version},
            {"title": "source", "type": "string"},
            {"title": "epoch", "type": "integer"},
            {"title": "seq", "type": "integer"},
            {"title": "t", "type": "integer", "description": "logical time, ns"},
        ]
        items += [{"title": n, **self.fields[n].json_schema()} for n in self._others]
        if self._block_names:
            parts = ", ".join(
                f"{n}[{b - a}] {self._array(n).unit}" for n, a, b in self._block_slices
            )
            items.append(
                {
                    "title": "block",
                    "type": "string",
                    "contentEncoding": "binary",
                    "description": f"raw little-endian float32: {parts}",
                }
            )
        title = f"{self.type.__name__} v{self.version}"
        schema = {"title": title, "type": "array", "prefixItems": items, "items": False}
        return json.dumps(schema, sort_keys=True)

    def _array(self, name: str) -> Array:
        field = self.fields[name]
        assert isinstance(field, Array)
        return field

    def _join(self, body: Any) -> bytes:
        for name in self._block_names:
            fault = self._array(name).fault(getattr(body, name))
            if fault:
                raise EncodeError(f"{self.topic}.{name}: {fault}")
        return np.concatenate([getattr(body, n) for n in self._block_names]).tobytes()

    def _split(self, raw: Any, found: dict[str, Any], source: str, seq: int) -> None:
        where = f"{self.topic} from {source} #{seq}"
        if type(raw) is not bytes or len(raw) != 4 * self._block_floats:
            size = f"{len(raw)} bytes" if type(raw) is bytes else type(raw).__name__
            raise DecodeError(f"{where}: expected {4 * self._block_floats} bytes, found {size}")
        block = np.frombuffer(raw, "<f4")
        for name, start, stop in self._block_slices:
            found[name] = block[start:stop]
            fault = self._array(name).range_fault(found[name])
            if fault:
                raise DecodeError(f"{self.topic}.{name} from {source} #{seq}: {fault}")

    def _array_from(self, name: str, field: Array, raw: Any) -> Any:
        where = f"{self.topic}.{name}"
        if type(raw) is not bytes:
            raise DecodeError(f"{where}: expected a block of bytes, found {type(raw).__name__}")
        if len(raw) > field.longest * field.numpy_dtype.itemsize:
            raise DecodeError(
                f"{where}: expected at most {field.longest} numbers, found {len(raw)} bytes"
            )
        if len(raw) % field.bytes_per_row or (field.fixed and len(raw) != field.bytes_per_row):
            of = "" if field.fixed else "a multiple of "
            raise DecodeError(
                f"{where}: expected {of}{field.bytes_per_row} bytes, found {len(raw)}"
            )
        value = np.frombuffer(raw, field.numpy_dtype).reshape(field.shape)
        fault = field.range_fault(value)
        if fault:
            raise DecodeError(f"{where}: {fault}")
        return value

    def _unpack(self, frame: bytes) -> list[Any]:
        try:
            values = msgpack.unpackb(frame[len(self.prefix) :], use_list=True)
        except Exception as error:
            raise DecodeError(
                f"{self.topic}: expected a msgpack array, found {len(frame)} bytes that are not "
                f"({type(error).__name__})"
            ) from None
        if type(values) is not list or len(values) < _HEADER:
            raise DecodeError(f"{self.topic}: expected an array of {self._length} values")
        version = values[0]
        if type(version) is not int or version != self.version:
            raise DecodeError(
                f"{self.topic}: expected version {self.version}, found {_short(version)}"
            )
        if len(values) != self._length:
            raise DecodeError(f"{self.topic}: expected {self._length} values, found {len(values)}")
        _, source, epoch, seq, t = values[:_HEADER]
        fault = _identity_fault(source, epoch, seq, t)
        if fault:
            raise DecodeError(f"{self.topic}: {fault}")
        return values


def _shared(field: Array) -> bool:
    return field.dtype == "<f4" and field.fixed and len(field.shape) == 1


def _identity_fault(source: Any, epoch: Any, seq: Any, t: Any) -> str | None:
    """What is wrong with an identity; sources are ASCII words, as receipts list them in a line."""
    named = type(source) is str and 0 < len(source) <= 40 and source.isascii()
    if not named or not source.isprintable() or " " in source:
        return f"expected a source name, found {_short(source)}"
    for (name, field), value in zip(_NUMBERS.items(), (epoch, seq, t), strict=True):
        fault = field.fault(value)
        if fault:
            return f"{name} of {source}: {fault}"
    return None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


CODECS: Final[dict[str, Codec]] = {name: Codec(topic) for name, topic in TOPICS.items()}
_BY_PREFIX: Final[dict[bytes, Codec]] = {c.prefix: c for c in CODECS.values()}


def topic_of(frame: bytes) -> str:
    """The topic a frame belongs to. Raises DecodeError when it names none of the table."""
    if len(frame) > MAX_FRAME_BYTES:
        raise DecodeError(f"frame: expected at most {MAX_FRAME_BYTES} bytes, found {len(frame)}")
    codec = _BY_PREFIX.get(frame[: frame.find(b"\0") + 1])
    if codec is None:
        raise DecodeError(f"frame: expected a topic of the table, found {frame[:24]!r}")
    return codec.topic


def decode(frame: bytes) -> Message:
    """Unframe a message of any topic. Raises DecodeError."""
    decoder = _DECODERS.get(frame[: frame.find(b"\0") + 1])
    if decoder is None or len(frame) > MAX_FRAME_BYTES:
        decoder = CODECS[topic_of(frame)].decode
    return decoder(frame)


def encode(message: Message) -> bytes:
    """Frame a message. Raises EncodeError."""
    topic, source, epoch, seq, t, body = message
    return CODECS[topic].encode(source, epoch, seq, t, body)


def header(frame: bytes) -> tuple[str, str, int, int, int]:
    """(topic, source, epoch, seq, t) of a frame, its fields unchecked. Raises DecodeError."""
    codec = CODECS[topic_of(frame)]
    _, source, epoch, seq, t, *_ = codec._unpack(frame)
    return codec.topic, source, epoch, seq, t


def stream_of(frame: bytes) -> tuple[bytes, int]:
    """(what all frames of a stream begin with, seq), without a look at anything else.

    Two streams never begin alike. Raises DecodeError when not even the header can be read.
    """
    start = frame.find(b"\0") + 1  # array, version, fixstr and its characters, epoch, seq
    if len(frame) > start + 3:
        end = start + 4 + (frame[start + 2] & 0x1F)
        if len(frame) > end + 5 and frame[start + 2] & 0xE0 == 0xA0 and frame[end - 1] < 0x80:
            first = frame[end]
            if first < 0x80:
                return frame[:end], first
            if 0xCC <= first <= 0xCE:
                return frame[:end], int.from_bytes(frame[end + 1 : end + 1 + (1 << first - 0xCC)])
    topic, source, epoch, seq, _ = header(frame)
    return f"{topic}\0   {source}#{epoch}\0".encode(), seq


def epoch_of(frame: bytes, topic: str, source: str) -> int:
    """The epoch of a frame whose topic and source are known. Raises DecodeError.

    Reads the one byte that holds a small epoch behind a short source; else the whole header.
    """
    start = len(topic) + 1  # fixarray, version, fixstr and its characters, epoch
    at = start + 3 + len(source)
    if len(frame) > at and frame[start] & 0xF0 == 0x90 and len(source) < 32 and frame[at] < 0x80:
        return frame[at]
    return header(frame)[2]


_DECODERS: Final[dict[bytes, Decode]] = {c.prefix: c.decode for c in CODECS.values()}
