"""Swapping controllers: shadow, armed, switched at a tick, rolled back; every refusal by name."""

import numpy as np
import pytest
from numpy.typing import NDArray

from vibrissa.control.arbiter import (
    RETRACT,
    Arbiter,
    Armed,
    ControllerId,
    Decision,
    Routing,
)
from vibrissa.control.kinematics import WHISKERS, paper_head

TRAVEL = paper_head().swing
SLEW, MISSES, FRESH = 0.005, 4, 10
OLD, NEW, OTHER = ControllerId("old"), ControllerId("new"), ControllerId("other", 2)
START = 0.3


def angles(value: float) -> NDArray[np.float32]:
    return np.full(WHISKERS, value, dtype=np.float32)


def run(
    a: Arbiter, ticks: int, *, each: dict[ControllerId, float], after: int | None = None
) -> list[Routing]:
    """Open `ticks` ticks; every controller of `each` answers all of them with its angle, in order.

    Returns what came of the samples and of the commands that were routed.
    """
    first = a.tick + 1 if after is None else after
    routings = []
    for tick in range(first, first + ticks):
        routings.append(a.on_sample(tick))
        for controller, angle in each.items():
            routings.append(a.on_command(controller, tick, angles(angle)))
    return [r for r in routings if r.command is not None or r.decisions]


def ready(*, new: float = START, ticks: int = FRESH) -> Arbiter:
    """OLD has the drives at START, NEW answered `ticks` ticks in shadow; the tick is ticks - 1."""
    a = Arbiter(TRAVEL, slew_limit=SLEW, max_misses=MISSES, fresh_ticks=FRESH, last_command=START)
    a.register(OLD)
    a.register(NEW)
    a.route(OLD)
    run(a, ticks, each={OLD: START, NEW: new})
    return a


def refused(decision: Decision) -> str:
    assert decision.kind == "refused"
    assert "\n" not in decision.cause
    return decision.cause


def kinds(routings: list[Routing]) -> list[str]:
    return [d.kind for r in routings for d in r.decisions]


def swapped(blend_ticks: int = 0) -> Arbiter:
    """NEW has just got the drives, in the sample of the current tick; OLD has answered that."""
    a = ready()
    assert a.request(NEW, a.tick, blend_ticks=blend_ticks).kind == "armed"
    run(a, 1, each={OLD: START, NEW: START})
    assert kinds(run(a, 1, each={OLD: START})) == ["switched"]
    return a


# the protocol


def test_a_shadow_is_noted_and_never_routed() -> None:
    a = ready()
    assert a.on_sample(FRESH) == (None, ())
    for age in (0, 0, 1, 500, -3):
        assert a.on_command(NEW, FRESH - age, angles(0.31)) == (None, ())
    assert a.on_command(NEW, FRESH, angles(np.nan)) == (None, ())
    assert a.on_command(NEW, FRESH, angles(0.3)[:4]) == (None, ())
    assert np.array_equal(a.last_command, angles(START))
    assert a.active == OLD
    status = a.owners().shadows[NEW]
    assert (status.on_time, status.late, status.unasked) == (FRESH + 1, 2, 4)
    assert (status.fresh_ticks, status.last_tick, status.violations) == (FRESH + 1, FRESH, 0)
    assert np.array_equal(status.command, angles(0.31))


def test_the_newcomer_answers_from_its_tick_on_and_no_tick_is_missed() -> None:
    a = ready()
    now = a.tick
    assert a.request(NEW, now) == Decision(
        now, "armed", NEW, f"at tick {now + 2}, after old#0, blended over 0 ticks"
    )
    assert a.owners().armed == (NEW, now + 2, 0)
    before = run(a, 1, each={OLD: 0.301, NEW: 0.302})
    assert [r.command is not None for r in before] == [True]
    assert a.last_command == pytest.approx(0.301)
    at, command = run(a, 1, each={OLD: 0.301, NEW: 0.302})
    assert at == (None, (Decision(now + 2, "switched", NEW, "after old#0"),))
    assert command.command == pytest.approx(0.302)
    assert (a.active, a.previous, a.armed, a.misses) == (NEW, OLD, None, 0)
    after = run(a, 5, each={OLD: 0.301, NEW: 0.303})
    assert [r.command is not None for r in after] == [True] * 5
    assert a.last_command == pytest.approx(0.303)


