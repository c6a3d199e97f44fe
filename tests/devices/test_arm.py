"""Every arm keeps its promises: nothing moves unasked or beyond the limits, a stop wins."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import pytest

from vibrissa.rig.devices import rtde_wire
from vibrissa.rig.devices.arm import ArmDevice, ArmReport, Safety, State
from vibrissa.rig.devices.emulation import EmulatorProcess
from vibrissa.rig.devices.errors import (
    DeviceLimit,
    DeviceLost,
    DeviceRefused,
    DeviceStopped,
    DeviceUnavailable,
)
from vibrissa.rig.devices.limits import ARM, ArmLimits, Pose
from vibrissa.rig.devices.rtde_arm import RtdeArm
from vibrissa.rig.devices.virtual_arm import VirtualArm

pytestmark = pytest.mark.live

HOST = f"127.0.{os.getpid() % 200 + 1}.7"
START: Pose = (0.63, 0.09, 0.177, 0.0)
PATIENT = ArmLimits(stale_ticks=4000, stale_setpoint_ticks=4000, watchdog=0.5, patience=120.0)
"""Time limits that a busy machine does not break; the tests of time limits use the real ones."""
rtde = pytest.importorskip("rtde_receive", reason="no wheels of ur-rtde for this Python")


@dataclass
class ArmBench:
    name: str
    make: Callable[[ArmLimits], ArmDevice]
    ask: Callable[[str], str]


@pytest.fixture(scope="module")
def emulator() -> Iterator[EmulatorProcess]:
    with EmulatorProcess("rtde", ["--host", HOST]) as process:
        yield process


@pytest.fixture(params=["virtual", "rtde"])
def bench(request: pytest.FixtureRequest) -> ArmBench:
    if request.param == "rtde":
        return rtde_bench(request.getfixturevalue("emulator"))
    made: list[VirtualArm] = []

    def make(limits: ArmLimits) -> ArmDevice:
        made.append(VirtualArm(START, limits=limits))
        return made[-1]

    def ask(order: str) -> str:
        states = {"protective_stop": Safety.PROTECTIVE_STOP, "unlock": Safety.NORMAL}
        states["emergency_stop"] = Safety.EMERGENCY_STOP
        made[-1].safety = states[order]
        return "ok"

    return ArmBench("virtual", make, ask)


def rtde_bench(emulator: EmulatorProcess) -> ArmBench:
    emulator.ask("normal")
    return ArmBench("rtde", lambda limits: RtdeArm(HOST, limits=limits), emulator.ask)


@pytest.fixture
def real(emulator: EmulatorProcess) -> ArmBench:
    return rtde_bench(emulator)


def news(arm: ArmDevice, seconds: float = 120.0) -> Iterator[ArmReport]:
    """States as they come."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        report = arm.read(0.1)
        if report is not None:
            yield report
    raise AssertionError(f"{arm.name}: {arm.state}, {arm.cause}, {arm.counters}")


def advance(arm: ArmDevice, cycles: int, speed: float = 0.05) -> Pose:
    """Drive along x from where the arm is, a set-point per state; the last of them."""
    stream = news(arm)
    x, y, z, yaw = next(stream).pose
    for k, _ in zip(range(cycles), stream, strict=False):
        x += min(k * 0.016, speed) * arm.info.period
        if not arm.write(16 * k, (x, y, z, yaw)):
            break
    return x, y, z, yaw


def until(arm: ArmDevice, condition: Callable[[ArmReport], bool]) -> ArmReport:
    """The first state of which something is true; the last set-point is held meanwhile."""
    for report in news(arm):
        if condition(report):
            return report
    raise AssertionError


def test_it_opens_without_moving_and_reports_by_the_controllers_clock(bench: ArmBench) -> None:
    with bench.make(PATIENT) as arm:
        found = [r for _, r in zip(range(40), news(arm), strict=False)]
        assert all(b.stamp > a.stamp and b.host_ns > a.host_ns for a, b in pairwise(found))
        steps = [round((b.stamp - a.stamp) / arm.info.period, 6) for a, b in pairwise(found)]
        assert all(step == int(step) for step in steps)
        assert found[-1].pose == pytest.approx(found[0].pose, abs=1e-9)
        assert found[-1].speed == pytest.approx(0.0, abs=1e-9)
        assert found[-1].safety is Safety.NORMAL and arm.state is State.RESTING


