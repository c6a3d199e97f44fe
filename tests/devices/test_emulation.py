"""Emulators: they touch what the arm carries them to, keep their own time, and end when told."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tests.devices.benches import readings, serial_thread_bench, streaming
from vibrissa.control.kinematics import paper_head
from vibrissa.rig.devices.emulation import (
    DeviceClock,
    EmulatorProcess,
    Line,
    Orders,
    PoseEar,
    PoseMouth,
    read_pose,
)
from vibrissa.rig.devices.errors import DeviceUnavailable


def test_a_head_feels_the_walls_where_the_arm_carries_it(tmp_path: Path) -> None:
    ear = PoseEar((0.0,) * 4, 0)
    port, _ = ear.port, ear._socket and ear._socket.close()
    bench = serial_thread_bench(tmp_path, "--hear", str(port))
    mouth = PoseMouth(port)
    protracted = (0.9 * paper_head().swing).astype(np.float32)
    try:
        with streaming(bench) as head:
            stream = readings(head, command=protracted)
            free = 0.0  # N m
            for _, reading in zip(range(600), stream, strict=False):
                mouth.tell((0.63, 0.09, 0.4, 0.0))
                free = max(free, float(np.abs(reading.y).max()))
            assert free < 1e-3
            for reading in stream:  # in the corridor, between its walls
                mouth.tell((0.63, 0.09, 0.077, 0.0))
                if np.abs(reading.y).max() > 2 * free:
                    break
    finally:
        bench.close()


def test_poses_that_make_no_sense_are_not_taken() -> None:
    ear = PoseEar((1.0, 2.0, 3.0, 4.0), 0)
    mouth = PoseMouth(ear.port)
    mouth.tell((float("nan"), 0.0, 0.0, 0.0))
    mouth._socket.send(b"short")
    assert ear.listen() == (1.0, 2.0, 3.0, 4.0)
    mouth.tell((5.0, 6.0, 7.0, 8.0))
    assert ear.listen() == (5.0, 6.0, 7.0, 8.0)
    assert read_pose("1,2,3,4") == (1.0, 2.0, 3.0, 4.0)


def test_a_device_clock_drifts_as_it_was_told() -> None:
    fast, slow = DeviceClock(drift=0.5), DeviceClock(drift=-0.5)
    time.sleep(0.05)
    ticks = fast.due(), slow.due()
    assert 2.5 < ticks[0] / ticks[1] < 3.5


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
