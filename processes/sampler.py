"""The sampler: owns the head device, runs the arbiter, applies exactly one command per tick."""

from __future__ import annotations

from vibrissa.control.arbiter import NO_TICK, RETRACT, Arbiter, ControllerId, Decision, Routing
from vibrissa.control.kinematics import paper_head
from vibrissa.messages.codec import Message
from vibrissa.messages.types import (
    Event,
    HeadCommand,
    HeadReading,
    HeadSample,
    Ownership,
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
    drive may get stays out.
    """

    def __init__(self, experiment: Experiment) -> None:
        self._arbiter = Arbiter(paper_head().swing, slew_limit=slew_limit(experiment))
        self._retract_tick = experiment.retract_tick
        self._retracting = False
        self._ticks = 0
        self._answered = 0
        self._obeyed = 0
        self._late = 0
        self._punctual = 0
        self._last_punctual = 0
        self._fell_back_late = False

    def step(self, message: Message) -> list[Output]:
        body = message.body
        match message.topic:
            case "rig.sample":
                return self._reading(body)
            case "whisk.command":
                return self._command(message.source, message.epoch, body)
            case "run.event" if body.kind == "start":
                return self._route(CONTROLLER)
            case "run.event" | "host.event" if body.kind in ("retract", "stop"):
                return self._start_retracting()
        return []

    def counters(self) -> dict[str, int]:
        """Ticks; those answered before the next sample came; those whose command the drives were
        obeying when the next sample was taken; commands that came late."""
        return {
            "ticks": self._ticks,
            "answered": self._answered,
            "obeyed": self._obeyed,
            "late": self._late,
        }

    def _reading(self, reading: HeadReading) -> list[Output]:
        tick = reading.tick
        outputs: list[Output] = []
        if tick >= self._retract_tick:
            outputs += self._start_retracting()
        self._ticks += 1
        self._obeyed += reading.answers == tick - 1
        sample = HeadSample(
            tick=tick,
            answers=reading.answers,
            theta=reading.theta,
            x=reading.x,
            y=reading.y,
            command=self._arbiter.last_command,
        )
        outputs.append(("head.sample", sample))
        return outputs + self._routed(tick, self._arbiter.on_sample(tick))

    def _command(self, source: str, epoch: int, command: WhiskCommand) -> list[Output]:
        controller = ControllerId(source, epoch)
        outputs: list[Output] = []
        if self._fell_back_late and controller == CONTROLLER:
            outputs = self._recover(command.tick)
        routing = self._arbiter.on_command(controller, command.tick, command.command)
        if routing.decision is not None and routing.decision.kind == "refused":
            self._late += controller == self._arbiter.active and command.tick < self._arbiter.tick
            return outputs  # counted; one event per late command would flood the log
        return outputs + self._routed(command.tick, routing)

    def _recover(self, tick: int) -> list[Output]:
        if tick != self._arbiter.tick:
            return []
        self._punctual = self._punctual + 1 if tick - self._last_punctual <= LONGEST_GAP else 1
        self._last_punctual = tick
        return self._route(CONTROLLER) if self._punctual >= RECOVERY_TICKS else []

    def _routed(self, tick: int, routing: Routing) -> list[Output]:
        outputs: list[Output] = []
        if routing.decision is not None:
            outputs.append(_event(routing.decision))
            self._fell_back_late = routing.decision.cause.startswith("no command")
            self._punctual = 0
            outputs.append(_owner(tick, self._arbiter.active))
        if routing.command is not None:
            name = self._arbiter.active.name
            self._answered += 1
            outputs.append(("head.command", HeadCommand(tick, name, routing.command)))
        return outputs

    def _start_retracting(self) -> list[Output]:
        if self._retracting:
            return []
        self._retracting = True
        return self._route(RETRACT)

    def _route(self, controller: ControllerId) -> list[Output]:
        self._fell_back_late = False
        decision = self._arbiter.route(controller)
        return [_event(decision), _owner(max(decision.tick, NO_TICK) + 1, controller)]


def _owner(tick: int, controller: ControllerId) -> Output:
    return "head.owner", Ownership(tick, controller.name, controller.epoch)


def _event(decision: Decision) -> Output:
    tick = max(decision.tick, NO_TICK)
    cause = f"{decision.controller}: {decision.cause}"
    return "node.event", Event(tick, decision.kind, "sampler", cause[:400])