def test_set_points_before_the_start_are_ignored(bench: ArmBench) -> None:
    with bench.make(PATIENT) as arm:
        x, y, z, yaw = start = arm.report.pose
        assert not arm.write(0, (x + 0.01, y, z, yaw))
        for _ in range(20):
            arm.read(0.1)
        assert arm.report.pose == pytest.approx(start, abs=1e-9)
        assert arm.counters.ignored == 1 and arm.counters.setpoints == 0


def test_an_enabled_arm_goes_where_it_is_told(bench: ArmBench) -> None:
    with bench.make(PATIENT) as arm:
        begun = arm.report.pose
        arm.enable()
        assert arm.state is State.MOVING
        goal = advance(arm, 100)
        assert goal[0] > begun[0] + 0.02
        stream = news(arm)
        for k in range(60):
            next(stream)
            arm.write(2000 + k, goal)
        assert arm.report.pose[:3] == pytest.approx(goal[:3], abs=1e-3)
        assert math.remainder(arm.report.pose[3] - goal[3], 2 * math.pi) == pytest.approx(
            0, abs=5e-3
        )


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ((0.5, 0.0, 0.0, 0.0), "speed: expected at most"),
        ((0.0, 0.0, 0.0, 2.0), "turn speed: expected at most"),
        ((0.0, 0.0, -1.0, 0.0), r"z: expected 0\.06 to 0\.4 m \(workspace\)"),
        ((math.nan, 0.0, 0.0, 0.0), "expected finite"),
    ],
)
def test_a_set_point_beyond_the_limits_stops_the_arm(
    bench: ArmBench, change: Pose, complaint: str
) -> None:
    with bench.make(PATIENT) as arm:
        arm.enable()
        x, y, z, yaw = advance(arm, 10)
        dx, dy, dz, turn = change
        with pytest.raises(DeviceLimit, match=complaint) as caught:
            arm.write(777, (x + dx, y + dy, z + dz, yaw + turn))
        assert "tick 777" in str(caught.value) and "\n" not in str(caught.value)
        assert arm.state is State.STOPPED and arm.counters.refused == 1
        assert not arm.write(778, (x, y, z, yaw))
        assert until(arm, lambda r: r.speed < 1e-3).pose[:3] == pytest.approx((x, y, z), abs=0.01)


def test_a_first_set_point_far_away_is_refused(bench: ArmBench) -> None:
    with bench.make(PATIENT) as arm:
        arm.enable()
        x, y, z, yaw = before = arm.report.pose
        with pytest.raises(DeviceLimit, match="first set-point within"):
            arm.write(0, (x + 0.1, y, z, yaw))
        for _ in range(5):
            arm.read(0.1)
        assert arm.report.pose == pytest.approx(before, abs=1e-6)


def test_a_whole_path_is_checked_before_the_first_motion(bench: ArmBench) -> None:
    with bench.make(PATIENT) as arm:
        x, y, z, yaw = arm.report.pose
        gentle = [0.0002 * max(k - 40, 0) + 2.5e-6 * min(k, 40) ** 2 for k in range(500)]
        path = [(x + along, y, z, yaw) for along in gentle]
        arm.check(path)
        with pytest.raises(DeviceLimit, match=r"arm path, .* s: x: expected"):
            arm.check([*path, *((path[-1][0] + 2e-4 * k, y, z, yaw) for k in range(1, 10_000))])
        assert arm.counters.setpoints == 0 and arm.state is State.RESTING


def test_a_stop_wins_until_a_person_starts_again(bench: ArmBench) -> None:
    with bench.make(PATIENT) as arm:
        arm.enable()
        goal = advance(arm, 60, speed=0.1)
        arm.stop("the operator said so")
        assert (arm.state, arm.cause) == (State.STOPPED, "the operator said so")
        assert not arm.write(999, goal)
        rest = until(arm, lambda r: r.speed < 1e-3).pose
        for _ in range(10):
            arm.read(0.1)
            arm.write(1000, goal)
        assert arm.report.pose[:3] == pytest.approx(rest[:3], abs=1e-3)
        arm.enable()
        assert arm.state is State.MOVING and advance(arm, 30)[0] > rest[0]


