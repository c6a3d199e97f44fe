"""Requests of several clients over one sampler: who wins is told, and who does not is told why."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.processes.bench import Bench, of
from vibrissa.messages.codec import Message
from vibrissa.messages.types import TICK_NS, Answer, HeadReading, Order, WhiskCommand
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.requests import PATIENCE_TICKS, RETRY_TICKS, Requests
from vibrissa.processes.sampler import SamplerNode

ZERO = np.zeros(18, np.float32)


class Desk(Bench):
    """A sampler with its requests; every loaded controller answers every sample in time, but one
    of `starved` only once it is prepared."""

    def __init__(self, experiment: Experiment) -> None:
        super().__init__(SamplerNode(experiment))
        self.experiment = experiment
        self.tick = -1
        self.speakers = ["whisk"]
        self.starved: set[str] = set()
        self.commanded: dict[int, list[str]] = {}
        self.requests = Requests(self)
        self._take(self.decide("start", 0))

    def _take(self, outputs: list[tuple[str, Any]]) -> None:
        for topic, body in outputs:
            self.requests.heard(Message(topic, "sampler", 0, 0, self.tick * TICK_NS, body))
        for command in of(outputs, "head.command"):
            self.commanded.setdefault(command.tick, []).append(command.controller)

    def order(self, order: Order) -> None:
        if order.kind == "assign":
            self.speakers.append(order.node)
            answer = of(self.hear("run.order", "supervisor", self.tick, order), "node.answer")
            assert answer == []  # the sampler leaves alone what is somebody else's
            told = Answer(order.request, max(self.tick, -1), 1, order.node, "answers in shadow")
            self._take([("node.answer", told)])
        elif order.kind == "prepare":
            self.starved.discard(order.node)
        else:
            self._take(self.hear("run.order", "supervisor", max(self.tick, 0), order))

    def start_slot(self, slot: str, controller: str) -> None: ...

    def slot_ready(self, slot: str) -> bool:
        return True

    def hand_over_calibration(self) -> bool:
        return True

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self.tick += 1
            reading = HeadReading(self.tick, self.tick - 1, ZERO, ZERO, ZERO)
            self._take(self.hear("rig.sample", "rig", self.tick, reading))
            for source in (s for s in self.speakers if s not in self.starved):
                body = WhiskCommand(self.tick, ZERO)
                self._take(self.hear("whisk.command", source, self.tick, body))
            self.requests.poll()

    def ask(self, verb: str, **arguments: Any) -> list[tuple[bool, str]]:
        """Begin a request; what comes of it is put into the list."""
        found: list[tuple[bool, str]] = []
        self.requests.ask(verb, arguments, lambda ok, text, _data: found.append((ok, text)))
        return found


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return load_experiment(duration=30.0, controller="open_loop")


def one_owner(desk: Desk) -> None:
    """Every tick since the start was commanded once, by somebody known."""
    assert sorted(desk.commanded) == list(range(desk.tick + 1))
    assert all(len(who) == 1 for who in desk.commanded.values())


def test_of_two_clients_that_ask_at_once_one_wins_and_the_other_is_told(
    experiment: Experiment,
) -> None:
    desk = Desk(experiment)
    loads = [desk.ask("load", name=name) for name in ("rcp", "mimc")]
    desk.run(100)
    assert all(answers[0][0] for answers in loads)
    one, other = (desk.ask("swap", name=name) for name in ("rcp", "mimc"))
    desk.run(50)
    ((won, _),), ((refused, why),) = one, other
    assert won and not refused
    assert why.startswith("swap to mimc refused: already switching: to whisk.1#0 at tick 102")
    one_owner(desk)
    assert desk.commanded[101] == ["whisk"] and desk.commanded[102] == ["whisk.1"]


@pytest.mark.parametrize("back", [False, True])
def test_a_starved_newcomer_is_prepared_before_it_is_asked_for_again(
    experiment: Experiment, back: bool
) -> None:
    desk = Desk(experiment)
    desk.ask("load", name="rcp")
    desk.run(100)
    if back:  # the same on the way back, for a controller that had the drives before
        for name in ("rcp", "open_loop"):
            desk.ask("swap", name=name)
            desk.run(10)
    desk.starved.add("whisk.1")
    desk.run(100)
    answers = desk.ask("rollback") if back else desk.ask("swap", name="rcp")
    desk.run(RETRY_TICKS + 10)
    assert desk.starved == set()
    assert [accepted for accepted, _ in answers] == [True]
    one_owner(desk)
    assert desk.commanded[desk.tick] == ["whisk.1"]


def test_a_cycle_that_was_missed_on_the_way_is_followed_by_the_next(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(experiment)
    desk.ask("load", name="rcp")
    desk.run(100)
    asked = iter([desk.tick - 1, 300])
    monkeypatch.setattr(desk.requests, "_next_cycle", lambda: next(asked))
    answers = desk.ask("swap", name="rcp", when="cycle")
    desk.run(250)
    ((accepted, text),) = answers
    assert accepted and "switched at tick 300" in text
    one_owner(desk)


def test_a_newcomer_that_is_late_even_when_prepared_is_refused(experiment: Experiment) -> None:
    desk = Desk(experiment)
    desk.ask("load", name="rcp")
    desk.run(100)
    desk.speakers.remove("whisk.1")
    desk.run(100)
    answers = desk.ask("swap", name="rcp")
    desk.run(PATIENCE_TICKS + RETRY_TICKS + 10)
    ((accepted, why),) = answers
    assert not accepted and why.startswith("swap to rcp refused: stale: no fresh answer")
    assert desk.commanded[desk.tick] == ["whisk"]


VERBS = st.sampled_from(
    [
        ("swap", {"name": "rcp"}),
        ("swap", {"name": "mimc"}),
        ("swap", {"name": "open_loop"}),
        ("swap", {"name": "rcp", "blend": 0.01}),
        ("swap", {"name": "mimc", "when": "cycle"}),
        ("rollback", {}),
        ("unload", {"name": "rcp"}),
        ("load", {"name": "spread_reduction"}),
        ("load", {"name": "nobody"}),
    ]
)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(VERBS, st.integers(0, 60)), min_size=1, max_size=8))
def test_whatever_clients_ask_there_is_one_command_per_tick_and_one_answer_per_request(
    asked: list[tuple[tuple[str, dict[str, Any]], int]],
) -> None:
    desk = Desk(load_experiment(duration=30.0, controller="open_loop"))
    answers = []
    for (verb, arguments), ticks in asked:
        answers.append(desk.ask(verb, **arguments))
        desk.run(ticks)
    desk.run(2 * desk.experiment.period_ticks + 2500)
    assert all(len(found) == 1 for found in answers), answers
    assert all(text for ((_, text),) in answers)
    one_owner(desk)
    changes = [who for who, _ in itertools.groupby(w[0] for _, w in sorted(desk.commanded.items()))]
    assert set(changes) <= {"whisk", "whisk.1", "whisk.2", "whisk.3", "whisk.4"}


def test_an_active_controller_that_answers_old_samples_is_replaced_after_its_ticks(
    experiment: Experiment,
) -> None:
    desk = Desk(experiment)
    desk.run(50)
    desk.speakers = []
    told = []
    for tick in range(50, 80):
        desk.run(1)
        stale = WhiskCommand(tick - 5, ZERO)
        told += desk.hear("whisk.command", "whisk", tick, stale)
    assert told == []
    assert desk.commanded[49] == ["whisk"]
    assert not any(tick in desk.commanded for tick in range(50, 70))
    assert desk.commanded[70] == ["retract"]  # 20 samples, 50 to 69, went unanswered
