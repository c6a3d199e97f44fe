"""The arbiter: one controller has the drives, which get exactly one command per tick."""

import numpy as np
import pytest
from numpy.typing import NDArray

from vibrissa.control.arbiter import (
    RETRACT,
    Arbiter,
    ArbiterError,
    ControllerId,
    Decision,
    Routing,
)
from vibrissa.control.kinematics import WHISKERS, paper_head

TRAVEL = paper_head().swing
SLEW, MISSES = 0.005, 4
WHISK, OTHER = ControllerId("whisk", 1), ControllerId("other", 1)
HOME = np.zeros(WHISKERS, dtype=np.float32)


def arbiter(start: float = 0.0) -> Arbiter:
    made = Arbiter(TRAVEL, slew_limit=SLEW, max_misses=MISSES, last_command=start)
    made.register(WHISK)
    made.route(WHISK)
    return made


def angles(value: float) -> NDArray[np.float32]:
    return np.full(WHISKERS, value, dtype=np.float32)


def fallback(routing: Routing) -> Decision:
    (decision,) = routing.decisions
    assert decision.kind == "fallback"
    assert routing.command is not None
    return decision


def refusal(routing: Routing) -> str:
    assert routing.command is None
    (decision,) = routing.decisions
    assert decision.kind == "refused"
    return decision.cause


def test_the_active_controllers_command_is_routed_once_per_tick() -> None:
    a = arbiter()
    assert a.on_sample(7) == (None, ())
    command, decisions = a.on_command(WHISK, 7, angles(0.003))
    assert decisions == ()
    assert command is not None
    assert np.array_equal(command, angles(0.003))
    assert np.array_equal(a.last_command, angles(0.003))
    assert refusal(a.on_command(WHISK, 7, angles(0.004))) == "tick 7 is answered already"
    assert np.array_equal(a.last_command, angles(0.003))


def test_every_refusal_is_named_and_changes_nothing() -> None:
    a = arbiter()
    assert refusal(a.on_command(WHISK, 3, HOME)) == "early, answers tick 3 in tick -1"
    a.on_sample(5)
    unknown = "unknown, not registered while whisk#1 is active"
    assert refusal(a.on_command(OTHER, 5, angles(np.nan))) == unknown
    assert refusal(a.on_command(ControllerId("whisk", 2), 5, HOME)) == unknown
    assert refusal(a.on_command(WHISK, 4, HOME)) == "stale, answers tick 4 in tick 5"
    assert refusal(a.on_command(WHISK, 6, HOME)) == "early, answers tick 6 in tick 5"
    assert (a.active, a.misses) == (WHISK, 0)
    assert np.array_equal(a.last_command, HOME)


def test_nobody_commands_in_the_name_of_the_built_in_controller() -> None:
    a = arbiter()
    a.on_sample(0)
    a.route(RETRACT)
    for forged, bad in ((RETRACT, 0.001), (ControllerId("retract", 3), np.nan)):
        cause = refusal(a.on_command(forged, 0, angles(bad)))
        assert cause == "built in, takes no commands from outside"
        assert a.register(forged).kind == a.forget(forged).kind == "refused"
        assert a.request(forged, 0).kind == "refused"
    assert a.on_sample(1).command is not None


def test_a_jump_is_slew_limited() -> None:
    a = arbiter()
    for tick in range(3):
        a.on_sample(tick)
        command = a.on_command(WHISK, tick, angles(0.3)).command
        assert command is not None
        assert command == pytest.approx((tick + 1) * SLEW, abs=1e-6)


@pytest.mark.parametrize(
    ("bad", "cause"),
    [
        (np.nan, r"whisker 9 (mid ring) commanded to nan rad, expected in [0, 0.671"),
        (np.inf, r"whisker 9 (mid ring) commanded to inf rad, expected in [0, 0.671"),
        (-1e-6, r"whisker 9 (mid ring) commanded to -1e-06 rad, expected in [0, 0.671083]"),
        (0.68, r"whisker 9 (mid ring) commanded to 0.68"),
    ],
)
def test_a_command_no_drive_may_get_retracts_in_the_same_tick(bad: float, cause: str) -> None:
    a = arbiter(start=0.2)
    a.on_sample(11)
    command = angles(0.2)
    command[9] = bad
    routing = a.on_command(WHISK, 11, command)
    decision = fallback(routing)
    assert (decision.tick, decision.controller) == (11, WHISK)
    assert decision.cause.startswith(cause)
    assert "\n" not in str(decision)
    assert routing.command == pytest.approx(0.2 - 0.0025, abs=1e-6)
    assert a.active == RETRACT
    assert a.on_sample(12).command == pytest.approx(0.2 - 0.005, abs=1e-6)