@pytest.mark.parametrize("kind", ["protective_stop", "emergency_stop"])
def test_a_stop_of_the_controller_ends_the_trajectory(bench: ArmBench, kind: str) -> None:
    safety = {"protective_stop": Safety.PROTECTIVE_STOP, "emergency_stop": Safety.EMERGENCY_STOP}
    with bench.make(PATIENT) as arm:
        arm.enable()
        goal = advance(arm, 30)
        bench.ask(kind)
        with contextlib.suppress(DeviceStopped):
            for _ in news(arm):
                if not arm.write(1, goal):
                    break
        until(arm, lambda r: r.safety is safety[kind])
        assert arm.state is State.STOPPED
        with pytest.raises(DeviceStopped, match=safety[kind].value):
            arm.enable()
        bench.ask("unlock")
        until(arm, lambda r: r.safety is Safety.NORMAL)
        assert arm.state is State.STOPPED  # released is not started
        arm.enable()
        assert advance(arm, 20)[0] > goal[0] - 0.01


def test_an_arm_without_new_set_points_decelerates_by_itself(bench: ArmBench) -> None:
    limits = ArmLimits(stale_ticks=4000, watchdog=0.5, patience=120.0)
    with bench.make(limits) as arm:
        arm.enable()
        advance(arm, 5)
        for _ in news(arm):
            if arm.state is State.STOPPED:
                break
        assert f"no set-point for {ARM.stale_setpoint_ticks} ticks" in arm.cause
        until(arm, lambda r: r.speed < 1e-3)


# Faults that only a controller on a network can have.


def test_several_controllers_run_at_once_and_are_told_apart() -> None:
    hosts = [HOST.replace(".7", f".{k}") for k in (21, 22)]
    poses = ["0.5,0.09,0.177,0", "0.7,0.09,0.177,1.0"]
    emulators = [
        EmulatorProcess("rtde", ["--host", h, "--pose", p, "--version", v])
        for h, p, v in zip(hosts, poses, ("3.15.8", "5.11.6"), strict=True)
    ]
    try:
        with RtdeArm(hosts[0]) as one, RtdeArm(hosts[1]) as other:
            assert one.report.pose == pytest.approx((0.5, 0.09, 0.177, 0.0), abs=1e-6)
            assert other.report.pose == pytest.approx((0.7, 0.09, 0.177, 1.0), abs=1e-6)
            assert (one.info.period, other.info.period) == (0.008, 0.002)
            assert one.info.version.startswith("3.15.8.")
    finally:
        for process in emulators:
            process.stop()


def test_a_probe_tells_who_is_there_and_moves_nothing(emulator: EmulatorProcess) -> None:
    emulator.ask("normal")
    travelled = emulator.ask("travelled")
    found = rtde_wire.probe(HOST, 5.0)
    assert found.version[:3] == (3, 15, 8)
    assert found.robot_mode == rtde_wire.RUNNING_MODE and found.safety_bits == 1
    assert emulator.ask("travelled") == travelled


def test_a_stall_of_3_s_stops_the_arm_and_it_waits_for_a_person(real: ArmBench) -> None:
    limits = ArmLimits(patience=120.0, stale_setpoint_ticks=4000, watchdog=0.5)
    with real.make(limits) as arm:
        arm.enable()
        goal = advance(arm, 10)
        begun = time.monotonic()
        real.ask("stall 3")
        while arm.state is State.MOVING or arm.state is State.STOPPED:
            arm.read(0.02)
            assert time.monotonic() - begun < 30.0
        assert arm.state is State.STALE and arm.cause.startswith(
            f"no state for {ARM.stale_ticks} ticks"
        )
        assert not arm.write(1, goal)
        with pytest.raises(DeviceStopped, match="can't be enabled: no news"):
            arm.enable()
        until(arm, lambda r: True)
        assert time.monotonic() - begun >= 2.9
        assert arm.state is State.STOPPED and arm.counters.stalls == 1
        assert not arm.write(2, goal)
        arm.enable()
        assert advance(arm, 10)


