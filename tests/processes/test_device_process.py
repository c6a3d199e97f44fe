"""What the process of a device does about faults, to the tick, and what it says of them.

Time is turned by the test, so every figure is exact, on any machine.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.processes.device_process import ArmWorld, Bus, HeadWorld
from vibrissa.messages.types import ArmSetpoint, Event
from vibrissa.rig.devices.arm import Safety
from vibrissa.rig.devices.limits import ARM, HEAD

AT = 1000
"""Tick at which things go wrong."""
Patch = pytest.MonkeyPatch


def samples_are_accounted_for(bus: Bus) -> int:
    """How many samples were lost; each of them must have been told before the next one."""
    told = expected = lost = 0
    for message in bus.said:
        if message.topic == "rig.event" and message.body.kind == "gap":
            told = int(message.body.cause.partition(": ")[2].split()[0])
        elif message.topic == "rig.sample":
            tick = message.body.tick
            assert tick - expected == told
            expected, lost, told = tick + 1, lost + told, 0
    return lost


def test_a_head_that_is_well_streams_every_tick_and_is_introduced(
    monkeypatch: Patch, tmp_path: Path
) -> None:
    bus = HeadWorld(monkeypatch, tmp_path).run()
    assert [s.tick for s in bus.of("rig.sample")] == list(range(4000))
    assert [e.kind for e in bus.of("rig.event")] == ["opened"]
    assert "head VIB-EMU-1, firmware 1.0.0" in bus.of("rig.event")[0].cause
    assert all(s.tick - s.answers <= 2 for s in bus.of("rig.sample")[10:])
    kind, bye = bus.control[-1]
    assert kind == "bye" and bye["counters"]["head-device"]["lost"] == 0
    clocks = bus.of("rig.clock")
    assert len(clocks) >= 35
    for one, other in pairwise(clocks):
        assert other.host_ns - one.host_ns == pytest.approx(
            other.device_ns - one.device_ns, abs=6e5
        )


PASSING: dict[str, tuple[Callable[[HeadWorld], object], str, range]] = {
    "frames are damaged": (lambda w: w.far_end.line.errors(2e-5), "", range(5, 400)),
    "a drop-out of 100 ms": (lambda w: w.far_end.line.drop(0.1), "", range(195, 206)),
    "a reset of the firmware": (lambda w: w.far_end.reset(), "reset", range(0, 5)),
    "unplugged for 100 ms": (lambda w: w.far_end.unplug(0.1), "reset", range(195, 230)),
}


@pytest.mark.parametrize("fault", PASSING)
def test_what_passes_is_logged_and_the_run_goes_on(
    fault: str, monkeypatch: Patch, tmp_path: Path
) -> None:
    order, said, lost = PASSING[fault]
    world = HeadWorld(monkeypatch, tmp_path)
    world.orders[AT] = lambda: order(world)
    bus = world.run()
    assert samples_are_accounted_for(bus) in lost
    assert not bus.events("retract")
    assert [e.kind for e in bus.events("reset", "replugged")] == ([said] if said else [])
    assert bus.of("rig.sample")[-1].tick == 3999
    assert all(s.tick - s.answers <= 3 for s in bus.of("rig.sample")[-100:])


ENDING: dict[str, tuple[Callable[[HeadWorld], object], str, tuple[int, int]]] = {
    "every frame damaged, 1 % of bits": (
        lambda w: w.far_end.line.errors(0.01),
        f"no sample for {HEAD.silence_ticks} ticks",
        (HEAD.silence_ticks, HEAD.silence_ticks),
    ),
    "unplugged": (
        lambda w: w.far_end.unplug(30),
        f"no sample for {HEAD.silence_ticks} ticks",
        (HEAD.silence_ticks, HEAD.silence_ticks),
    ),
    "a tick overrun": (
        lambda w: setattr(w, "answering", False),
        f"no command for {HEAD.overrun_ticks} ticks",
        (HEAD.overrun_ticks, HEAD.overrun_ticks),
    ),
    "another head on the wire": (
        lambda w: w.far_end.impostor(),
        "found head VIB-OTHER too",
        (0, 0),
    ),
    "the supervisor is gone": (lambda w: w.leave_alone(), "supervisor gone", (0, 100)),
}


@pytest.mark.parametrize("fault", ENDING)
def test_what_does_not_pass_ends_the_run_after_the_stated_ticks(
    fault: str, monkeypatch: Patch, tmp_path: Path
) -> None:
    order, cause, (least, most) = ENDING[fault]
    world = HeadWorld(monkeypatch, tmp_path)
    at: list[int] = []
    world.orders[AT] = lambda: order(world)
    said = world.bus.publish

    def publish(frame: bytes) -> None:
        said(frame)
        if world.bus.events("retract") and not at:
            at.append(world.bus.tick)

    monkeypatch.setattr(world.bus, "publish", publish)
    bus = world.run()
    (retract,) = bus.events("retract")
    assert cause in retract.cause and "\n" not in retract.cause
    assert least - 2 <= at[0] - AT <= most + 2
    samples_are_accounted_for(bus)


def test_without_commands_the_firmware_has_retracted_long_before_the_run_ends(
    monkeypatch: Patch, tmp_path: Path
) -> None:
    world = HeadWorld(monkeypatch, tmp_path)
    world.orders[AT] = lambda: setattr(world, "answering", False)
    bus = world.run()
    unanswered = [s.tick for s in bus.of("rig.sample") if s.tick > AT and s.answers < 0]
    assert AT + HEAD.watchdog_ticks - 2 <= unanswered[0] <= AT + HEAD.watchdog_ticks + 3


@pytest.mark.parametrize(
    ("key", "cause"), [("sample_ticks", "no sample for"), ("command_ticks", "no command for")]
)
def test_the_files_limits_of_the_head_count(
    key: str, cause: str, monkeypatch: Patch, tmp_path: Path
) -> None:
    world = HeadWorld(monkeypatch, tmp_path, f"{key} = 90")
    if key == "sample_ticks":
        world.orders[AT] = lambda: world.far_end.line.drop(0.1)
    else:
        world.orders[AT] = lambda: setattr(world, "answering", False)
    assert world.run().events("retract")[0].cause == f"{cause} 90 ticks"


# The arm


def ran(world: ArmWorld) -> tuple[Bus, list[Event], list[tuple[int, float]]]:
    """What was said, what ended it, and the arm's speed (m/s) with the tick it was true at."""
    speeds: list[tuple[int, float]] = []

    def look() -> None:
        if hasattr(world, "arm") and world.bus.t0:
            speeds.append((world.bus.tick, float(np.hypot(*world.arm._plant.velocity[:2]))))

    world.clock.lives.append(look)
    bus = world.run()
    return bus, bus.events("retract"), speeds


