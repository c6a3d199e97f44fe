"""What a head on a wire does when the wire, the head or a person misbehaves."""

from __future__ import annotations

import itertools
import os
import pty
import time
import tty
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from tests.devices.benches import (
    ZERO,
    HeadBench,
    can_virtual_bench,
    readings,
    serial_thread_bench,
    streaming,
    take,
    wait_for,
)
from vibrissa.rig.devices.can_head import CanHead
from vibrissa.rig.devices.errors import DeviceLost, DeviceRefused, DeviceUnavailable
from vibrissa.rig.devices.head import HeadDevice, Reading
from vibrissa.rig.devices.serial_head import SerialHead

pytestmark = pytest.mark.live

WIRED = ["serial", "can-loopback"]


@pytest.fixture(params=WIRED)
def bench(request: pytest.FixtureRequest, head_benches: Callable[[str], HeadBench]) -> HeadBench:
    return head_benches(request.param)


def honest(found: list[Reading]) -> bool:
    """Whether every number agrees with the device's clock."""
    return all(
        b.sample > a.sample and b.device_us - a.device_us == 500 * (b.sample - a.sample)
        for a, b in pairwise(found)
    )


def lose_some(head: HeadDevice, least: int) -> list[Reading]:
    """Readings until `least` samples more have been lost."""
    lost = head.counters.lost
    found = []
    for reading in readings(head):
        found.append(reading)
        if head.counters.lost >= lost + least:
            return found
    return found


def test_rare_bit_errors_cost_single_samples_and_nothing_false_comes_through(
    bench: HeadBench,
) -> None:
    with streaming(bench) as head:
        bench.ask("errors 1e-5")  # one frame in a hundred
        found = lose_some(head, 10)
        assert honest(found)
        assert all(abs(r.theta).max() < 0.2 and abs(r.y).max() < 0.03 for r in found)
        damaged = head.counters.crc_errors + head.counters.resyncs
        assert damaged >= 5 and head.counters.gaps >= 5
        missing = sum(b.sample - a.sample - 1 for a, b in pairwise(found))
        assert 5 <= missing <= head.counters.lost


def test_one_bit_in_a_hundred_wrong_lets_nothing_through_and_it_recovers(
    bench: HeadBench,
) -> None:
    with streaming(bench) as head:
        before = take(head, 20)[-1]
        bench.ask("errors 0.01")
        while head.read(0) is not None:  # what was sent before
            pass
        samples = head.counters.samples
        until = time.monotonic() + 0.5
        while time.monotonic() < until:
            head.read(0.02)
        assert head.counters.samples - samples < 20
        bench.ask("normal")
        after = take(head, 50)
        assert after[0].sample - before.sample > 800
        assert honest(after)


def test_a_drop_out_of_100_ms_is_a_gap_of_200_samples(bench: HeadBench) -> None:
    with streaming(bench) as head:
        before = take(head, 20)[-1]
        gaps = head.counters.gaps
        bench.ask("drop 0.1")
        found = [before, *lose_some(head, 150), *take(head, 50)]
        assert honest(found)
        assert head.counters.gaps > gaps
        longest = max(b.sample - a.sample for a, b in pairwise(found))
        assert longest >= 150


def test_unplugged_and_replugged_it_is_found_again_and_the_lost_time_is_counted(
    bench: HeadBench,
) -> None:
    with streaming(bench) as head:
        before = take(head, 20)[-1]
        begun = time.monotonic_ns()
        bench.ask("unplug 0.3")
        after = wait_for(head, lambda r: head.counters.resets == 1)
        elapsed = (time.monotonic_ns() - begun) / 500_000
        assert after.sample > before.sample
        assert 400 <= after.sample - before.sample <= 2 * elapsed + 200
        assert head.counters.reconnects == (1 if bench.name == "serial" else 0)
        assert head.counters.unsent >= 0
        assert wait_for(head, lambda r: r.answers > after.sample)


def test_garbage_is_skipped(bench: HeadBench) -> None:
    with streaming(bench) as head:
        frames = head.counters.frames
        bench.ask("noise 2000")
        found = [*take(head, 300)]
        assert honest(found)
        spoilt = head.counters.crc_errors + head.counters.strays + head.counters.resyncs
        assert spoilt > 0 and head.counters.frames > frames


