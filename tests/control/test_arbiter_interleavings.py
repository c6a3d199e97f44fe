"""The arbiter under random interleavings of samples, commands, requests and failures."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.control.arbiter_world import (
    FORGED,
    FRESH,
    NEW,
    OLD,
    STRANGER,
    THIRD,
    Command,
    Event,
    Failure,
    Forget,
    Register,
    Request,
    Rollback,
    Route,
    Run,
    Sample,
    World,
    state,
)
from vibrissa.control.arbiter import RETRACT
from vibrissa.control.kinematics import WHISKERS

TRIO = st.sampled_from([OLD, NEW, THIRD])
IDS = st.one_of(TRIO, TRIO, TRIO, st.sampled_from([STRANGER, RETRACT, FORGED]))
OFFSETS = st.one_of(
    *[st.floats(-0.03125, 0.03125, width=32)] * 8,
    st.sampled_from([np.nan, -np.inf, -3.0, 3.0, 1e30]),
)
COMMANDS = st.builds(
    Command,
    IDS,
    st.sampled_from([0, 0, 0, 0, 1, 2, -1]),
    st.integers(0, WHISKERS - 1),
    OFFSETS,
    st.sampled_from([WHISKERS] * 9 + [0, 17]),
)
RUNS = st.builds(
    Run,
    st.integers(1, FRESH + 2),
    st.one_of(st.permutations([OLD, NEW, THIRD]), st.lists(TRIO, unique=True)).map(tuple),
    st.sampled_from([0.0, 0.001, -0.001, 0.004, 0.03]),
)
LEADS = st.sampled_from([None, None, None, 1, 3, FRESH, 2 * FRESH, 0, -2])
BLENDS = st.sampled_from([0, 0, 1, 3, 50, -1, 2001])
WILD = st.one_of(
    st.builds(Sample, st.sampled_from([0] * 9 + [3])),
    COMMANDS,
    COMMANDS,
    RUNS,
    st.builds(Request, IDS, LEADS, BLENDS),
    st.just(Rollback()),
    st.builds(Failure, IDS),
    st.builds(Route, st.sampled_from([OLD, NEW, THIRD, RETRACT])),
    st.builds(Register, IDS),
    st.builds(Forget, IDS),
)
READY = st.builds(
    Run,
    st.just(FRESH),
    st.permutations([OLD, NEW, THIRD]).map(tuple),
    st.sampled_from([0.001, 0.001, 0.001, 0.03]),
)
SOME_SILENT = st.builds(
    Run, st.just(FRESH), st.lists(TRIO, unique=True, max_size=2).map(tuple), st.just(0.0)
)
SPOILED = st.tuples(st.just(Sample()), COMMANDS)
SWAPS = st.tuples(
    READY.map(lambda run: (run,)),
    st.one_of(st.just(()), st.just(()), SPOILED),
    st.one_of(st.builds(Request, TRIO, LEADS, BLENDS), st.just(Rollback())).map(lambda e: (e,)),
    st.tuples(st.one_of(RUNS, SOME_SILENT, WILD), RUNS),
).map(lambda parts: [event for part in parts for event in part])
LISTS = st.lists(st.one_of(st.lists(WILD, max_size=6), SWAPS, SWAPS), min_size=4, max_size=12).map(
    lambda parts: [event for part in parts for event in part]
)


def driven(events: list[Event]) -> World:
    world = World()
    for event in events:
        world.do(event)
    return world


@given(LISTS)
@settings(max_examples=120, deadline=None)
def test_the_arbiter_does_what_the_history_says_and_replays_to_the_same_bytes(
    events: list[Event],
) -> None:
    """Every check is in `World`: one owner, at most one command per tick, within the slew limit."""
    world = driven(events)
    again = driven(events)
    assert again.record() == world.record()
    assert state(again.a) == state(world.a)


@given(LISTS)
@settings(max_examples=50, deadline=None)
def test_the_owner_changes_by_a_decision_only(events: list[Event]) -> None:
    world = World()
    active, armed = OLD, None
    for event in events:
        seen = len(world.decisions)
        world.do(event)
        for decision in world.decisions[seen:]:
            match decision.kind:
                case "fallback":
                    assert decision.controller == active != RETRACT
                    active = RETRACT
                case "routed":
                    active = decision.controller
                case "armed":
                    armed = decision.controller
                case "switched":
                    assert decision.controller == armed != active
                    active, armed = decision.controller, None
        assert world.a.active == active


@given(LISTS, st.integers(0, 10), st.lists(COMMANDS, max_size=40))
@settings(max_examples=50, deadline=None)
def test_no_flood_of_shadows_or_strangers_changes_what_the_drives_get(
    events: list[Event], each: int, flood: list[Command]
) -> None:
    """THIRD, registered but never asked for, and the unregistered send whatever they like."""

    def others(event: Event) -> bool:
        return THIRD not in (getattr(event, "controller", None), *getattr(event, "controllers", ()))

    plain, flooded = World(), World()
    pending = list(flood)
    for event in filter(others, events):
        plain.do(event)
        flooded.do(event)
        for _ in range(min(each, len(pending))):
            command = pending.pop()
            for who in (THIRD, STRANGER, FORGED, RETRACT):
                if who == THIRD or who not in flooded.known:
                    flooded.do(
                        Command(who, command.age, command.whisker, command.offset, command.length)
                    )
    assert flooded.given.keys() == plain.given.keys()
    for tick, commands in plain.given.items():
        assert [c.tobytes() for c in commands] == [c.tobytes() for c in flooded.given[tick]]
    assert flooded.a.active == plain.a.active