def test_a_switch_waits_for_its_tick_or_the_first_sample_after_it() -> None:
    a = ready()
    assert a.request(NEW, a.tick, at=a.tick + 7).kind == "armed"
    assert "switched" not in kinds(run(a, 6, each={OLD: START, NEW: START}))
    assert kinds(run(a, 1, each={OLD: START, NEW: START})) == ["switched"]
    b = ready()
    b.request(NEW, b.tick, at=b.tick + 7)
    assert kinds(run(b, 1, each={}, after=b.tick + 100)) == ["switched"]


def test_either_order_of_arrival_makes_a_controller_ready() -> None:
    a = ready(ticks=1)
    run(a, FRESH - 1, each={NEW: START, OLD: START})
    assert a.request(NEW, a.tick).kind == "armed"


def test_commands_may_be_read_only_or_of_another_precision() -> None:
    a = ready()
    a.on_sample(FRESH)
    command = np.full(WHISKERS, 0.302)
    command.flags.writeable = False
    assert a.on_command(NEW, FRESH, command) == (None, ())
    assert a.owners().shadows[NEW].command == pytest.approx(0.302)


def test_a_newcomer_that_goes_stale_before_its_tick_is_refused_then_and_the_old_one_stays() -> None:
    a = ready()
    a.request(NEW, a.tick, at=a.tick + 3)
    run(a, 1, each={OLD: START, NEW: START})
    run(a, 1, each={OLD: START})
    (at, command) = run(a, 1, each={OLD: START, NEW: START})
    cause = f"went stale before its tick: stale: last fresh answer to tick {FRESH}"
    assert at == (None, (Decision(FRESH + 2, "refused", NEW, cause),))
    assert command.command is not None
    assert (a.active, a.previous, a.armed) == (OLD, None, None)


def test_a_newcomer_that_goes_wrong_before_its_tick_is_refused_then() -> None:
    a = ready()
    a.request(NEW, a.tick)
    run(a, 1, each={OLD: START, NEW: np.nan})
    (at,) = run(a, 1, each={})
    assert refused(at.decisions[0]).startswith("went stale before its tick: not finite: whisker 0")
    b = ready()
    b.request(NEW, b.tick)
    run(b, 1, each={OLD: START, NEW: 0.1})
    (at,) = run(b, 1, each={})
    assert refused(at.decisions[0]).startswith("jump too large: whisker 0 (front ring) 0.2 rad")
    assert b.active == OLD


def test_a_newcomer_that_dies_before_its_tick_is_off() -> None:
    a = ready()
    a.request(NEW, a.tick)
    routing = a.on_failure(NEW, "process exited with 1")
    assert routing.command is None
    assert refused(routing.decisions[0]) == "died before its tick: process exited with 1"
    assert a.armed is None
    assert kinds(run(a, 3, each={OLD: START})) == []
    assert a.active == OLD
    assert a.on_failure(NEW, "once more") == (None, ())


def test_a_newcomer_that_never_answers_ends_in_retract_not_with_the_old_one() -> None:
    a = swapped()
    routings = run(a, MISSES, each={OLD: START})
    assert kinds(routings) == ["fallback"]
    assert routings[-1].decisions[0] == Decision(
        a.tick, "fallback", NEW, f"no command for {MISSES} ticks"
    )
    assert routings[-1].command is not None
    assert a.active == RETRACT


def test_a_switch_due_in_the_tick_of_a_fallback_goes_first() -> None:
    a = ready()
    a.request(NEW, a.tick, at=a.tick + MISSES + 1)
    assert kinds(run(a, MISSES + 1, each={NEW: START})) == ["switched"]
    assert a.last_command == pytest.approx(START)


def test_an_armed_switch_outlives_a_fallback() -> None:
    a = ready()
    a.request(NEW, a.tick, at=a.tick + 4)
    run(a, 1, each={OLD: np.nan, NEW: START})
    assert a.active == RETRACT
    routings = run(a, 3, each={NEW: START})
    assert kinds(routings) == ["switched"]
    assert [r.command is not None for r in routings] == [True, True, False, True]
    assert (a.active, a.previous) == (NEW, None)


