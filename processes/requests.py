"""What people and schedules ask of a run: load, swap, roll back, set, list.

A request is a small program of several steps (start a process, hand over the calibration, register,
wait until the newcomer answers on time, order the switch, wait for it). Each is a generator that
yields while it waits; `poll` lets all of them go on. The live supervisor and the simulation run the
same programs over the same orders, so a scheduled swap means the same in both.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Generator
from typing import Any, Final, Protocol

from vibrissa.messages.codec import Message
from vibrissa.messages.types import TICK_HZ, Order, Telemetry
from vibrissa.processes.config import Experiment, Swap
from vibrissa.processes.kinds import Kind, of_controllers, of_slams
from vibrissa.processes.results import RunError
from vibrissa.processes.table import ALL_SLOTS, PROCESSES, SLOTS

NEXT_CYCLE: Final = "cycle"
PATIENCE_TICKS: Final = 2000
"""How long, but at least a whisk cycle, a swap is asked for again while a newcomer is late ..."""
WORTH_RETRYING: Final = ("not ready", "stale", "jump too large")
"""... or its whiskers are elsewhere, as they are when the drives were retracted."""
RETRY_TICKS: Final = 80
"""Ticks until it is asked for again: in these a newcomer that was prepared can show that it is."""
ANSWER_PATIENCE_TICKS: Final = 20_000
LONG: Final = ("parameters", "value")
"""Arguments that may have 2000 characters; others have at most 200."""
PATIENCE_CYCLES: Final = 4
HAND_OVERS: Final = 10
NO_PARAMETERS: Final = {"rig", "sampler", "arm", "slam"}

Program = Generator[None, None, str]
"""Ends with one line for people; raises RunError with the reason of a refusal."""
Reply = Callable[[bool, str, dict[str, Any]], None]


class Run(Protocol):
    """What a run, live or simulated, lets requests do."""

    experiment: Experiment

    @property
    def tick(self) -> int:
        """The present tick."""

    def order(self, order: Order) -> None:
        """Put an order on the bus."""

    def start_slot(self, slot: str, controller: str) -> None:
        """Start the process of a slot, warm for a controller."""

    def slot_ready(self, slot: str) -> bool:
        """Whether it answers. Raises RunError when it never will."""

    def hand_over_calibration(self) -> bool:
        """Repeat the calibration for newcomers; False when there is none yet."""


class Requests:
    """All requests of a run, and what they have loaded."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._programs: list[tuple[Program, Reply]] = []
        self._answers: dict[int, list[tuple[bool, str]]] = {}
        self._number = 0
        self._whisks, self._slams = of_controllers(run.experiment), of_slams(run.experiment)
        self.slots = self._whisks.slots
        """slot -> controller, of everything that has the drives or is in shadow"""
        self._before = ""
        self._loading: list[str] = []
        self._ready: dict[str, float] = {}
        self.shadows: dict[str, dict[str, Any]] = {}

    def ask(self, verb: str, arguments: dict[str, Any], reply: Reply) -> None:
        """Begin a request; `reply` is called once, at its end."""
        programs: dict[str, Callable[..., Program]] = {
            "controllers": self._list,
            "load": self._load,
            "swap": self._swap,
            "rollback": self._rollback,
            "unload": self._unload,
            "set": self._set,
        }
        if verb not in programs:
            reply(False, f"{verb[:40]!r}: expected one of {', '.join(programs)}", {})
            return
        for key, value in arguments.items():
            most = 2000 if key in LONG else 200
            if not _sound(value, most):
                expected = f"a number, or at most {most} ASCII characters"
                reply(False, f"{verb}: {str(key)[:40]}: expected {expected}", {})
                return
        try:
            program = programs[verb](**arguments)
        except TypeError as error:
            reply(False, f"{verb}: {error}", {})
            return
        self._programs.append((program, reply))

    def schedule(self, swap: Swap) -> None:
        """Begin a swap of the experiment file; it is loaded at once and waits for its cycle."""
        self._programs.append((self._scheduled(swap), lambda _accepted, _text, _data: None))

    def poll(self) -> None:
        """Let every request go on."""
        for entry in list(self._programs):
            program, reply = entry
            try:
                next(program)
            except StopIteration as end:
                self._programs.remove(entry)
                reply(True, str(end.value), self.report())
            except RunError as error:
                self._programs.remove(entry)
                reply(False, str(error), self.report())

    def end(self, cause: str) -> None:
        """Refuse everything that is still going on."""
        for program, reply in self._programs:
            program.close()
            reply(False, cause, {})
        self._programs.clear()

    def heard(self, message: Message) -> None:
        """Take an answer, a change of ownership or a status from the bus."""
        body = message.body
        match message.topic:
            case "node.answer":
                self._answers.setdefault(body.request, []).append((bool(body.accepted), body.text))
            case "head.owner":
                if body.controller != self._whisks.owner:
                    self._before = self._whisks.owner
                self._whisks.owner = body.controller
            case "slam.owner":
                self._slams.owner = body.controller
            case "node.telemetry" if message.source in self.slots:
                self._measured(message.source, body)
            case "head.shadow":
                self.shadows[body.controller] = {
                    "fresh_ticks": body.fresh,
                    "late": body.late,
                    "mean_divergence": round(body.mean_divergence, 5),
                    "max_divergence": round(body.max_divergence, 5),
                }

    def _measured(self, node: str, telemetry: Telemetry) -> None:
        """When a controller's answers were ready after their ticks were due, us, mean of 1 s."""
        ready = float(telemetry.lateness_us[0] + telemetry.work_us[0])
        self._ready[node] = round(ready, 1)

    def lost(self, slot: str) -> None:
        """The process of a slot is gone."""
        for kind in (self._whisks, self._slams):
            kind.slots.pop(slot, None)
        self.shadows.pop(slot, None)

    def failed(self, slot: str) -> None:
        """The controller in a slot failed; it is not asked again, and its slot ends."""
        if slot in ALL_SLOTS:
            self._order("close", slot, "")
        self.lost(slot)

    def report(self) -> dict[str, Any]:
        """Installed controllers, and the loaded ones with how they do."""
        loaded = [
            {
                "slot": slot,
                "controller": controller,
                "state": "active" if slot == kind.owner else "shadow",
                **self.shadows.get(slot, {}),
                **({"ready_us": self._ready[slot]} if slot in self._ready else {}),
            }
            for kind in (self._whisks, self._slams)
            for slot, controller in kind.slots.items()
        ]
        installed = {"installed": self._whisks.installed, "slams": self._slams.installed}
        return installed | {"loaded": loaded}

    def _list(self) -> Program:
        yield
        for kind in (self._whisks, self._slams):
            kind.installed = kind.available(self._run.experiment)
        return f"{len(self.slots)} loaded, {self._whisks.owner} has the drives"

    def _kind(self, node: str) -> Kind:
        kinds = {"whisk": self._whisks, "slam": self._slams}
        if node not in kinds:
            raise RunError(f"node {node!r}: expected one of {', '.join(kinds)}")
        return kinds[node]

    def _load(self, name: str, parameters: str = "", node: str = "whisk") -> Program:
        kind = self._kind(node)
        slot = yield from self._loaded(kind, name, parameters)
        if slot not in kind.slots:
            raise RunError(f"{name} failed as soon as it was loaded")
        return f"{kind.slots[slot]} ({slot}) answers in shadow"

    def _swap(
        self,
        name: str,
        when: str = "now",
        blend: float = 0.0,
        parameters: str = "",
        node: str = "whisk",
    ) -> Program:
        if node in ("slam", "arm"):
            if blend:
                raise RunError(f"swap: {node} is swapped between cycles, without a blend")
            return (yield from self._swap_between(node, name, parameters, -1))
        if when not in ("now", NEXT_CYCLE):
            raise RunError(f"swap: when is {when!r}, expected now or {NEXT_CYCLE}")
        if isinstance(blend, str) or not 0 <= blend <= 1:
            raise RunError(f"swap: blend is {blend} s, expected 0 to 1")
        slot = yield from self._loaded(self._kind(node), name, parameters)
        return (yield from self._switch(slot, -1, when == NEXT_CYCLE, blend))

    def _swap_between(self, node: str, name: str, parameters: str, at: int) -> Program:
        """Swap what moves nothing by itself: the node concerned does it between two cycles."""
        if node == "arm" and parameters:
            raise RunError("swap: circuits of the arm have no parameters")
        target, what = name, "circuits"
        if node == "slam":
            target = yield from self._loaded(self._slams, name, parameters)
            what = f"{self._slams.slots.get(target, target)} ({target})"
        deadline = self._run.tick + PATIENCE_CYCLES * self._run.experiment.period_ticks
        while True:
            number = self._order("swap", node, target, at=at)
            accepted, text = yield from self._answer(number)
            if accepted:
                return f"{what} {text}"
            if not text.startswith(WORTH_RETRYING) or self._run.tick > deadline:
                raise RunError(f"swap of {node} to {what} refused: {text}")
            yield from self._wait(RETRY_TICKS)

    def _scheduled(self, swap: Swap) -> Program:
        period = self._run.experiment.period_ticks
        at = swap.at_cycle * period
        slot = (
            ""
            if swap.node == "arm"
            else (yield from self._loaded(self._kind(swap.node), swap.to, ""))
        )
        while self._run.tick < at - period:
            yield
        if swap.node != "whisk":
            return (yield from self._swap_between(swap.node, slot or swap.to, "", at))
        return (yield from self._switch(slot, at, False, swap.blend))

    def _switch(self, slot: str, at: int, at_cycle: bool, blend: float) -> Program:
        ticks = round(blend * TICK_HZ)
        patience = max(PATIENCE_TICKS, self._run.experiment.period_ticks)
        deadline = self._run.tick + patience
        while True:
            at = self._next_cycle() if at_cycle else at
            number = self._order("swap", "sampler", slot, at=at, blend=ticks)
            accepted, text = yield from self._answer(number)
            if accepted:
                break
            missed = at_cycle and text.startswith("in the past")  # the next one is asked for
            hopeless = not (missed or text.startswith(WORTH_RETRYING))
            if hopeless or self._run.tick > deadline:
                raise RunError(f"swap to {self.slots.get(slot, slot)} refused: {text}")
            yield from self._prepared(slot)
        accepted, text = yield from self._switched(number, at)
        if not accepted:
            raise RunError(f"swap to {self.slots.get(slot, slot)} refused: {text}")
        return f"{self.slots.get(slot, slot)} ({slot}) {text}"

    def _prepared(self, slot: str) -> Generator[None, None, None]:
        """Have a slot scheduled as if it had the drives, and give it time to be seen like that."""
        if slot in SLOTS:
            self._order("prepare", slot, "")
        yield from self._wait(RETRY_TICKS)

    def _next_cycle(self) -> int:
        """The tick at which the next whisk cycle begins for which an order is in time."""
        period = self._run.experiment.period_ticks
        at = (self._run.tick // period + 1) * period
        return at if at - self._run.tick >= 10 else at + period

    def _rollback(self) -> Program:
        deadline = self._run.tick + PATIENCE_TICKS
        while True:
            number = self._order("rollback", "sampler", "")
            accepted, text = yield from self._answer(number)
            if accepted or not text.startswith(WORTH_RETRYING) or self._run.tick > deadline:
                break
            yield from self._prepared(self._before)
        if accepted:
            accepted, text = yield from self._answer(number)
        if not accepted:
            raise RunError(f"rollback refused: {text}")
        return text

    def _unload(self, name: str, node: str = "whisk") -> Program:
        kind = self._kind(node)
        slots = [s for s, c in kind.slots.items() if name in (s, c) and s != kind.owner]
        if not slots or slots[0] not in kind.places:
            raise RunError(f"unload: {name!r} is not a {kind.word} in shadow that was loaded")
        accepted, text = yield from self._answer(self._order("forget", kind.arbiter, slots[0]))
        if not accepted:
            raise RunError(f"unload refused: {text}")
        self._order("close", slots[0], "")
        self.lost(slots[0])
        return f"{name} is unloaded"

    def _set(self, node: str, key: str, value: str) -> Program:
        named = [s for s, c in self.slots.items() if node in (s, c)]
        if node in NO_PARAMETERS:
            raise RunError(f"set: {node} has no parameters that can be changed while it runs")
        if not named:
            known = ", ".join([*PROCESSES, *self.slots.values()])
            raise RunError(f"set: {node!r} is none of {known}")
        try:
            json.loads(value)
        except ValueError:
            raise RunError(f"set: {value!r} is no number, text in quotes, true or false") from None
        accepted, text = yield from self._answer(self._order("set", named[0], key, value=value))
        if not accepted:
            raise RunError(f"set {node}.{key} refused: {text}")
        return f"{node}: {text}"

    def _loaded(self, kind: Kind, name: str, parameters: str) -> Generator[None, None, str]:
        """The slot in which a controller or SLAM is in shadow, loaded if it was not."""
        for slot, controller in list(kind.slots.items()):
            if name in (slot, controller) and not parameters:
                while slot in self._loading:
                    yield
                if slot not in kind.slots:
                    raise RunError(f"{name} could not be loaded")
                return slot
        if name not in kind.installed:
            kind.installed = kind.available(self._run.experiment)
        if name not in kind.installed:
            known = ", ".join(kind.installed)
            raise RunError(f"unknown {kind.word} {name!r}, expected one of {known}")
        slot = kind.free_slot()
        kind.slots[slot] = name
        self._loading.append(slot)
        try:
            self._order("open", slot, name)
            self._run.start_slot(slot, name)
            while not self._run.slot_ready(slot):
                yield
            while not self._run.hand_over_calibration():
                yield
            yield from self._obeyed(self._order("assign", slot, name, value=parameters))
            number = self._order("register", kind.arbiter, slot)
            yield from self._obeyed(number)
            if kind is self._slams:
                yield from self._handed_over(number, slot)
        except RunError as error:
            self.failed(slot)
            raise RunError(f"{name} could not be loaded: {error}") from None
        finally:
            self._loading.remove(slot)
        return slot

    def _handed_over(self, number: int, slot: str) -> Generator[None, None, None]:
        """Until a newcomer has taken what was seen so far, sent again while it does not hear it."""
        numbers = [number]
        for _ in range(HAND_OVERS):
            until = self._run.tick + PATIENCE_TICKS
            while self._run.tick < until:
                if any(self._answers.get(n) for n in numbers):  # a busy one may take its time
                    return
                yield
            numbers.append(self._order("register", self._slams.arbiter, slot))
            yield from self._obeyed(numbers[-1])
        raise RunError("it did not take what was seen so far")

    def _obeyed(self, number: int) -> Generator[None, None, None]:
        accepted, text = yield from self._answer(number)
        if not accepted:
            raise RunError(text)

    def _wait(self, ticks: int) -> Generator[None, None, None]:
        until = self._run.tick + ticks
        while self._run.tick < until:
            yield

    def _switched(self, number: int, at: int) -> Generator[None, None, tuple[bool, str]]:
        while self._run.tick < at:
            yield
        return (yield from self._answer(number))

    def _order(
        self, kind: str, node: str, name: str, *, value: str = "", at: int = -1, blend: int = 0
    ) -> int:
        self._number += 1
        self._run.order(Order(self._number, kind, node, name, value, at, blend))
        return self._number

    def _answer(self, number: int) -> Generator[None, None, tuple[bool, str]]:
        deadline = self._run.tick + ANSWER_PATIENCE_TICKS
        while not self._answers.get(number):
            if self._run.tick > deadline:
                raise RunError("no answer: the node that was asked does not obey")
            yield
        return self._answers[number].pop(0)


def _sound(value: Any, most: int) -> bool:
    """Whether an argument of a client can be worked with."""
    if isinstance(value, str):
        return value.isascii() and len(value) <= most
    return isinstance(value, (int, float))
