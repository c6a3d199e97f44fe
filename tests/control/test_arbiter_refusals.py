"""What the arbiter refuses, by name and value; whom it knows, and what it tells of them."""

import numpy as np
import pytest

from tests.control.swapping import (
    FRESH,
    NEW,
    OLD,
    OTHER,
    START,
    angles,
    ready,
    refused,
    run,
    stale,
    swapped,
)
from vibrissa.control.arbiter import RETRACT, Arbiter, Armed, ControllerId, Decision
from vibrissa.control.kinematics import WHISKERS
from vibrissa.control.shadow import LAPSE


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


def silent(ticks: int = LAPSE + 1) -> Arbiter:
    a = ready()
    run(a, ticks, each={OLD: START})
    return a


def patchy() -> Arbiter:
    a = silent()
    run(a, 3, each={OLD: START, NEW: START})
    return a


def few(fresh: int) -> str:
    return f"{fresh} fresh answers to {FRESH} samples, expected {FRESH - 1}"


def failed() -> Arbiter:
    a = ready()
    a.on_failure(NEW, "exit 1")
    return a


def armed(controller: ControllerId) -> Arbiter:
    a = ready()
    a.register(OTHER)
    assert a.request(NEW, a.tick, at=100).kind == "armed"
    return a


def long_dead() -> Arbiter:
    a = failed()
    run(a, 2 * LAPSE, each={OLD: START})
    return a


def stopped() -> Arbiter:
    a = ready()
    a.route(RETRACT)
    return a


def fallen_and_stopped() -> Arbiter:
    a = ready()
    run(a, 1, each={OLD: np.nan, NEW: START})
    a.route(OLD)
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
        (fallen_and_stopped, NEW, {}, "retracting: by order, no controller has the drives"),
        (
            lambda: violating(np.nan, 3),
            NEW,
            {},
            "not finite: whisker 0 (front ring) commanded to nan rad, expected in [0, 0.876298], "
            f"at tick 10, since then {few(3)}",
        ),
        (
            lambda: violating(-0.5, 0),
            NEW,
            {},
            "out of range: whisker 0 (front ring) commanded to -0.5 rad, expected in "
            f"[0, 0.876298], at tick 10, since then {few(0)}",
        ),
        (
            wrong_length,
            NEW,
            {},
            "wrong length: command of shape (17,), expected (18,), at tick 10, "
            f"since then {few(0)}",
        ),
        (silent, NEW, {}, stale(9)),
        (lambda: silent(3), NEW, {}, f"not ready: {few(8)}"),
        (patchy, NEW, {}, f"not ready: {few(3)}"),
        (long_dead, NEW, {}, f"not ready: {few(0)}"),
        (failed, NEW, {}, f"not ready: {few(0)}"),
        (lambda: ready(ticks=FRESH - 2), NEW, {}, f"not ready: {few(8)}"),
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
    assert violating(np.inf, FRESH - 2).request(NEW, 18).kind == "refused"
    assert violating(np.inf, LAPSE).request(NEW, 20).kind == "refused"
    assert violating(np.inf, LAPSE + 1).request(NEW, 21).kind == "armed"


def test_one_late_answer_in_ten_is_tolerated_of_a_newcomer() -> None:
    a = ready(ticks=4)
    run(a, 1, each={OLD: START})
    run(a, 5, each={OLD: START, NEW: START})
    assert a.request(NEW, a.tick).kind == "armed"
    b = ready(ticks=4)
    run(b, 2, each={OLD: START})
    run(b, 5, each={OLD: START, NEW: START})
    assert refused(b.request(NEW, b.tick)) == f"not ready: {few(8)}"


def test_a_fallen_controller_has_to_prove_itself_again() -> None:
    a = ready()
    run(a, 1, each={OLD: np.nan, NEW: START})
    assert refused(a.request(OLD, a.tick)).startswith("not finite: whisker 0")
    run(a, LAPSE + 1, each={OLD: START - 0.03, NEW: START})
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
    assert refused(a.request(NEW, a.tick)) == f"not ready: {few(0)}"


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
    assert a.on_command(RETRACT, a.tick, angles(0.0)) == (None, ())
    a.route(NEW)
    assert len(a.on_command(RETRACT, a.tick, angles(0.0)).decisions) == 1
    a.forget(OLD)
    assert len(a.on_command(RETRACT, a.tick, angles(0.0)).decisions) == 1


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