def test_an_arm_that_is_well_is_enabled_at_tick_0_and_moves_as_it_is_told(
    monkeypatch: Patch, tmp_path: Path
) -> None:
    world = ArmWorld(monkeypatch, tmp_path)
    bus, retracts, speeds = ran(world)
    assert not retracts and [e.kind for e in bus.of("rig.event")] == ["enabled"]
    assert all(speed == 0.0 for tick, speed in speeds if tick < 0)
    assert max(speed for _, speed in speeds) == pytest.approx(0.05)
    ticks = [r.tick for r in bus.of("rig.arm")]
    assert {b - a for a, b in pairwise(ticks)} <= {15, 16, 17}
    assert world.arm.counters.refused == 0 and world.arm.counters.setpoints > 200


@pytest.mark.parametrize("drift", [-0.1, 0.1])
def test_an_arm_keeps_to_the_ticks_of_a_head_whose_clock_is_far_off(
    drift: float, monkeypatch: Patch, tmp_path: Path
) -> None:
    world = ArmWorld(monkeypatch, tmp_path)
    world.drift = drift
    bus, retracts, _ = ran(world)
    assert not retracts and world.arm.counters.refused == 0
    ticks = [r.tick for r in bus.of("rig.arm")]
    cycle = 16 / (1 + drift)
    assert all(abs(b - a - cycle) <= 2 for a, b in pairwise(ticks))
    assert ticks[-1] == pytest.approx(len(ticks) * cycle, abs=3 * cycle)


STOPPING: dict[str, tuple[Callable[[ArmWorld], object], str, int]] = {
    "a stall": (
        lambda w: setattr(w.arm, "mute", True),
        f"no state, so no set-point for {ARM.stale_setpoint_ticks} ticks",
        ARM.stale_setpoint_ticks,
    ),
    "a reboot of the controller": (
        lambda w: w.arm.reboot(),
        f"no state, so no set-point for {ARM.stale_setpoint_ticks} ticks",
        ARM.stale_setpoint_ticks,
    ),
    "no set-points": (
        lambda w: setattr(w, "guiding", False),
        f"no set-point for {ARM.stale_setpoint_ticks} ticks",
        ARM.stale_setpoint_ticks,
    ),
    "no news of the head": (
        lambda w: setattr(w, "news", False),
        f"no news of the head for {ARM.blind_ticks} ticks",
        ARM.blind_ticks,
    ),
    "a protective stop": (
        lambda w: setattr(w.arm, "safety", Safety.PROTECTIVE_STOP),
        "protective stop",
        0,
    ),
    "an emergency stop": (
        lambda w: setattr(w.arm, "safety", Safety.EMERGENCY_STOP),
        "emergency stop",
        0,
    ),
    "a set-point too far": (
        lambda w: setattr(w, "goal", (w.goal[0] + 0.1, *w.goal[1:])),
        "speed: expected at most 0.5 m/s",
        0,
    ),
}


