"""The topic table is whole: everything that is said or heard is in it, and it says enough."""

from __future__ import annotations

import dataclasses
import re
from typing import get_type_hints

import pytest

from vibrissa.messages import types
from vibrissa.messages.codec import CODECS
from vibrissa.messages.fields import Array, Int, Real, Text
from vibrissa.messages.topics import TOPICS

every_topic = pytest.mark.parametrize("topic", TOPICS)
TYPES = {row.type for row in TOPICS.values()}


def test_topics_are_two_words_and_none_is_listed_twice() -> None:
    assert all(re.fullmatch(r"[a-z]+\.[a-z]+", name) for name in TOPICS)
    assert [row.name for row in TOPICS.values()] == list(TOPICS)
    assert len({codec.prefix for codec in CODECS.values()}) == len(TOPICS)


def test_every_topic_has_a_codec_of_its_type() -> None:
    assert {name: codec.type for name, codec in CODECS.items()} == {
        name: row.type for name, row in TOPICS.items()
    }


def test_every_message_type_travels_on_some_topic() -> None:
    defined = {
        t for t in vars(types).values() if isinstance(t, type) and dataclasses.is_dataclass(t)
    }
    assert {t for t in defined if t.__module__ == types.__name__} == TYPES


@every_topic
def test_what_is_compared_is_recorded(topic: str) -> None:
    row = TOPICS[topic]
    assert row.recorded or not row.compared
    assert row.rate >= 0
    assert row.producer


def test_wall_clock_measurements_are_recorded_and_never_compared() -> None:
    row = TOPICS["node.telemetry"]
    assert row.recorded and not row.compared


@pytest.mark.parametrize("kind", sorted(TYPES, key=lambda t: t.__name__), ids=lambda t: t.__name__)
def test_a_type_states_a_version_what_it_is_and_the_limits_of_every_field(kind: type) -> None:
    assert isinstance(kind.version, int) and kind.version >= 1  # type: ignore[attr-defined]
    assert kind.__doc__ and not kind.__doc__.startswith(f"{kind.__name__}(")
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        (limits,) = hints[field.name].__metadata__
        match limits:
            case Array():
                assert limits.dtype[0] in "<|" and limits.shape.count(-1) <= 1
                assert limits.numpy_dtype.kind != "f" or (limits.unit and limits.limit < 1e13)
            case Int():
                assert limits.low < limits.high
            case Real():
                assert limits.unit
            case _:
                assert isinstance(limits, Text) and limits.longest > 0
