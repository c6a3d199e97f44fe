"""Two controllers and an arbiter, for the tests of swapping."""

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.arbiter import Arbiter, ControllerId, Decision, Routing
from vibrissa.control.kinematics import WHISKERS, paper_head
from vibrissa.control.shadow import LAPSE

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


def stale(last: int) -> str:
    return f"stale: no fresh answer for {LAPSE} ticks, last answer to tick {last}"


def kinds(routings: list[Routing]) -> list[str]:
    return [d.kind for r in routings for d in r.decisions]


def swapped(blend_ticks: int = 0) -> Arbiter:
    """NEW has just got the drives, in the sample of the current tick; OLD has answered that."""
    a = ready()
    assert a.request(NEW, a.tick, blend_ticks=blend_ticks).kind == "armed"
    run(a, 1, each={OLD: START, NEW: START})
    assert kinds(run(a, 1, each={OLD: START})) == ["switched"]
    return a