def test_an_order_to_retract_beats_an_armed_switch() -> None:
    a = ready()
    a.request(NEW, a.tick)
    a.route(RETRACT)
    run(a, 1, each={NEW: START})
    (at,) = run(a, 1, each={NEW: START})
    assert refused(at.decisions[0]) == "retracting: by order, no controller has the drives"
    assert at.command is not None
    assert a.active == RETRACT


def test_a_blend_is_linear_from_the_last_command_to_the_newcomers() -> None:
    a = ready(new=0.31)
    assert a.request(NEW, a.tick, blend_ticks=5).kind == "armed"
    run(a, 1, each={OLD: START, NEW: 0.31})
    routed = []
    for _ in range(7):
        routed.append(run(a, 1, each={OLD: START, NEW: 0.31})[-1].command)
    expected = [START + 0.01 * min(k / 5, 1.0) for k in range(1, 8)]
    assert [float(c[3]) for c in routed if c is not None] == pytest.approx(expected, abs=1e-7)
    assert np.array_equal(a.last_command, angles(0.31))


def test_a_blend_goes_on_while_ticks_are_held_and_ends_with_its_owner() -> None:
    a = ready(new=0.305)
    a.request(NEW, a.tick, blend_ticks=5)
    run(a, 1, each={OLD: START, NEW: 0.305})
    run(a, 2, each={OLD: START})
    run(a, 1, each={NEW: 0.305})
    assert a.last_command == pytest.approx(START + 0.005 * 3 / 5, abs=1e-7)
    a.route(OLD)
    run(a, 1, each={OLD: START + 0.002})
    assert a.last_command == pytest.approx(START + 0.002, abs=1e-7)


def test_the_slew_limit_holds_across_a_switch_with_and_without_blend() -> None:
    for blend_ticks, most in ((0, MISSES), (20, 20)):
        a = ready(new=START + 0.9 * most * SLEW)
        assert a.request(NEW, a.tick, blend_ticks=blend_ticks).kind == "armed"
        held = a.last_command.astype(np.float64)
        for _ in range(50):
            each = {OLD: START, NEW: START + 0.9 * most * SLEW}
            for routing in run(a, 1, each=each):
                if routing.command is not None:
                    assert np.abs(routing.command - held).max() <= SLEW + 3e-8
                    held = routing.command.astype(np.float64)
        assert a.active == NEW
        assert a.last_command == pytest.approx(START + 0.9 * most * SLEW)


# rollback


def test_rollback_needs_no_waiting_because_the_old_one_kept_answering() -> None:
    a = swapped()
    assert a.rollback(a.tick).kind == "armed"
    run(a, 2, each={NEW: START, OLD: START})
    assert (a.active, a.previous) == (OLD, NEW)
    assert a.rollback(a.tick).controller == NEW


def test_rollback_after_a_fallback_goes_to_the_one_before() -> None:
    a = swapped()
    run(a, 1, each={NEW: 5.0, OLD: START})
    assert a.active == RETRACT
    assert a.rollback(a.tick).kind == "armed"
    run(a, 2, each={OLD: START})
    assert (a.active, a.previous) == (OLD, None)


def test_rollback_refuses_by_name() -> None:
    assert refused(ready().rollback(9)) == "no previous owner: nothing was switched"
    a = swapped()
    run(a, 2, each={NEW: START})
    assert refused(a.rollback(a.tick)) == f"stale: last fresh answer to tick {FRESH + 1}"
    a.forget(OLD)
    assert refused(a.rollback(a.tick)) == "unknown: not registered"


# refusals


def violating(value: float, ticks: int) -> Arbiter:
    a = ready()
    run(a, 1, each={OLD: START, NEW: value})
    run(a, ticks, each={OLD: START, NEW: START})
    return a


def wrong_length() -> Arbiter:
    a = ready()
    a.on_sample(FRESH)
    a.on_command(NEW, FRESH, angles(START)[:17])
    return a


def silent() -> Arbiter:
    a = ready()
    run(a, 2, each={OLD: START})
    return a


def patchy() -> Arbiter:
    a = silent()
    run(a, 3, each={OLD: START, NEW: START})
    return a


def failed() -> Arbiter:
    a = ready()
    a.on_failure(NEW, "exit 1")
    return a


