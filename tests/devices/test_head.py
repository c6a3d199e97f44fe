"""Every head, whatever it hangs on, keeps the same promises."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from tests.devices.benches import (
    MAKERS,
    WAIT_S,
    ZERO,
    HeadBench,
    readings,
    streaming,
    take,
    wait_for,
)
from vibrissa.rig.devices import protocol
from vibrissa.rig.devices.errors import DeviceLimit

pytestmark = pytest.mark.live


@pytest.fixture(params=list(MAKERS))
def bench(request: pytest.FixtureRequest, head_benches: Callable[[str], HeadBench]) -> HeadBench:
    return head_benches(request.param)


def test_it_introduces_itself_with_version_serial_and_channel_map(bench: HeadBench) -> None:
    with streaming(bench) as head:
        assert head.info.firmware == (1, 0, 0)
        assert head.info.serial
        names = [c.name for c in head.info.channels]
        assert names == [c.name for c in protocol.standard_map()]
        assert "54 channels" in head.info.describe()


def test_samples_are_numbered_by_the_devices_clock_and_in_si_units(bench: HeadBench) -> None:
    with streaming(bench) as head:
        found = take(head, 400)
        for a, b in pairwise(found):
            assert b.sample > a.sample
            assert b.device_us - a.device_us == 500 * (b.sample - a.sample)
            assert b.host_ns >= a.host_ns
        for r in found:
            for values in (r.theta, r.x, r.y):
                assert values.shape == (18,) and values.dtype == np.float32
        rest = np.array([r.theta for r in found[200:]])
        assert 1e-4 < rest.std() < 0.02  # rad: there is noise, and nothing moves
        assert np.abs([r.x for r in found[200:]]).max() < 5e-3  # N m: nothing is touched
        missing = found[-1].sample - found[0].sample + 1 - len(found)
        assert missing <= head.counters.lost


def test_commands_move_the_whiskers_and_are_answered(bench: HeadBench) -> None:
    command = np.linspace(0.1, 0.3, 18).astype(np.float32)
    with streaming(bench) as head:
        moved: list[np.ndarray] = []
        last = -1
        for reading in readings(head, command=command):
            assert reading.answers <= reading.sample
            assert reading.answers >= last or reading.answers == -1
            last = reading.answers
            moved.append(reading.theta)
            if len(moved) >= 600 and reading.answers >= 0:
                near = np.mean(moved[-50:], axis=0)
                if np.abs(near - command).max() < 0.02:
                    break


def test_whiskers_retract_when_commands_stay_away(bench: HeadBench) -> None:
    command = np.full(18, 0.3, np.float32)
    with streaming(bench) as head:
        until = time.monotonic() + WAIT_S
        while time.monotonic() < until:
            reading = head.read(0.05)
            if reading is not None:
                head.write(reading.sample, command)
                if reading.theta.min() > 0.2:
                    break
        while time.monotonic() < until:
            reading = head.read(0.05)
            if reading is not None and reading.flags & protocol.RETRACTING:
                assert reading.answers == -1
                if np.abs(reading.theta).max() < 0.05:
                    break
        else:
            pytest.fail(f"{head.name}: whiskers did not retract")
        back = wait_for(head, lambda r: r.answers >= 0)
        assert not back.flags & protocol.RETRACTING


@pytest.mark.parametrize(
    ("whisker", "value", "named"),
    [(3, 2.0, "whisker 3"), (17, -0.5, "whisker 17"), (9, np.nan, "found nan"), (0, np.inf, "inf")],
)
def test_a_command_outside_the_limits_is_refused_before_it_is_sent(
    bench: HeadBench, whisker: int, value: float, named: str
) -> None:
    bad = ZERO.copy()
    bad[whisker] = value
    with streaming(bench) as head:
        with pytest.raises(DeviceLimit, match=named) as caught:
            head.write(2**31, bad)
        assert "\n" not in str(caught.value)
        assert all(r.answers < 2**31 for r in take(head, 50))
        with pytest.raises(DeviceLimit, match=r"float32\[18\]"):
            head.write(5, np.zeros(17, np.float32))


def test_it_can_be_closed_and_opened_again(bench: HeadBench) -> None:
    for _ in range(2):
        with streaming(bench) as head:
            assert take(head, 5)[0].sample >= 20
            assert head.counters.crc_errors <= 1  # the end of what the last user left
        head.close()


def test_reading_without_waiting_gives_what_is_there_and_no_more(bench: HeadBench) -> None:
    with streaming(bench) as head:
        until = time.monotonic() + WAIT_S
        while head.read(0) is not None:
            assert time.monotonic() < until
        assert wait_for(head, lambda r: True) is not None


def test_a_firmware_reset_is_noticed_and_the_numbering_goes_on(bench: HeadBench) -> None:
    with streaming(bench) as head:
        before, begun = take(head, 50)[-1], time.monotonic_ns()
        boot = head.info.boot
        assert bench.ask("reset") == "ok"
        after = wait_for(head, lambda r: head.counters.resets == 1)
        ticks = (time.monotonic_ns() - begun) / 500_000
        assert head.info.boot != boot
        assert before.sample < after.sample <= before.sample + 2 * ticks + 200
        following = take(head, 100)
        assert all(b.sample > a.sample for a, b in pairwise([after, *following]))
        assert wait_for(head, lambda r: r.answers > after.sample)
        assert head.counters.resets == 1