def test_a_command_of_the_wrong_length_retracts_in_the_same_tick() -> None:
    a = arbiter()
    a.on_sample(0)
    assert fallback(a.on_command(WHISK, 0, HOME[:17])).cause == (
        "command of shape (17,), expected (18,)"
    )


def test_the_last_command_is_held_until_the_controller_has_missed_its_ticks() -> None:
    a = arbiter(start=0.1)
    a.on_sample(0)
    a.on_command(WHISK, 0, angles(0.1))
    for tick in range(1, MISSES + 1):
        assert a.on_sample(tick) == (None, ())
        assert np.array_equal(a.last_command, angles(0.1))
    decision = fallback(a.on_sample(MISSES + 1))
    assert decision == Decision(MISSES + 1, "fallback", WHISK, f"no command for {MISSES} ticks")
    assert (a.last_command < 0.1).all()


def test_one_answer_in_time_clears_the_misses() -> None:
    a = arbiter()
    for tick in range(20 * MISSES):
        assert a.on_sample(tick) == (None, ())
        if tick % MISSES == 0:
            assert a.on_command(WHISK, tick, HOME).command is not None
    assert a.active == WHISK


def test_a_dead_controller_is_replaced_at_once() -> None:
    a = arbiter(start=0.1)
    assert a.on_failure(OTHER, "exit 1") == (None, ())
    a.on_sample(4)
    assert fallback(a.on_failure(WHISK, "process exited with 1")).cause == "process exited with 1"
    b = arbiter(start=0.1)
    b.on_sample(4)
    b.on_command(WHISK, 4, angles(0.1))
    command, decisions = b.on_failure(WHISK, "process exited with 1")
    assert command is None  # tick 4 has its command; tick 5 is retract's
    assert [d.kind for d in decisions] == ["fallback"]
    assert b.on_sample(5).command == pytest.approx(0.1 - 0.0025, abs=1e-6)


def test_a_fallen_controller_stays_out_until_it_is_routed_again() -> None:
    a = arbiter(start=0.1)
    a.on_sample(0)
    a.on_command(WHISK, 0, angles(np.nan))
    for tick in range(1, 50):
        assert a.on_sample(tick).command is not None
        assert a.on_command(WHISK, tick, angles(0.1)) == (None, ())
    assert np.array_equal(a.last_command, HOME)
    assert a.route(WHISK) == Decision(49, "routed", WHISK, "after retract#0")
    assert a.on_sample(50) == (None, ())
    assert a.on_command(WHISK, 50, angles(0.001)).command is not None


def test_ticks_without_a_sample_are_nobodys_miss() -> None:
    a = arbiter()
    a.on_sample(0)
    a.on_command(WHISK, 0, HOME)
    assert a.on_sample(1000) == (None, ())
    assert a.misses == 0
    with pytest.raises(ArbiterError, match="sample of tick 1000 after tick 1000"):
        a.on_sample(1000)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"travel": -TRAVEL}, "travel: whisker 0 .* expected > 0"),
        ({"last_command": 2.0}, r"last_command: whisker 0 \(front ring\) is 2.0 rad"),
        ({"slew_limit": np.nan}, "slew_limit: nan rad per tick"),
        ({"retract_speed": 0.1}, r"retract_speed: 0.1 rad per tick, expected in \(0, 0.005\]"),
        ({"max_misses": 0}, "max_misses: 0, expected >= 1"),
        ({"fresh_ticks": 0}, "fresh_ticks: 0, expected >= 1"),
    ],
)
def test_impossible_limits_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ArbiterError, match=message):
        Arbiter(**({"travel": TRAVEL} | changes))


def test_nobody_gets_the_drives_who_is_not_registered() -> None:
    a = arbiter()
    with pytest.raises(ArbiterError, match="route: other#1 is not registered"):
        a.route(OTHER)
    assert a.active == WHISK