def test_another_head_on_the_same_wire_is_refused(bench: HeadBench) -> None:
    with streaming(bench) as head:
        bench.ask("impostor")
        with pytest.raises(DeviceRefused, match="found head VIB-OTHER too") as caught:
            take(head, 20_000)
        assert "\n" not in str(caught.value)


def test_two_heads_that_answer_are_refused_at_the_start() -> None:
    first = can_virtual_bench("pair", "--serial", "LEFT", "--seed", "1")
    second = can_virtual_bench("pair", "--serial", "RIGHT", "--seed", "2")
    try:
        with pytest.raises(DeviceRefused, match=r"expected one head, found several.*LEFT.*RIGHT"):
            for _ in range(20):
                first.open().open().close()
    finally:
        first.close()
        second.close()


def test_a_port_in_use_is_refused(head_benches: Callable[[str], HeadBench]) -> None:
    bench = head_benches("serial")
    with streaming(bench), pytest.raises(DeviceUnavailable, match="in use by another process"):
        bench.open().open()


@pytest.mark.parametrize("wire", ["serial", "can"])
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--protocol", "2"), "protocol version: expected 1, found 2"),
        (("--channels", "36"), "channel map: expected 54 channels .*, found 36"),
    ],
)
def test_a_head_of_another_version_or_channel_count_is_refused(
    wire: str, arguments: tuple[str, ...], complaint: str, tmp_path: Path
) -> None:
    if wire == "serial":
        bench = serial_thread_bench(tmp_path, *arguments)
    else:
        bench = can_virtual_bench("odd", *arguments)
    try:
        with pytest.raises(DeviceRefused, match=complaint) as caught:
            bench.open().open()
        assert "\n" not in str(caught.value)
    finally:
        bench.close()


def test_a_port_that_is_missing_or_mute_is_unavailable(tmp_path: Path) -> None:
    with pytest.raises(DeviceUnavailable, match="can't be opened"):
        SerialHead(str(tmp_path / "nowhere")).open()
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        with pytest.raises(DeviceUnavailable, match="no head answered"):
            SerialHead(os.ttyname(slave)).open()
    finally:
        os.close(master)
        os.close(slave)
    with pytest.raises(DeviceUnavailable, match="can't be opened"):
        CanHead("socketcan", "can_none").open()


def test_a_head_that_stays_away_is_lost_after_its_patience() -> None:
    bench = can_virtual_bench("leaving")
    try:
        with streaming(bench, patience=0.5) as head:
            bench.ask("drop 60")
            begun = time.monotonic()
            with pytest.raises(DeviceLost, match=r"no sample for 0\.5 s"):
                for _ in itertools.count():
                    head.read(0.05)
            assert time.monotonic() - begun >= 0.4
            assert head.silent_ticks() >= 1000
    finally:
        bench.close()


def test_a_line_too_slow_for_the_stream_loses_samples_and_says_so(
    head_benches: Callable[[str], HeadBench],
) -> None:
    bench = head_benches("serial")
    with streaming(bench) as head:
        bench.ask("throttle 120000")
        found = lose_some(head, 200)
        assert honest(found)
        bench.ask("throttle 0")
        assert honest(take(head, 100))


def test_a_host_that_does_not_read_loses_samples_and_catches_up(
    head_benches: Callable[[str], HeadBench],
) -> None:
    bench = head_benches("serial")
    with streaming(bench) as head:
        errors = head.counters.crc_errors
        time.sleep(0.6)
        found = take(head, 1500)
        assert honest(found)
        assert head.counters.gaps >= 1
        assert head.counters.crc_errors == errors


def test_batches_carry_the_same_samples(head_benches: Callable[[str], HeadBench]) -> None:
    bench = head_benches("serial")
    port = bench.open()._port  # type: ignore[attr-defined]
    with SerialHead(port, batch=10, patience=60.0) as head:
        stamps: dict[int, int] = {}
        for reading in take(head, 400):
            stamps[reading.host_ns] = stamps.get(reading.host_ns, 0) + 1
        assert max(stamps.values()) >= 5


def test_commands_are_counted_while_there_is_no_link(
    head_benches: Callable[[str], HeadBench],
) -> None:
    bench = head_benches("serial")
    with streaming(bench) as head:
        bench.ask("unplug 0.3")
        sent = [head.write(k, ZERO) for k in range(3)]
        head.read(0.02)
        assert not head.write(9, ZERO)
        assert head.counters.unsent == 1 + sent.count(False)
        wait_for(head, lambda r: True)