def test_a_controller_that_reboots_is_found_again_and_waits_for_a_person(real: ArmBench) -> None:
    limits = ArmLimits(patience=120.0, stale_setpoint_ticks=4000, watchdog=0.5)
    with real.make(limits) as arm:
        arm.enable()
        goal = advance(arm, 10)
        stamp = arm.report.stamp
        real.ask("reboot 0.5")
        back = until(arm, lambda r: r.stamp < stamp and arm.counters.reconnects > 0)
        assert back.safety is Safety.NORMAL
        assert arm.state is State.STOPPED and not arm.write(1, goal)
        arm.enable()
        assert advance(arm, 10)


def test_a_controller_that_stays_away_is_lost_after_the_patience(real: ArmBench) -> None:
    with real.make(ArmLimits(patience=1.0)) as arm:
        real.ask("reboot 1.5")
        with pytest.raises(DeviceLost, match="no state for 1 s"):
            for _ in range(1000):
                arm.read(0.02)
        assert arm.state is State.LOST
    time.sleep(0.6)


def test_when_the_driver_dies_the_controller_stops_the_arm_by_itself(
    real: ArmBench, emulator: EmulatorProcess
) -> None:
    with real.make(ArmLimits(patience=120.0, stale_setpoint_ticks=4000)) as arm:
        assert isinstance(arm, RtdeArm)
        arm.enable()
        x, y, z, yaw = advance(arm, 40, speed=0.1)
        assert arm._control is not None
        os.kill(arm._control._popen.pid, signal.SIGKILL)
        with pytest.raises(DeviceStopped, match="takes no set-points"):
            for _ in range(100):
                arm.write(1, (x, y, z, yaw))
        begun = arm.report.stamp  # watchdog and braking take less than 1 s of its clock
        until(arm, lambda r: r.stamp > begun + 3.0)
        travelled = emulator.ask("travelled")
        for _ in range(20):
            arm.read(0.1)
        assert float(emulator.ask("travelled")) == pytest.approx(float(travelled), abs=1e-6)


def test_a_set_point_may_take_as_long_as_there_may_be_none(
    real: ArmBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []
    with real.make(ArmLimits(stale_ticks=4000, stale_setpoint_ticks=1200, watchdog=0.5)) as arm:
        assert isinstance(arm, RtdeArm)
        arm.enable()
        goal = advance(arm, 10)
        with monkeypatch.context() as patch:
            patch.setattr(arm._control, "done", lambda _, timeout: bool(asked.append(timeout)))
            with pytest.raises(DeviceStopped, match="takes no set-points"):
                arm.write(1000, goal)
        assert asked[0] == pytest.approx(0.6)
        assert arm.state is State.STOPPED


@pytest.mark.parametrize(
    ("greeting", "error", "complaint"),
    [
        (None, DeviceUnavailable, "Connection refused"),
        (b"", DeviceUnavailable, "no answer within"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n" * 400, DeviceRefused, "expected RTDE, found"),
        (rtde_wire.packet(rtde_wire.VERSION, b"\0"), DeviceRefused, "protocol version 2"),
    ],
)
def test_a_port_that_is_refused_mute_or_strange_is_named(
    greeting: bytes | None, error: type[Exception], complaint: str
) -> None:
    host = HOST.replace(".7", ".99")
    done = threading.Event()

    def serve(server: socket.socket) -> None:
        link, _ = server.accept()
        with link:
            link.sendall(greeting or b"")
            done.wait(10.0)

    with socket.socket() as server:
        if greeting is not None:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            server.bind((host, rtde_wire.RTDE_PORT))
            server.listen()
            threading.Thread(target=serve, args=(server,), daemon=True).start()
        try:
            with pytest.raises(error, match=complaint) as caught:
                RtdeArm(host).open()
            assert "\n" not in str(caught.value)
        finally:
            done.set()
