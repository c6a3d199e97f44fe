"""The sampler: owns the head device, runs the arbiter, applies exactly one command per tick."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from vibrissa.control.arbiter import NO_TICK, RETRACT, Arbiter, ControllerId, Decision, Routing
from vibrissa.control.kinematics import paper_head
from vibrissa.messages.codec import Message
from vibrissa.messages.types import (
    TICK_HZ,
    Answer,
    Event,
    HeadCommand,
    HeadReading,
    HeadSample,
    Order,
    Ownership,
    ShadowStatus,
    WhiskCommand,
)
from vibrissa.processes.config import Experiment, slew_limit
from vibrissa.processes.node import Output

CONTROLLER = ControllerId("whisk")
RECOVERY_TICKS = 200
"""Ticks a controller must answer on time to get the drives back after it was late ..."""
LONGEST_GAP = 10
"""... with no more than these between two of them."""


class SamplerNode:
    """Turns readings into samples and routes one command per tick to the drives.

    Until the operator's start, from the last half second of the run on, and whenever a stop or a
    fault asks for it, the built-in retract controller has the drives. It also takes over from a
    controller that is late, until that controller has been on time for 0.1 s; one that sent what no
    drive may get stays out. Orders register newcomers in shadow and switch between controllers.
    """

    def __init__(self, experiment: Experiment) -> None:
        self._arbiter = Arbiter(paper_head().swing, slew_limit=slew_limit(experiment))
        self._arbiter.register(CONTROLLER)
        self._retract_tick = experiment.retract_tick
        self._retracting = False
        self._late_one: ControllerId | None = None
        self._punctual = 0
        self._last_punctual = 0
        self._switching = 0
        self._ticks = 0
        self._answered = 0
        self._obeyed = 0
        self._late = 0
        self._switches = 0

    def step(self, message: Message) -> Iterable[Output]:
        body = message.body
        match message.topic:
            case "rig.sample":
                return self._reading(body)
            case "whisk.command":
                return self._command(message.source, message.epoch, body)
            case "whisk.failure":
                return self._failed(ControllerId(message.source, message.epoch), body.cause)
            case "run.event" if body.kind == "lost":
                return self._failed(ControllerId(body.node), body.cause)
            case "run.order" if body.node == "sampler":
                return self._obey(body)
            case "run.event" if body.kind == "start" and not self._retracting:
                return self._route(CONTROLLER)
            case "run.event" | "rig.event" | "host.event" if body.kind in ("retract", "stop"):
                return self._start_retracting()
        return []

    def counters(self) -> dict[str, int]:
        """Ticks; those answered before the next sample came; those whose command the drives were
        obeying when the next sample was taken; commands that came late; switches of controller."""
        return {
            "ticks": self._ticks,
            "answered": self._answered,
            "obeyed": self._obeyed,
            "late": self._late,
            "switches": self._switches,
        }

    def _reading(self, reading: HeadReading) -> Iterator[Output]:
        tick = reading.tick
        sample = HeadSample(
            tick=tick,
            answers=reading.answers,
            theta=reading.theta,
            x=reading.x,
            y=reading.y,
            command=self._arbiter.last_command,
        )
        yield "head.sample", sample
        self._ticks += 1
        self._obeyed += reading.answers == tick - 1
        if tick >= self._retract_tick:
            yield from self._start_retracting()
        yield from self._routed(tick, self._arbiter.on_sample(tick))
        if (tick + 1) % TICK_HZ == 0:
            yield from self._shadows(tick)

    def _command(self, source: str, epoch: int, command: WhiskCommand) -> list[Output]:
        controller = ControllerId(source, epoch)
        outputs = self._recover(command.tick) if controller == self._late_one else []
        routing = self._arbiter.on_command(controller, command.tick, command.command)
        if routing.decisions and routing.decisions[0].kind == "refused":
            self._late += controller == self._arbiter.active and command.tick < self._arbiter.tick
            return outputs  # counted; one event per late command would flood the log
        return outputs + self._routed(command.tick, routing)

    def _failed(self, controller: ControllerId, cause: str) -> list[Output]:
        """A controller is known to be gone: its rule, or the switch to it, ends in this tick."""
        return self._routed(self._arbiter.tick, self._arbiter.on_failure(controller, cause))

    def _recover(self, tick: int) -> list[Output]:
        """Count a late controller's punctual answers; enough of them give it the drives again."""
        if tick != self._arbiter.tick or self._late_one is None:
            return []
        self._punctual = self._punctual + 1 if tick - self._last_punctual <= LONGEST_GAP else 1
        self._last_punctual = tick
        return self._route(self._late_one) if self._punctual >= RECOVERY_TICKS else []

    def _routed(self, tick: int, routing: Routing) -> list[Output]:
        outputs: list[Output] = []
        for decision in routing.decisions:
            outputs += self._decided(decision)
        if routing.command is not None:
            name = self._arbiter.active.name
            self._answered += 1
            outputs.append(("head.command", HeadCommand(tick, name, routing.command)))
        return outputs

    def _decided(self, decision: Decision) -> list[Output]:
        """What follows from a decision the arbiter took by itself, at a sample or a command."""
        outputs: list[Output] = [_event(decision)]
        match decision.kind:
            case "switched":
                self._switches += 1
                self._late_one = None
                text = f"switched at tick {decision.tick}, {decision.cause}"
                outputs.append(self._answer(self._switching, True, text))
            case "refused" if self._switching:
                outputs.append(self._answer(self._switching, False, decision.cause))
                outputs.append(_owner(decision.tick, self._arbiter.active))
                self._switching = 0
            case "fallback":
                late = decision.cause.startswith("no command")
                self._late_one = decision.controller if late else None
                self._punctual = 0
                outputs.append(_owner(decision.tick, self._arbiter.active))
        return outputs

    def _obey(self, order: Order) -> list[Output]:
        arbiter = self._arbiter
        named = ControllerId(order.name)
        at = None if order.at < 0 else order.at
        if self._retracting and order.kind in ("swap", "rollback"):
            return [self._answer(order.request, False, "the run is ending, whiskers retract")]
        match order.kind:
            case "register":
                decision = arbiter.register(named)
            case "forget":
                decision = arbiter.forget(named)
            case "swap":
                decision = arbiter.request(
                    named, arbiter.tick, at=at, blend_ticks=order.blend_ticks
                )
            case "rollback":
                decision = arbiter.rollback(arbiter.tick)
            case _:
                return [self._answer(order.request, False, f"can't {order.kind}")]
        accepted = decision.kind != "refused"
        outputs = [_event(decision), self._answer(order.request, accepted, decision.cause)]
        if decision.kind == "armed" and arbiter.armed is not None:
            self._switching = order.request
            outputs.append(_owner(arbiter.armed.at, arbiter.armed.controller))
        return outputs

    def _shadows(self, tick: int) -> list[Output]:
        """How every controller in shadow does, once a second."""
        owners = self._arbiter.owners()
        return [
            (
                "head.shadow",
                ShadowStatus(
                    tick=tick,
                    controller=who.name,
                    epoch=who.epoch,
                    fresh=record.fresh_ticks,
                    late=record.late,
                    mean_divergence=float(record.divergence_mean),
                    max_divergence=float(record.divergence_max),
                ),
            )
            for who, record in owners.shadows.items()
            if who != owners.active
        ]

    def _answer(self, request: int, accepted: bool, text: str) -> Output:
        tick = max(self._arbiter.tick, NO_TICK)
        return "node.answer", Answer(request, tick, int(accepted), "sampler", text[:400])

    def _start_retracting(self) -> list[Output]:
        if self._retracting:
            return []
        self._retracting = True
        return self._route(RETRACT)

    def _route(self, controller: ControllerId) -> list[Output]:
        self._late_one = None
        decision = self._arbiter.route(controller)
        return [_event(decision), _owner(max(decision.tick, NO_TICK) + 1, controller)]


def _owner(tick: int, controller: ControllerId) -> Output:
    return "head.owner", Ownership(tick, controller.name, controller.epoch)


def _event(decision: Decision) -> Output:
    tick = max(decision.tick, NO_TICK)
    cause = f"{decision.controller}: {decision.cause}"
    return "node.event", Event(tick, decision.kind, "sampler", cause[:400])