def armed(controller: ControllerId) -> Arbiter:
    a = ready()
    a.register(OTHER)
    assert a.request(NEW, a.tick, at=100).kind == "armed"
    return a


def stopped() -> Arbiter:
    a = ready()
    a.route(RETRACT)
    return a


@pytest.mark.parametrize(
    ("made", "controller", "options", "cause"),
    [
        (ready, RETRACT, {}, "built in: takes over by a fault or by order, not by a swap"),
        (ready, OTHER, {}, "unknown: not registered"),
        (ready, ControllerId("new", 1), {}, "unknown: not registered"),
        (lambda: armed(NEW), OTHER, {}, "already switching: to new#0 at tick 100"),
        (lambda: armed(NEW), NEW, {}, "already switching: to new#0 at tick 100"),
        (ready, NEW, {"at": 9}, "in the past: tick 9 in tick 9"),
        (ready, NEW, {"blend_ticks": -1}, "blend: -1 ticks, expected 0 to 2000"),
        (ready, NEW, {"blend_ticks": 2001}, "blend: 2001 ticks, expected 0 to 2000"),
        (ready, OLD, {}, "active already: it has the drives"),
        (stopped, NEW, {}, "retracting: by order, no controller has the drives"),
        (
            lambda: violating(np.nan, 3),
            NEW,
            {},
            "not finite: whisker 0 (front ring) commanded to nan rad, expected in [0, 0.876298], "
            "at tick 10, 3 fresh answers since, expected 10",
        ),
        (
            lambda: violating(-0.5, 0),
            NEW,
            {},
            "out of range: whisker 0 (front ring) commanded to -0.5 rad, expected in "
            "[0, 0.876298], at tick 10, 0 fresh answers since, expected 10",
        ),
        (
            wrong_length,
            NEW,
            {},
            "wrong length: command of shape (17,), expected (18,), at tick 10, "
            "0 fresh answers since, expected 10",
        ),
        (silent, NEW, {}, "stale: last fresh answer to tick 9"),
        (patchy, NEW, {}, "not ready: 3 fresh answers in a row, expected 10"),
        (failed, NEW, {}, "not ready: 0 fresh answers in a row, expected 10"),
        (
            lambda: ready(ticks=FRESH - 1),
            NEW,
            {},
            "not ready: 9 fresh answers in a row, expected 10",
        ),
        (
            lambda: ready(new=0.33),
            NEW,
            {},
            "jump too large: whisker 0 (front ring) 0.03 rad from the last command, "
            "expected at most 0.02",
        ),
        (
            lambda: ready(new=0.33),
            NEW,
            {"blend_ticks": 5},
            "jump too large: whisker 0 (front ring) 0.03 rad from the last command, "
            "expected at most 0.025",
        ),
    ],
)
def test_a_request_is_refused_by_name_and_value(made, controller, options, cause) -> None:  # type: ignore[no-untyped-def]
    a = made()
    before = (a.active, a.previous, a.armed, a.misses, a.tick)
    assert a.request(controller, a.tick, **options) == Decision(
        a.tick, "refused", controller, cause
    )
    assert (a.active, a.previous, a.armed, a.misses, a.tick) == before


def test_what_the_slew_limit_or_the_blend_covers_is_no_jump() -> None:
    assert ready(new=0.3199).request(NEW, 9).kind == "armed"
    assert ready(new=0.3299).request(NEW, 9, blend_ticks=6).kind == "armed"


def test_a_violation_is_forgiven_after_as_many_fresh_answers_as_a_newcomer_needs() -> None:
    assert violating(np.inf, FRESH - 1).request(NEW, 19).kind == "refused"
    assert violating(np.inf, FRESH).request(NEW, 20).kind == "armed"


def test_a_fallen_controller_has_to_prove_itself_again() -> None:
    a = ready()
    run(a, 1, each={OLD: np.nan, NEW: START})
    assert refused(a.request(OLD, a.tick)).startswith("not finite: whisker 0")
    run(a, FRESH, each={OLD: START - 0.03, NEW: START})
    assert a.request(OLD, a.tick).kind == "armed"
    run(a, 2, each={OLD: START - 0.03})
    assert a.active == OLD


# the register


