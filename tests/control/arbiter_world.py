"""An arbiter, and an oracle of it that keeps the plain history of who answered which sample how.

`World` does to one arbiter what the events say and checks every answer: who may take over, what a
request is refused for, what the drives get.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.arbiter import RETRACT, Arbiter, Armed, ControllerId, Decision, Routing
from vibrissa.control.kinematics import WHISKERS, paper_head
from vibrissa.control.shadow import LAPSE, TOLERANCE

TRAVEL = paper_head().swing.astype(np.float32)
SLEW, MISSES, FRESH = 0.005, 4, 11
ROUNDING = 3e-8  # half a float32 step below 1 rad
OLD, NEW, THIRD = ControllerId("old"), ControllerId("new"), ControllerId("third", 2)
STRANGER, FORGED = ControllerId("new", 9), ControllerId("retract", 1)


@dataclass(frozen=True)
class Sample:
    skip: int = 0


@dataclass(frozen=True)
class Command:
    """The last command with one whisker sent elsewhere, for a tick `age` before the current."""

    controller: ControllerId
    age: int = 0
    whisker: int = 0
    offset: float = 0.0
    length: int = WHISKERS


@dataclass(frozen=True)
class Failure:
    controller: ControllerId


@dataclass(frozen=True)
class Route:
    controller: ControllerId


@dataclass(frozen=True)
class Register:
    controller: ControllerId


@dataclass(frozen=True)
class Forget:
    controller: ControllerId


@dataclass(frozen=True)
class Request:
    controller: ControllerId
    lead: int | None
    blend_ticks: int


@dataclass(frozen=True)
class Rollback:
    pass


@dataclass(frozen=True)
class Run:
    """Ticks in which all of the controllers answer in their order, `offset` from the command."""

    ticks: int
    controllers: tuple[ControllerId, ...]
    offset: float

    def events(self) -> Iterator[Sample | Command]:
        for _ in range(self.ticks):
            yield Sample()
            for controller in self.controllers:
                yield Command(controller, offset=self.offset)


Event = Sample | Command | Failure | Route | Register | Forget | Request | Rollback | Run


def state(thing: object) -> object:
    """Everything an object holds, comparable."""
    if isinstance(thing, np.ndarray):
        return thing.dtype.str, thing.tobytes()
    if isinstance(thing, dict):
        return [(state(k), state(v)) for k, v in thing.items()]
    if isinstance(thing, list | tuple):
        return [state(item) for item in thing]
    names = list(getattr(type(thing), "__slots__", ())) + list(getattr(thing, "__dict__", ()))
    if names and type(thing).__module__.startswith("vibrissa.control"):
        return [(name, state(getattr(thing, name))) for name in names]
    return repr(thing)


@dataclass
class History:
    """What a registered controller did: the outcome of its first answer on time to each sample."""

    outcomes: dict[int, str] = field(default_factory=dict)
    dead: int = 0  # it failed after answering this sample
    last: NDArray[np.float32] | None = None

    def fresh(self) -> int:
        """Good answers in a row that end with the last sample answered."""
        n, heard = 0, self.heard()
        while heard - n > self.dead and self.outcomes.get(heard - n) == "good":
            n += 1
        return n

    def heard(self) -> int:
        """The last sample answered on time."""
        return max(self.outcomes, default=0)

    def violation(self) -> tuple[int, str]:
        """The last sample answered with what no drive may get, far back if none, and the reason."""
        bad = [(s, outcome) for s, outcome in self.outcomes.items() if outcome != "good"]
        return max(bad, default=(-1000, ""))

    def good(self, first: int, last: int) -> int:
        """Good answers to these samples, since the last violation or failure."""
        first = max(first, self.violation()[0] + 1, self.dead + 1)
        return sum(self.outcomes.get(s) == "good" for s in range(first, last + 1))

    def unfit(self, sample: int) -> str:
        end = sample if self.heard() == sample else sample - 1
        if self.good(end - FRESH + 1, end) >= FRESH - FRESH // TOLERANCE:
            return self.lapsed(sample)
        if end - self.violation()[0] < FRESH:
            return self.violation()[1]
        since = self.good(1, sample)
        return "stale" if since and not self.good(sample - LAPSE, sample) else "not ready"

    def lapsed(self, sample: int) -> str:
        if self.violation()[0] >= sample - LAPSE:
            return self.violation()[1]
        return "" if self.good(sample - LAPSE, sample) else "stale"


def verdict(command: NDArray[np.float32]) -> str:
    if command.shape != (WHISKERS,):
        return "wrong length"
    for value, limit in zip(command.tolist(), TRAVEL.tolist(), strict=True):
        if not math.isfinite(value):
            return "not finite"
        if not 0.0 <= value <= limit:
            return "out of range"
    return "good"


class World:
    """One arbiter, what the drives got per tick, every decision, and the prediction of both."""

    def __init__(self) -> None:
        self.a = Arbiter(
            TRAVEL.astype(np.float64),
            slew_limit=SLEW,
            max_misses=MISSES,
            fresh_ticks=FRESH,
            last_command=0.1,
        )
        self.given: dict[int, list[NDArray[np.float32]]] = {}
        self.decisions: list[Decision] = []
        self.known: dict[ControllerId, History] = {}
        self.held = self.a.last_command
        self.sample = 0
        self.misses = 0
        self.by_order = True
        self.blend: tuple[NDArray[np.float32], int, int] = (self.held, 0, 0)
        for event in (Register(OLD), Register(NEW), Register(THIRD), Route(OLD)):
            self.do(event)

    def do(self, event: Event) -> None:
        match event:
            case Run():
                for part in event.events():
                    self.do(part)
                return
            case Sample(skip):
                routing = self.on_sample(self.a.tick + 1 + skip)
            case Command():
                routing = self.on_command(event)
            case Failure(controller):
                routing = self.on_failure(controller)
            case Route(controller):
                routing = self.on_route(controller)
            case Register(controller):
                routing = self.asked(self.a.register, controller, self.no_register(controller))
            case Forget(controller):
                routing = self.asked(self.a.forget, controller, self.no_forget(controller))
            case Request():
                routing = self.on_request(event)
            case Rollback():
                routing = self.on_rollback()
        self.take(routing)

    def take(self, routing: Routing) -> None:
        """Checks that hold after every call, whatever it was."""
        a = self.a
        for decision in routing.decisions:
            assert decision.tick == a.tick
            assert "\n" not in str(decision)
            self.decisions.append(decision)
        if routing.command is not None:
            assert routing.command.dtype == np.float32
            assert verdict(routing.command) == "good"
            moved = np.abs(routing.command.astype(np.float64) - self.held)
            assert moved.max() <= SLEW + ROUNDING
            self.held = routing.command.copy()
            assert self.given[a.tick] == []
            self.given[a.tick].append(self.held)
        assert np.array_equal(a.last_command, self.held)
        assert a.active == RETRACT or a.active in self.known
        assert a.armed is None or a.armed.controller in self.known
        assert a.previous != RETRACT
        assert a.misses == self.misses < MISSES or a.active == RETRACT

    def check_snapshot(self) -> None:
        a, owners = self.a, self.a.owners()
        assert (owners.active, owners.previous, owners.armed) == (a.active, a.previous, a.armed)
        assert list(owners.shadows) == list(self.known)
        for controller, status in owners.shadows.items():
            history = self.known[controller]
            silent = history.heard() < self.sample - 1
            assert status.fresh_ticks == (0 if silent else history.fresh())

    def on_sample(self, tick: int) -> Routing:
        a, before, armed = self.a, self.a.active, self.a.armed
        self.check_snapshot()
        self.misses += self.given.get(a.tick) == []
        self.given[tick] = []
        self.sample += 1
        due = armed is not None and tick >= armed.at
        reason = self.unfit(armed, at_its_tick=True) if armed is not None and due else ""
        routing = a.on_sample(tick)
        kinds = [d.kind for d in routing.decisions]
        if armed is not None and due:
            assert a.armed is None
            assert routing.decisions[0].controller == armed.controller
            if reason:
                assert kinds[0] == "refused"
                assert routing.decisions[0].cause.startswith(reason)
            else:
                assert kinds == ["switched"]
                assert (a.active, routing.command) == (armed.controller, None)
                assert a.previous == (before if before != RETRACT else a.previous) != a.active
                self.hand_over(blend_ticks=armed.blend_ticks)
                return routing
            kinds = kinds[1:]
        else:
            assert a.armed == armed
        if before != RETRACT and self.misses >= MISSES:
            assert kinds == ["fallback"]
            self.fell(before, routing)
        else:
            assert kinds == []
            assert a.active == before
        assert (routing.command is not None) == (a.active == RETRACT)
        return routing

    def on_command(self, event: Command) -> Routing:
        a, controller, tick = self.a, event.controller, self.a.tick - event.age
        command = self.held.astype(np.float64)
        command[event.whisker] += event.offset
        if abs(event.offset) < 1:
            command = np.clip(command, 0.0, TRAVEL)
        with np.errstate(over="ignore"):
            command = command.astype(np.float32)
        command = command[: event.length]
        active, before = a.active, a.previous
        open_tick = self.given.get(a.tick) == []
        routing = a.on_command(controller, tick, command)
        assert a.previous == before
        history = self.known.get(controller)
        if history is None:
            assert routing.command is None
            assert [d.kind for d in routing.decisions] in ([], ["refused"])
            return routing
        outcome = verdict(command)
        on_time = event.age == 0 and self.sample > 0
        if controller != active:
            assert routing == (None, ())
        elif not on_time or not open_tick:
            assert routing.command is None
            assert [d.kind for d in routing.decisions] == ["refused"]
            assert a.active == active
        elif outcome != "good":
            self.fell(active, routing)
            history.outcomes[self.sample] = outcome
            return routing
        else:
            assert routing.decisions == ()
            assert routing.command is not None
            expected = self.expected(command)
            assert np.abs(routing.command - expected).max() <= ROUNDING
            self.misses = 0
        if on_time and self.sample not in history.outcomes:
            history.outcomes[self.sample] = outcome
            history.last = command
        elif controller == active and routing.command is not None:
            history.last = command
        return routing

    def expected(self, wanted: NDArray[np.float32]) -> NDArray[np.float64]:
        base, start, ticks = self.blend
        share = min((self.a.tick - start + 1) / ticks, 1.0) if ticks else 1.0
        goal = (1.0 - share) * base.astype(np.float64) + share * wanted.astype(np.float64)
        return np.clip(goal, self.held - np.float64(SLEW), self.held + np.float64(SLEW))

    def on_failure(self, controller: ControllerId) -> Routing:
        a, active, armed = self.a, self.a.active, self.a.armed
        routing = a.on_failure(controller, "died")
        if controller not in self.known:
            assert routing == (None, ())
            return routing
        self.known[controller].dead = self.known[controller].heard()
        if controller == active:
            self.fell(active, routing)
        elif armed is not None and controller == armed.controller:
            (decision,) = routing.decisions
            assert (decision.kind, a.armed) == ("refused", None)
        else:
            assert routing == (None, ())
        return routing

    def on_route(self, controller: ControllerId) -> Routing:
        if controller != RETRACT and controller not in self.known:
            return Routing(None, ())
        decision = self.a.route(controller)
        assert (decision.kind, self.a.active) == ("routed", controller)
        self.hand_over()
        self.by_order = True
        return Routing(None, (decision,))

    def on_request(self, event: Request) -> Routing:
        a = self.a
        at = None if event.lead is None else a.tick + event.lead
        armed = Armed(event.controller, a.tick + 2 if at is None else at, event.blend_ticks)

        def ask(controller: ControllerId) -> Decision:
            return a.request(controller, a.tick, at=at, blend_ticks=event.blend_ticks)

        reason = self.no_request(armed)
        routing = self.asked(ask, event.controller, reason)
        if not reason:
            assert a.armed == armed
            if event.controller != THIRD and THIRD in self.known:
                self.asked(ask, THIRD, "already switching")
        return routing

    def on_rollback(self) -> Routing:
        a = self.a
        if a.previous is None:
            return self.asked(lambda _: a.rollback(a.tick), a.active, "no previous owner")
        armed = Armed(a.previous, a.tick + 2, 0)
        return self.asked(lambda _: a.rollback(a.tick), a.previous, self.no_request(armed))

    def asked(self, ask, controller: ControllerId, reason: str) -> Routing:  # type: ignore[no-untyped-def]
        """Ask; a refusal is for `reason` and changes nothing; otherwise there is none."""
        before = state(self.a)
        decision = ask(controller)
        assert decision.controller == controller
        if reason:
            assert decision.kind == "refused"
            assert decision.cause.startswith(reason), (decision, reason)
            assert state(self.a) == before
        else:
            assert decision.kind in ("registered", "forgotten", "armed")
        if decision.kind == "registered":
            self.known[controller] = History()
        elif decision.kind == "forgotten":
            del self.known[controller]
        return Routing(None, (decision,))

    def no_register(self, controller: ControllerId) -> str:
        if controller.name == "retract":
            return "built in"
        return "registered already" if controller in self.known else ""

    def no_forget(self, controller: ControllerId) -> str:
        if controller not in self.known:
            return "unknown"
        if controller == self.a.active:
            return "active"
        return "armed" if self.a.armed and self.a.armed.controller == controller else ""

    def no_request(self, wish: Armed) -> str:
        if wish.controller.name == "retract":
            return "built in"
        if wish.controller not in self.known:
            return "unknown"
        if self.a.armed is not None:
            return "already switching: to"
        if wish.at <= self.a.tick:
            return "in the past"
        if not 0 <= wish.blend_ticks <= 2000:
            return "blend"
        return self.unfit(wish)

    def unfit(self, wish: Armed, *, at_its_tick: bool = False) -> str:
        if wish.controller == self.a.active:
            return "active already"
        if self.a.active == RETRACT and self.by_order:
            return "retracting"
        history = self.known[wish.controller]
        if at_its_tick and (reason := history.lapsed(self.sample)):
            return f"went stale before its tick: {reason}"
        if not at_its_tick and (reason := history.unfit(self.sample)):
            return reason
        assert history.last is not None
        jump = np.abs(history.last.astype(np.float64) - self.held).max()
        return "jump too large" if jump > SLEW * max(MISSES, wish.blend_ticks) else ""

    def fell(self, controller: ControllerId, routing: Routing) -> None:
        assert routing.decisions[-1].kind == "fallback"
        assert routing.decisions[-1].controller == controller != RETRACT
        assert self.a.active == RETRACT
        assert (routing.command is not None) == (self.given.get(self.a.tick) == [])
        self.hand_over()
        self.by_order = False

    def hand_over(self, blend_ticks: int = 0) -> None:
        self.misses = 0
        self.blend = (self.held, self.a.tick, blend_ticks)

    def record(self) -> bytes:
        text = "\n".join(str(d) for d in self.decisions).encode()
        return text + b"".join(c.tobytes() for t in self.given.values() for c in t)
