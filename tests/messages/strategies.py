"""Messages of every type, drawn from the limits that the types themselves state."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vibrissa.messages.codec import CODECS, Message
from vibrissa.messages.fields import Array, Field, Int, Real, Text

ROWS = 6
LONG = st.integers(0, 2**63 - 1)
SOURCES = st.text("abcdefghijklmnopqrstuvwxyz_-0123456789", min_size=1, max_size=40)


def values(field: Field) -> st.SearchStrategy[Any]:
    """What a field may hold, its limits included."""
    match field:
        case Int():
            return st.integers(field.low, field.high)
        case Real():
            return st.floats(-field.limit, field.limit)
        case Text():
            return st.text(max_size=min(field.longest, 60))
        case Array():
            return arrays(field)


def arrays(field: Array) -> st.SearchStrategy[Any]:
    rows = [st.integers(0, ROWS) if n == -1 else st.just(n) for n in field.shape]
    shape = st.tuples(*rows)
    dtype = field.numpy_dtype
    if dtype.kind != "f":
        return hnp.arrays(dtype, shape)
    width = 8 * dtype.itemsize
    limit = float(np.array(field.limit, dtype))  # the limit as a number of this width
    return hnp.arrays(dtype, shape, elements=st.floats(-limit, limit, width=width))


@st.composite
def messages(draw: st.DrawFn, topic: str) -> Message:
    """An identified message of a topic."""
    codec = CODECS[topic]
    body = codec.type(**{name: draw(values(field)) for name, field in codec.fields.items()})
    epoch, t = draw(LONG), draw(LONG)
    seq = draw(st.integers(0, 2**32 - 1))
    return Message(topic, draw(SOURCES), epoch, seq, t, body)


def frame(message: Message) -> bytes:
    topic, *identity, body = message
    return CODECS[topic].encode(*identity, body)


def same(a: Message, b: Message) -> bool:
    """Equal to the bit: kinds, shapes, signs of zero."""
    return a[:5] == b[:5] and bits(a.body) == bits(b.body)


def bits(body: Any) -> list[Any]:
    return [type(body), *(_bits(getattr(body, name)) for name in type(body).__slots__)]


def _bits(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return type(value), repr(value)


def plain(topic: str) -> Message:
    """One fixed message of a topic; every field and every element has a value of its own."""
    body = {}
    for index, (name, field) in enumerate(CODECS[topic].fields.items()):
        match field:
            case Int():
                body[name] = max(field.low, min(field.high, 3 + index))
            case Real():
                body[name] = field.limit * (index + 1) / 64
            case Text():
                body[name] = f"text {index}"
            case Array():
                body[name] = _plain_array(field, index)
    return Message(topic, "someone", 2, 70_000, 5_000_000_000, CODECS[topic].type(**body))


def _plain_array(field: Array, index: int) -> Any:
    shape = tuple(3 if n == -1 else n for n in field.shape)
    count = int(np.prod(shape))
    if field.numpy_dtype.kind != "f":
        return (np.arange(count) + 16 * index).astype(field.dtype).reshape(shape)
    steps = (np.arange(count) + 1 + 32 * index) / 1024
    return (
        (field.limit * steps * np.where(np.arange(count) % 2, -1, 1))
        .astype(field.dtype)
        .reshape(shape)
    )