def test_the_register_refuses_by_name() -> None:
    a = ready()
    assert refused(a.register(NEW)) == "registered already"
    assert refused(a.forget(OLD)) == "active: it has the drives"
    assert refused(a.forget(OTHER)) == "unknown: not registered"
    a.request(NEW, a.tick, at=100)
    assert refused(a.forget(NEW)) == "armed: takes over at tick 100"
    for i in range(6):
        assert a.register(ControllerId(f"c{i}")).kind == "registered"
    assert refused(a.register(OTHER)) == "full: 8 controllers are registered, forget one first"
    assert a.forget(ControllerId("c0")) == Decision(
        a.tick, "forgotten", ControllerId("c0"), "no longer registered"
    )
    assert a.register(OTHER) == Decision(a.tick, "registered", OTHER, "in shadow")
    assert list(a.owners().shadows) == [
        OLD,
        NEW,
        *(ControllerId(f"c{i}") for i in range(1, 6)),
        OTHER,
    ]


def test_a_forgotten_controller_starts_anew_when_registered_again() -> None:
    a = ready()
    a.forget(NEW)
    a.register(NEW)
    assert refused(a.request(NEW, a.tick)).startswith("not ready: 0 fresh answers")


def test_floods_of_strangers_are_a_handful_of_decisions() -> None:
    a = ready()
    strangers = [ControllerId("new", epoch) for epoch in range(1, 21)] + [RETRACT]
    routings = [a.on_command(s, a.tick, angles(0.0)) for _ in range(50) for s in strangers]
    assert sum(len(r.decisions) for r in routings) == 8
    assert all(r.command is None for r in routings)
    assert a.owners().strangers == 50 * 21
    a.register(OTHER)
    routing = a.on_command(RETRACT, a.tick, angles(0.0))
    assert refused(routing.decisions[0]) == "built in, takes no commands from outside"


# figures


@pytest.mark.parametrize("order", [(OLD, NEW), (NEW, OLD)])
def test_divergence_compares_answers_to_the_same_sample(
    order: tuple[ControllerId, ControllerId],
) -> None:
    a = ready(ticks=1)
    gap = np.zeros(WHISKERS)
    gap[4] = 0.018
    for tick in range(1, 12):
        a.on_sample(tick)
        wanted = START + 0.004 * tick  # every tick elsewhere: an earlier answer would not match
        for controller in order:
            own = wanted - gap * (tick % 2) if controller == NEW else wanted + 0.0 * gap
            a.on_command(controller, tick, own.astype(np.float32))
    status = a.owners().shadows[NEW]
    assert status.compared == 11  # ticks 0 to 10: those of which every answer is known
    assert status.divergence_max == pytest.approx(0.018, abs=1e-6)
    assert status.divergence_mean == pytest.approx(5 * 0.018 / WHISKERS / 11, abs=1e-6)


def test_divergence_starts_anew_with_the_stretch_and_with_the_owner() -> None:
    a = ready(new=0.31)
    assert a.owners().shadows[NEW].compared == FRESH - 1
    run(a, 1, each={OLD: START})
    run(a, 3, each={OLD: START, NEW: 0.302})
    status = a.owners().shadows[NEW]
    assert status.compared == 2
    assert status.divergence_max == pytest.approx(0.002, abs=1e-6)
    a.route(RETRACT)
    assert a.owners().shadows[NEW].compared == 0


def test_a_tick_the_active_controller_missed_is_not_compared() -> None:
    a = ready()
    run(a, 1, each={NEW: 0.3})
    run(a, 2, each={OLD: START, NEW: START})
    assert a.owners().shadows[NEW].compared == FRESH - 1 + 2


def test_the_snapshot_tells_who_has_had_and_will_have_the_drives() -> None:
    a = swapped()
    a.register(OTHER)
    run(a, 1, each={NEW: START, OLD: START})
    a.rollback(a.tick)
    owners = a.owners()
    assert (owners.tick, owners.active, owners.previous) == (a.tick, NEW, OLD)
    assert owners.armed == Armed(OLD, a.tick + 2, 0)
    assert [s.fresh_ticks for s in owners.shadows.values()] == [
        13,
        1,
        0,
    ]  # NEW missed its first tick
    run(a, 2, each={})
    assert owners.shadows[OLD].fresh_ticks == 13  # a copy
    assert a.owners().shadows[OLD].fresh_ticks == 0
