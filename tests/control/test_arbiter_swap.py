"""Swapping controllers: shadow, armed, switched at a tick, blended in, rolled back."""

import numpy as np
import pytest

from tests.control.swapping import (
    FRESH,
    MISSES,
    NEW,
    OLD,
    SLEW,
    START,
    angles,
    kinds,
    ready,
    refused,
    run,
    stale,
    swapped,
)
from vibrissa.control.arbiter import RETRACT, Decision
from vibrissa.control.kinematics import WHISKERS
from vibrissa.control.shadow import LAPSE


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
    a.request(NEW, a.tick, at=a.tick + LAPSE + 2)
    run(a, 1, each={OLD: START, NEW: START})
    run(a, LAPSE, each={OLD: START})
    (at, command) = run(a, 1, each={OLD: START, NEW: START})
    cause = f"went stale before its tick: {stale(FRESH)}"
    assert at == (None, (Decision(FRESH + LAPSE + 1, "refused", NEW, cause),))
    assert command.command is not None
    assert (a.active, a.previous, a.armed) == (OLD, None, None)


def test_a_few_late_answers_of_an_armed_newcomer_do_not_stop_its_switch() -> None:
    a = ready()
    a.request(NEW, a.tick, at=a.tick + LAPSE + 2)
    run(a, 1, each={OLD: START})
    run(a, 1, each={OLD: START, NEW: START})
    run(a, LAPSE - 1, each={OLD: START})
    assert kinds(run(a, 1, each={OLD: START, NEW: START})) == ["switched"]


def test_an_armed_newcomer_that_sent_what_no_drive_may_get_is_refused_for_a_while() -> None:
    for since, expected in ((LAPSE - 1, "refused"), (LAPSE, "switched")):
        a = ready()
        a.request(NEW, a.tick, at=a.tick + 2 + since)
        run(a, 1, each={OLD: START, NEW: np.nan})
        routings = run(a, since + 1, each={OLD: START, NEW: START})
        assert kinds(routings) == [expected]


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


def test_an_answer_that_comes_after_retracts_own_still_counts_as_fresh() -> None:
    a = ready()
    a.route(RETRACT)
    a.on_sample(FRESH)
    a.route(NEW)
    (decision,) = a.on_command(NEW, FRESH, angles(START)).decisions
    assert refused(decision) == f"tick {FRESH} is answered already"
    assert a.owners().shadows[NEW].fresh_ticks == FRESH + 1


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
    run(a, LAPSE + 1, each={NEW: START})
    assert refused(a.rollback(a.tick)) == stale(FRESH + 1)
    a.forget(OLD)
    assert refused(a.rollback(a.tick)) == "unknown: not registered"
