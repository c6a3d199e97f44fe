"""Nothing that reads bytes can be made to crash; numbering survives any messages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.devices import fuzz
from vibrissa.rig.devices.errors import DeviceRefused
from vibrissa.rig.devices.head import HeadDevice
from vibrissa.rig.devices.protocol import (
    Foreign,
    FromHead,
    FromHost,
    Hello,
    HelloPlease,
    RawSample,
)

HELLO = Hello(0, 1, (1, 0, 0), "FUZZ")


def test_a_short_run_of_the_fuzzer_passes() -> None:
    lines: list[str] = []
    fuzz.run(70_000, seed=5, report=lines.append)
    assert len(lines) == 8 and lines[-1].startswith("70007 frames")


def test_guided_by_branches_the_fuzzer_keeps_what_reaches_new_ones() -> None:
    branches = fuzz.Branches()
    target = next(t for t in fuzz.targets() if t.name == "serial up")
    assert branches.new(target.hear, target.seeds[0])[1]
    assert not branches.new(target.hear, target.seeds[0])[1], "taken before"
    assert branches.new(target.hear, b"\x00garbage\x00")[1], "the damaged frame's branch"
    lines: list[str] = []
    fuzz.run(1_400, seed=2, report=lines.append, coverage=True)
    assert any("branches taken" in line for line in lines)


def test_the_fuzzer_notices_a_crash() -> None:
    def fragile(data: bytes) -> int:
        return data[100]

    target = fuzz.Target("fragile", fragile, [bytes(101)])
    try:
        fuzz._spell(target, 1000, fuzz.random.Random(1))
    except IndexError:
        return
    raise AssertionError("it was not noticed")


class Scripted(HeadDevice):
    """A head that says what it is told to."""

    _others_s = 0.0

    def __init__(self) -> None:
        super().__init__("scripted")
        self.script: list[FromHead] = []

    def _open_link(self) -> None:
        pass

    def _close_link(self) -> None:
        pass

    def _receive(self, timeout: float) -> Iterator[FromHead]:
        said, self.script = self.script, []
        return iter(said)

    def _send(self, item: FromHost) -> None:
        if isinstance(item, HelloPlease):
            self.script.append(replace(HELLO, nonce=item.nonce))


numbers = st.one_of(
    st.integers(0, 50), st.integers(2**32 - 20, 2**32 - 1), st.integers(0, 2**32 - 1)
)
messages = st.one_of(
    st.builds(RawSample, numbers, numbers, numbers, st.integers(0, 255), st.just(bytes(108))),
    st.builds(lambda b: replace(HELLO, boot=b), st.integers(1, 3)),
    st.builds(lambda n: replace(HELLO, nonce=n), st.integers(0, 3)),
    st.just(replace(HELLO, serial="OTHER")),
    st.just(replace(HELLO, channels=HELLO.channels[:-1])),
    st.builds(Foreign, st.integers(2, 255)),
)


@given(st.lists(st.lists(messages, max_size=6), max_size=20))
def test_samples_are_numbered_upwards_whatever_the_head_says(
    script: list[list[FromHead]],
) -> None:
    with Scripted() as head:
        found = []
        for said in script:
            head.script = list(said)
            try:
                while (reading := head.read(0)) is not None:
                    found.append(reading)
            except DeviceRefused as error:
                assert "\n" not in str(error)
                assert any(isinstance(i, Hello) and i.serial == "OTHER" for i in said) or any(
                    isinstance(i, Hello) and len(i.channels) < 54 for i in said
                )
                break
        assert all(
            b.sample > a.sample and b.device_us > a.device_us - 1 for a, b in pairwise(found)
        )
        counters = head.counters
        if found:
            assert found[-1].sample <= counters.samples + counters.lost
