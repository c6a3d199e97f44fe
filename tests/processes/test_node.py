"""Steppers, groups and receipts: one order, one digest, whoever hosts the nodes."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.messages.strategies import frame, plain
from vibrissa.messages.codec import CODECS, Message, decode
from vibrissa.messages.errors import DecodeError, EncodeError
from vibrissa.messages.types import Event, Metrics
from vibrissa.processes.group import Group
from vibrissa.processes.lockstep import LocalRunner
from vibrissa.processes.node import Step, Stepper, timer_frame
from vibrissa.processes.receipts import ReceiptBook, entries
from vibrissa.processes.stats import Histogram


class Echo:
    """Says on one topic what it hears on another, with its own name in front."""

    def __init__(self, name: str, answers: dict[str, list[str]]) -> None:
        self.name = name
        self.answers = answers
        self.heard: list[tuple[str, str, int]] = []

    def step(self, message: Message) -> Iterable[tuple[str, Any]]:
        self.heard.append((message.topic, message.source, message.seq))
        cause = f"{self.name}({message.body.cause})"
        return [
            (t, Event(0, "echo", self.name, cause)) for t in self.answers.get(message.topic, [])
        ]


def event(topic: str, seq: int = 0, cause: str = "x", t: int = 7) -> bytes:
    return CODECS[topic].encode("supervisor", 0, seq, t, Event(0, "kind", "someone", cause))


def test_outputs_are_numbered_per_topic_and_inherit_time() -> None:
    stepper = Stepper("arm", Echo("arm", {"run.event": ["node.event", "host.event", "node.event"]}))
    said = [stepper.step(event("run.event", i, t=1000 + i)).outputs for i in range(3)]
    identities = [decode(f)[:5] for outputs in said for f in outputs]
    assert identities == [
        (topic, "arm", 0, seq, 1000 + i)
        for i in range(3)
        for topic, seq in (("node.event", 2 * i), ("host.event", i), ("node.event", 2 * i + 1))
    ]
    assert stepper.sent == {"node.event": 6, "host.event": 3}


def test_the_digest_covers_every_input_and_output_in_order() -> None:
    stepper = Stepper("arm", Echo("arm", {"run.event": ["node.event"]}))
    expected = 0
    for i in range(4):
        raw = event("run.event", i)
        step = stepper.step(raw)
        expected = zlib.crc32(b"".join([raw, *step.outputs]), expected)
        assert step.digest == expected
        assert step[:3] == (("run.event", "supervisor", 0), i, 7)
    assert stepper.steps == 4


@pytest.mark.parametrize("raw", [b"", b"run.event\0", b"run.event\0\xc1", event("run.event")[:-1]])
def test_a_frame_that_can_not_be_read_is_no_step(raw: bytes) -> None:
    echo = Echo("arm", {"run.event": ["node.event"]})
    stepper = Stepper("arm", echo)
    with pytest.raises(DecodeError):
        stepper.step(raw)
    assert (stepper.steps, stepper.digest, echo.heard) == (0, 0, [])


def test_an_output_beyond_its_limits_is_refused_by_name() -> None:
    class Wild:
        def step(self, _message: Message) -> Iterable[tuple[str, Any]]:
            return [("eval.metrics", Metrics(0, math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0))]

    stepper = Stepper("slam", Wild())
    with pytest.raises(EncodeError, match=r"eval\.metrics\.arr"):
        stepper.step(event("run.event"))
    assert (stepper.steps, stepper.digest) == (0, 0)


def test_a_batch_ends_with_the_step_that_fails() -> None:
    class Third:
        def step(self, message: Message) -> Iterable[tuple[str, Any]]:
            if message.seq == 2:
                raise KeyError("third")
            return []

    runner = LocalRunner(Stepper("slam", Third()))
    runner.submit([event("run.event", i) for i in range(5)])
    results = runner.collect()
    assert [r.error for r in results] == ["", "", "KeyError: 'third'"]
    assert results[2].digest == results[1].digest


def grouped(nodes: dict[str, Echo], hears: dict[str, tuple[str, ...]]) -> tuple[Group, list[str]]:
    order: list[str] = []

    def on_step(steps: Any, heard: bytes, _step: Step) -> None:
        order.append(f"{steps.name}:{decode(heard).topic}#{decode(heard).seq}")

    members = [(Stepper(name, node), hears[name]) for name, node in nodes.items()]
    return Group(members, on_step), order


def test_a_group_delivers_everything_that_follows_before_the_next_frame() -> None:
    nodes = {
        "sampler": Echo("sampler", {"run.event": ["node.event"]}),
        "whisk": Echo("whisk", {"node.event": ["host.event"]}),
        "arm": Echo("arm", {}),
    }
    hears = {
        "sampler": ("run.event", "host.event"),
        "whisk": ("node.event",),
        "arm": ("run.event", "node.event", "host.event"),
    }
    group, order = grouped(nodes, hears)
    for i in range(2):
        group.feed(event("run.event", i))
        assert sorted(order) == sorted(
            f"{who}:{topic}#{n}"
            for n in range(i + 1)
            for who, topic in (
                ("sampler", "run.event"), ("arm", "run.event"), ("whisk", "node.event"),
                ("arm", "node.event"), ("sampler", "host.event"), ("arm", "host.event"),
            )
        )  # fmt: skip


def test_the_same_feeds_give_the_same_order_of_steps() -> None:
    def once() -> list[str]:
        nodes = {
            "arm": Echo("arm", {"run.event": ["node.event", "node.event"]}),
            "slam": Echo("slam", {"node.event": ["host.event"], "run.event": ["host.event"]}),
        }
        group, order = grouped(
            nodes, {"arm": ("run.event", "host.event"), "slam": ("node.event", "run.event")}
        )
        for i in range(20):
            group.feed(event("run.event", i))
        return order

    assert once() == once() and len(once()) > 100


def test_what_is_told_to_one_member_reaches_the_others_only_by_what_it_says() -> None:
    nodes = {"sampler": Echo("sampler", {"host.event": ["node.event"]}), "arm": Echo("arm", {})}
    group, order = grouped(nodes, {"sampler": ("host.event",), "arm": ("host.event", "node.event")})
    group.tell("sampler", event("host.event"))
    assert order == ["sampler:host.event#0", "arm:node.event#0"]


def test_what_nobody_hears_is_no_step() -> None:
    group, order = grouped({"arm": Echo("arm", {})}, {"arm": ("run.event",)})
    group.feed(event("node.event"))
    assert order == []


STREAMS = [("head.sample", "sampler", 0), ("run.event", "supervisor", 0), ("host.timer", "rig", 3)]
U32 = st.integers(0, 2**32 - 1)
STEPS = st.lists(st.tuples(st.sampled_from(STREAMS), U32, U32), max_size=30)


@given(STEPS, st.integers(1, 7))
def test_receipts_tell_every_step_however_they_are_batched(
    steps: list[tuple[tuple[str, str, int], int, int]], batch: int
) -> None:
    book = ReceiptBook("whisk")
    frames = []
    for stream, seq, digest in steps:
        book.add(Step(stream, seq, 0, (), digest))
        if len(book) >= batch:
            frames.append(book.frame(99))
    frames.append(book.frame(100))
    assert len(book) == 0
    told = [entry for raw in frames for entry in entries(decode(raw))]
    assert [(e.stream, e.seq, e.digest) for e in told] == steps
    assert [e.step for e in told] == list(range(len(steps)))
    assert [decode(raw).seq for raw in frames] == list(range(len(frames)))


def test_a_receipt_of_hundreds_of_steps_is_small() -> None:
    book = ReceiptBook("whisk")
    for i in range(400):
        book.add(Step(("head.sample", "sampler", 0), i, 0, (), 2**31 + i))
    assert len(book.frame(0)) < 400 * 10


def test_timer_frames_carry_their_tick() -> None:
    read = decode(timer_frame("rig", 12))
    assert read[:5] == ("host.timer", "rig", 0, 12, 6_000_000) and read.body.tick == 12


@given(
    st.lists(st.floats(0, 30_000), min_size=1, max_size=200), st.sampled_from([0.5, 0.99, 0.999])
)
def test_quantiles_are_exact_to_a_microsecond(durations: list[float], q: float) -> None:
    histogram = Histogram()
    for duration in durations:
        histogram.add(duration)
    exact = sorted(durations)[max(math.ceil(q * len(durations)) - 1, 0)]
    found = histogram.quantile(q)
    assert histogram.largest == max(durations)
    if exact < 19_999:
        assert exact <= found + 1e-9 and found - exact <= 1.0 + 1e-9
    else:
        assert found == max(durations)


def test_nothing_measured_is_told_as_nothing() -> None:
    assert Histogram().summary() == {} and math.isnan(Histogram().quantile(0.5))
    assert Histogram().recent() == (0.0, 0.0)


def test_every_type_goes_through_a_stepper_unchanged() -> None:
    heard = []

    class Ear:
        def step(self, message: Message) -> Iterable[tuple[str, Any]]:
            heard.append(message.topic)
            return []

    stepper = Stepper("slam", Ear())
    for topic in CODECS:
        assert isinstance(stepper.step(frame(plain(topic))).digest, int)
    assert heard == list(CODECS)
    assert np.unique(heard).size == len(CODECS)
