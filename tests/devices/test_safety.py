"""Nothing moves before the start, a stop always wins, silence stops: any order of events (walked
by a model), on a clock that the test turns."""

from __future__ import annotations

import math

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)

from tests.devices.stepped import TICK_NS, HandClock, MutableArm
from vibrissa.rig.devices.arm import Safety, State
from vibrissa.rig.devices.errors import DeviceLimit, DeviceLost, DeviceStopped
from vibrissa.rig.devices.limits import ARM, HEAD
from vibrissa.rig.devices.watch import Phase, Watch
from vibrissa.rig.plant import ARM_SECONDS

START = (0.63, 0.09, 0.177, 0.0)
BRAKING_TICKS = math.ceil(ARM.speed / ARM.acceleration * 2000) + 16
"""From the highest speed to rest, and the period in which the stop comes."""
STRIDE_MORE = 0.9 * ARM.acceleration * ARM_SECONDS**2
FULL_STRIDE = 5 * STRIDE_MORE
"""m per period: set-points gather speed within the limits."""


class Safely(RuleBasedStateMachine):
    """An arm with the watch of its process, as `arm_device` joins them, under any events."""

    def __init__(self) -> None:
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.clock = HandClock()
        self.clock.put_into(self.patch)
        self.watch = Watch({"news of the head": ARM.blind_ticks})
        self.arm = MutableArm(START)
        self.goal = list(START)
        self.stride = 0.0
        self.halted_at: int | None = None
        self.lost = False
        self.tick = 0

    def teardown(self) -> None:
        self.patch.undo()

    @initialize()
    def open(self) -> None:
        self.arm.open()

    @property
    def now(self) -> int:
        return self.clock.ns // TICK_NS

    def stopped(self, cause: str) -> None:
        self.watch.stop(cause)
        self.arm.stop(cause)

    @rule(periods=st.integers(1, 40), head=st.booleans(), onward=st.booleans())
    def live(self, periods: int, head: bool, onward: bool) -> None:
        """Some arm cycles: states come, the head's news may, set-points may go on."""
        for _ in range(periods):
            if self.lost:
                return
            try:
                report = self.arm.read(0.008)
            except DeviceLost:
                self.lost = True
                self.stopped("lost")
                return
            if report is None:
                self.clock.ns += 1_000_000
            if head:
                self.watch.seen("news of the head", self.now)
            self.watch.look(self.now)
            self.look()
            if onward and self.watch.may_move:
                self.tick += 16
                self.arm.write(self.tick, (self.goal[0], *START[1:]))
                self.stride = min(self.stride + STRIDE_MORE, FULL_STRIDE)
                self.goal[0] = min(self.goal[0] + self.stride, 0.9)

    def look(self) -> None:
        """What the arm's process does once per turn."""
        if self.watch.phase is Phase.STOPPED:
            self.arm.stop(self.watch.cause)
        elif self.watch.may_move and self.arm.state is not State.MOVING:
            self.stopped(self.arm.cause)

    @rule()
    def start(self) -> None:
        """The operator's start."""
        if self.watch.phase is not Phase.WAITING:
            assert not self.watch.start(self.now) or self.watch.phase is Phase.RUNNING
            return
        try:
            self.arm.enable()
        except DeviceStopped:
            self.stopped("not enabled")
            return
        assert self.watch.start(self.now)
        self.goal = list(self.arm.report.pose)
        self.stride = 0.0
        self.tick = 0

    @rule()
    def stop(self) -> None:
        """Somebody stops; from here on nothing else counts."""
        self.stopped("a person")

    @rule(dx=st.sampled_from([0.1, -0.1, math.nan, 5.0]))
    def forbidden(self, dx: float) -> None:
        """A set-point that no arm may get."""
        before = self.arm.counters.setpoints
        try:
            sent = self.arm.write(self.tick + 16, (self.goal[0] + dx, *START[1:]))
            assert not sent
        except DeviceLimit:
            self.stopped("limit")
        assert self.arm.counters.setpoints == before

    @rule(safety=st.sampled_from([Safety.PROTECTIVE_STOP, Safety.EMERGENCY_STOP, Safety.NORMAL]))
    def controller(self, safety: Safety) -> None:
        """The controller stops by itself, or a person releases it."""
        self.arm.safety = safety

    @rule(mute=st.booleans())
    def silence(self, mute: bool) -> None:
        self.arm.mute = mute

    @precondition(lambda self: not self.lost)
    @rule(ticks=st.integers(1, 3 * ARM.stale_ticks))
    def nobody_calls(self, ticks: int) -> None:
        """The process that should look after the arm is held up: a tick overrun."""
        self.clock.ns += ticks * TICK_NS

    @invariant()
    def nothing_moves_unless_it_was_started(self) -> None:
        if self.watch.phase is Phase.WAITING:
            assert self.arm.state is not State.MOVING
            assert self.arm.counters.setpoints == 0

    @invariant()
    def a_stop_wins(self) -> None:
        if self.watch.phase is Phase.STOPPED:
            assert self.arm.state is not State.MOVING
            assert not self.watch.may_move
            sent = self.arm.counters.setpoints
            assert not self.arm.write(self.tick + 16, START)
            assert self.arm.counters.setpoints == sent

    @invariant()
    def a_stopped_arm_comes_to_rest(self) -> None:
        if self.arm.state is State.MOVING:
            self.halted_at = None
        elif self.halted_at is None:
            self.halted_at = self.arm._plant._tick
        elif self.arm._plant._tick - self.halted_at > BRAKING_TICKS:
            assert math.hypot(*self.arm._plant.velocity) == 0.0


TestSafely = Safely.TestCase
TestSafely.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)


@pytest.mark.parametrize(
    "limits", [{"sample": HEAD.silence_ticks, "command": HEAD.overrun_ticks}, {"a": 1, "b": 3}]
)
def test_whatever_is_overdue_stops_in_the_stated_number_of_ticks(limits: dict[str, int]) -> None:
    for late, limit in limits.items():
        watch = Watch(limits)
        for now in range(1000):  # nothing is due before the start
            assert not watch.look(now)
        assert watch.start(1000)
        for now in range(1000, 1001 + limit):
            for what in limits:
                if what != late:
                    watch.seen(what, now)
            assert not watch.look(now)
        assert watch.look(1001 + limit)
        assert watch.cause == f"no {late} for {limit} ticks"
        assert not watch.start(9999) and not watch.may_move and not watch.look(10**9)


def test_a_stop_before_the_start_is_a_stop() -> None:
    watch = Watch({})
    assert watch.stop("first") and not watch.stop("second")
    assert not watch.start(0) and watch.cause == "first"
