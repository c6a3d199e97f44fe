"""Emulators: they touch what the arm carries them to, keep their own time, and end when told."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tests.devices.benches import readings
from tests.devices.stepped import HandClock, stepped_head
from vibrissa.control.kinematics import Float32s, paper_head
from vibrissa.rig.devices.emulation import (
    BACKLOG,
    DeviceClock,
    EmulatorProcess,
    Line,
    Orders,
    PoseEar,
    PoseMouth,
    read_pose,
)
from vibrissa.rig.devices.errors import DeviceUnavailable


def test_a_head_feels_the_walls_where_the_arm_carries_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = HandClock()
    clock.put_into(monkeypatch)
    head, emulator = stepped_head(clock, "walls", "--hear", "0")
    mouth = PoseMouth(emulator.ear.port)
    protracted = (0.9 * paper_head().swing).astype(np.float32)

    def felt(z: float) -> Float32s:
        """Mean moments float32[18] of whiskers that rest, protracted, at this height."""
        mouth.tell((0.63, 0.09, z, 0.0))
        found = list(itertools.islice(readings(head, command=protracted), 1000))[600:]
        assert np.ptp([r.theta.mean() for r in found]) < 0.02
        return np.mean([r.y for r in found], axis=0, dtype=np.float32)

    try:
        with head:
            free, inside, free_again = felt(0.4), felt(0.077), felt(0.4)
    finally:
        emulator.close()
    noise = 1e-5 / np.sqrt(400)  # N m, of such a mean; the default of the plant
    assert np.abs(free_again - free).max() < 6 * noise
    assert np.abs(inside - free).max() > 30 * noise  # in the corridor, between its walls


def test_poses_that_make_no_sense_are_not_taken() -> None:
    ear = PoseEar((1.0, 2.0, 3.0, 4.0), 0)
    mouth = PoseMouth(ear.port)
    mouth.tell((float("nan"), 0.0, 0.0, 0.0))
    mouth._socket.send(b"short")
    assert ear.listen() == (1.0, 2.0, 3.0, 4.0)
    mouth.tell((5.0, 6.0, 7.0, 8.0))
    assert ear.listen() == (5.0, 6.0, 7.0, 8.0)
    assert read_pose("1,2,3,4") == (1.0, 2.0, 3.0, 4.0)


def test_a_device_clock_drifts_as_it_was_told(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = HandClock()
    clock.put_into(monkeypatch)
    assert ticks_of(DeviceClock(drift=0.5), clock, 1.0) == pytest.approx(3000, abs=2)
    assert ticks_of(DeviceClock(drift=-0.5, jitter=1e-4), clock, 1.0) == pytest.approx(1000, abs=2)


def ticks_of(device: DeviceClock, clock: HandClock, seconds: float) -> int:
    """How many ticks a device has that is looked at every 10 us."""
    count = 0
    for _ in range(round(seconds / 10e-6)):
        clock.ns += 10_000
        count += device.due()
    return count


def test_late_ticks_are_made_up_for_at_twice_the_pace_and_only_so_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = HandClock()
    clock.put_into(monkeypatch)
    device = DeviceClock()
    clock.ns += (BACKLOG // 2) * 500_000
    assert ticks_of(device, clock, 0.005) == pytest.approx(20, abs=2)
    assert ticks_of(device, clock, 0.1) == pytest.approx(200 + BACKLOG // 2 - 10, abs=2)
    assert ticks_of(device, clock, 0.1) == pytest.approx(200, abs=2)
    clock.ns += 10**10  # more than it makes up for
    assert ticks_of(device, clock, 1.0) == pytest.approx(2000 + BACKLOG, abs=2)


def test_bit_errors_have_the_rate_that_was_asked_for() -> None:
    line = Line(seed=2)
    assert line.carry(bytes(1000)) == bytes(1000)
    line.errors(0.01)
    hurt = line.carry(bytes(100_000))
    flipped = sum(byte.bit_count() for byte in hurt)
    assert flipped == pytest.approx(8000, rel=0.1)
    line.errors(1.0)
    assert line.carry(b"\0\xff") == b"\xff\0"
    with pytest.raises(ValueError, match="expected a rate of 0 to 1"):
        line.errors(2.0)


def test_orders_that_are_wrong_are_answered_and_change_nothing() -> None:
    said: list[float] = []
    orders = Orders({"say": said.append, "count": lambda: len(said)})
    assert orders.carry_out(["say", "2"]) == "ok" and said == [2.0]
    assert orders.carry_out(["count"]) == "1"
    assert orders.carry_out(["shout"]) == "expected one of say, count"
    assert orders.carry_out(["say", "two"]).startswith("say: could not convert")
    assert orders.carry_out([]).startswith("expected one of")
    assert said == [2.0]


def test_an_emulator_ends_with_its_input_and_one_that_cannot_start_is_named() -> None:
    emulator = EmulatorProcess("rtde", ["--host", "127.0.3.3"])
    assert emulator.running() and emulator.url == "rtde:127.0.3.3"
    assert emulator.ask("dance").startswith("expected one of stall, protective_stop")
    emulator.stop()
    assert not emulator.running()
    with pytest.raises(DeviceUnavailable, match="rtde emulator: has ended"):
        emulator.ask("normal")
    with pytest.raises(DeviceUnavailable, match="rtde emulator: could not start"):
        EmulatorProcess("rtde", ["--host", "192.0.2.1"])