@pytest.mark.parametrize("fault", STOPPING)
def test_what_stops_the_arm_does_so_after_the_stated_ticks_and_for_good(
    fault: str, monkeypatch: Patch, tmp_path: Path
) -> None:
    order, cause, after = STOPPING[fault]
    world = ArmWorld(monkeypatch, tmp_path)
    world.orders[AT] = lambda: order(world)
    world.orders[AT + 2000] = lambda: (
        setattr(world.arm, "mute", False),
        setattr(world.arm, "safety", Safety.NORMAL),
        setattr(world, "guiding", True),
    )
    _, (retract,), speeds = ran(world)
    assert cause in retract.cause
    cycle, braking = 16, 100  # ticks; the latter from 0.05 m/s at 2 m/s^2, rounded up
    moving = [tick for tick, speed in speeds if speed > 0.0]
    held = 0 if "set-point" in cause and after else after  # without set-points it holds at once
    assert AT < moving[-1] <= AT + held + 2 * cycle + braking


@pytest.mark.parametrize(("key", "least"), [("state_ticks", 40), ("setpoint_ticks", 50)])
def test_the_files_limits_of_the_arm_count(
    key: str, least: int, monkeypatch: Patch, tmp_path: Path
) -> None:
    world = ArmWorld(monkeypatch, tmp_path, f"{key} = {least}")
    world.orders[AT] = lambda: setattr(world.arm, "mute", True)
    _, (retract,), _ = ran(world)
    assert f"for {least} ticks" in retract.cause
    assert world.arm.limits.watchdog == pytest.approx(
        1600 / (least if key == "setpoint_ticks" else ARM.stale_setpoint_ticks)
    )


def test_the_files_patience_with_the_heads_news_counts(monkeypatch: Patch, tmp_path: Path) -> None:
    world = ArmWorld(monkeypatch, tmp_path, "news_ticks = 220")
    world.orders[AT] = lambda: setattr(world, "news", False)
    _, (retract,), _ = ran(world)
    assert retract.cause == "no news of the head for 220 ticks"


def test_a_stop_that_is_said_while_the_arm_is_enabled_wins(
    monkeypatch: Patch, tmp_path: Path
) -> None:
    world = ArmWorld(monkeypatch, tmp_path)

    def start_motion() -> None:
        """Takes long, as an upload does; meanwhile set-points and then a stop are said."""
        world.clock.sleep(0.2)
        for k in range(3):
            far = np.array([world.goal[0] + 0.001 * k, *world.goal[1:]])
            world.bus.tell("arm.setpoint", "arm", ArmSetpoint(400 + 16 * k, far))
        world.bus.tell("rig.event", "head-device", Event(400, "retract", "head-device", "silent"))

    world.guiding = False
    world.orders[-100] = lambda: setattr(world.arm, "_start_motion", start_motion)
    bus, retracts, speeds = ran(world)
    assert not retracts and not bus.events("enabled")
    assert world.arm.counters.setpoints == 0
    assert all(speed == 0.0 for _, speed in speeds)


def test_states_that_waited_while_the_arm_was_enabled_are_not_answered(
    monkeypatch: Patch, tmp_path: Path
) -> None:
    world = ArmWorld(monkeypatch, tmp_path)
    world.orders[-100] = lambda: setattr(world.arm, "_start_motion", lambda: world.clock.sleep(0.2))
    said_at: list[int] = []
    publish = world.bus.publish

    def noting(frame: bytes) -> None:
        publish(frame)
        if world.bus.said[-1].topic == "rig.arm":
            said_at.append(world.bus.tick)

    monkeypatch.setattr(world.bus, "publish", noting)
    bus, retracts, _ = ran(world)
    assert not retracts and bus.events("enabled")
    assert said_at[0] >= 400 and all(b - a >= 15 for a, b in pairwise(said_at))


def test_a_retract_of_the_heads_process_stops_the_arm_and_later_set_points_are_ignored(
    monkeypatch: Patch, tmp_path: Path
) -> None:
    world = ArmWorld(monkeypatch, tmp_path)
    cause = Event(AT, "retract", "head-device", "no sample for 300 ticks")
    world.orders[AT] = lambda: world.bus.tell("rig.event", "head-device", cause)
    _, retracts, speeds = ran(world)
    assert not retracts, "it was decided already"
    moving = [tick for tick, speed in speeds if speed > 0.0]
    assert AT < moving[-1] <= AT + 2 * 16 + 100
