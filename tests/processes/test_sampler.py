"""The sampler gives the drives exactly one command per tick, or they hold; bad ones never pass."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.processes.bench import ZEROS, Bench, of
from vibrissa.control.kinematics import paper_head
from vibrissa.messages.types import Event, HeadReading, Order, WhiskCommand
from vibrissa.processes.config import Experiment, slew_limit
from vibrissa.processes.sampler import RECOVERY_TICKS, SamplerNode

MISSES = 20
SMALL = np.full(18, 0.004, np.float32)


class Drives(Bench):
    """The sampler with drives and a controller on the bench."""

    def __init__(self, experiment: Experiment) -> None:
        super().__init__(SamplerNode(experiment))
        self.tick = -1
        self.given: dict[int, list[tuple[str, np.ndarray[Any, Any]]]] = {}
        self.events: list[Event] = []

    def take(self, outputs: list[tuple[str, Any]]) -> list[tuple[str, Any]]:
        for body in of(outputs, "head.command"):
            self.given.setdefault(body.tick, []).append((body.controller, body.command.copy()))
        self.events += of(outputs, "node.event")
        return outputs

    def sample(self, tick: int | None = None) -> list[tuple[str, Any]]:
        self.tick = self.tick + 1 if tick is None else tick
        reading = HeadReading(self.tick, self.tick - 1, ZEROS, ZEROS, ZEROS)
        return self.take(self.hear("rig.sample", "rig", self.tick, reading))

    def command(
        self, command: np.ndarray[Any, Any] = SMALL, late: int = 0, source: str = "whisk"
    ) -> list[tuple[str, Any]]:
        body = WhiskCommand(self.tick - late, command)
        return self.take(self.hear("whisk.command", source, self.tick, body))

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


@pytest.fixture
def drives(short: Experiment) -> Drives:
    made = Drives(short)
    made.take(made.decide("start"))
    return made


def test_every_sample_is_passed_on_with_the_command_that_was_applied(drives: Drives) -> None:
    for _ in range(5):
        (sample,) = of(drives.sample(), "head.sample")
        held = drives.given[drives.tick - 1][0][1] if drives.tick else ZEROS
        assert sample.tick == drives.tick and sample.answers == drives.tick - 1
        np.testing.assert_array_equal(sample.command, held)
        drives.command()


def test_before_the_start_the_built_in_controller_holds_the_whiskers_back(
    short: Experiment,
) -> None:
    drives = Drives(short)
    for _ in range(5):
        drives.sample()
        drives.command()
    assert [drives.given[tick][0][0] for tick in range(5)] == ["retract"] * 5
    assert all(len(given) == 1 and not given[0][1].any() for given in drives.given.values())


def test_one_command_per_tick_reaches_the_drives(drives: Drives) -> None:
    for tick in range(100):
        drives.sample()
        drives.command()
        drives.command()  # a second answer
        drives.command(late=1)  # one that is late
        drives.command(source="whisk.3")  # one of somebody who was not asked
        if tick % 10 == 0:
            drives.command(late=-1)  # one that is early
    assert all(len(given) == 1 and given[0][0] == "whisk" for given in drives.given.values())
    assert sorted(drives.given) == list(range(100))


def test_no_command_leaves_the_drives_as_they_are(drives: Drives) -> None:
    drives.sample()
    drives.command()
    (first,) = of(drives.sample(), "head.sample")
    (second,) = of(drives.sample(), "head.sample")
    np.testing.assert_array_equal(first.command, drives.given[0][0][1])
    np.testing.assert_array_equal(second.command, first.command)
    assert list(drives.given) == [0]


def test_a_command_is_slew_limited(drives: Drives, short: Experiment) -> None:
    far = np.full(18, 0.3, np.float32)
    last = ZEROS
    for _ in range(10):
        drives.sample()
        drives.command(far)
        ((_, given),) = drives.given[drives.tick]
        assert 0 < (given - last).max() <= slew_limit(short) + 1e-6
        last = given


def test_after_twenty_missed_ticks_the_whiskers_are_retracted_in_that_same_tick(
    drives: Drives,
) -> None:
    drives.sample()
    drives.command()
    for _ in range(MISSES):
        drives.sample()
        assert drives.tick not in drives.given
    drives.sample()
    assert drives.given[drives.tick][0][0] == "retract"
    assert drives.kinds() == ["routed", "fallback"]
    assert drives.events[-1].tick == drives.tick
    assert f"no command for {MISSES} ticks" in drives.events[-1].cause


def test_nineteen_missed_ticks_are_forgiven(drives: Drives) -> None:
    for _ in range(5):
        for _ in range(MISSES - 1):
            drives.sample()
        drives.sample()
        drives.command()
    assert drives.kinds() == ["routed"]


def test_a_late_controller_that_is_punctual_again_gets_the_drives_back(drives: Drives) -> None:
    for _ in range(MISSES + 1):
        drives.sample()
    assert drives.kinds() == ["routed", "fallback"]
    for _ in range(RECOVERY_TICKS - 1):
        drives.sample()
        drives.command()
        assert drives.given[drives.tick][0][0] == "retract"
    assert drives.kinds() == ["routed", "fallback"]
    for _ in range(2):
        drives.sample()
        drives.command()
    assert drives.given[drives.tick][0][0] == "whisk"
    assert drives.kinds() == ["routed", "fallback", "routed"]


def test_a_controller_that_stays_late_does_not_get_the_drives_back(drives: Drives) -> None:
    for _ in range(MISSES + 1):
        drives.sample()
    for _ in range(3 * RECOVERY_TICKS):
        drives.sample()
        drives.command(late=1)
    assert drives.kinds() == ["routed", "fallback"]
    assert {drives.given[tick][0][0] for tick in range(MISSES, drives.tick + 1)} == {"retract"}


SWING = paper_head().swing.astype(np.float32)


@pytest.mark.parametrize(
    "value", [math.nan, math.inf, -math.inf, -0.001, -1e-30, 6.0, 1e30], ids=str
)
def test_a_command_no_drive_may_get_ends_the_rule_in_the_same_tick(
    value: float, drives: Drives
) -> None:
    for _ in range(10):
        drives.sample()
        drives.command()
    before = drives.given[drives.tick][0][1]
    drives.sample()
    bad = SMALL.copy()
    bad[7] = value
    drives.command(bad)
    ((who, given),) = drives.given[drives.tick]
    assert who == "retract" and np.isfinite(given).all()
    assert (given <= before).all() and (given >= 0).all()
    assert drives.kinds() == ["routed", "fallback"]
    assert drives.events[-1].tick == drives.tick and "whisker 7" in drives.events[-1].cause
    for _ in range(2 * RECOVERY_TICKS):  # and stays ended, however good it is afterwards
        drives.sample()
        drives.command()
    assert drives.given[drives.tick][0][0] == "retract"


def test_full_protraction_is_allowed(drives: Drives) -> None:
    for _ in range(1000):
        drives.sample()
        drives.command(SWING)
    np.testing.assert_array_equal(drives.given[999][0][1], SWING)


@pytest.mark.parametrize("topic", ["run.event", "host.event"])
@pytest.mark.parametrize("kind", ["retract", "stop"])
def test_a_stop_retracts_the_whiskers(topic: str, kind: str, drives: Drives) -> None:
    for _ in range(50):
        drives.sample()
        drives.command(np.full(18, 0.3, np.float32))
    drives.take(drives.decide(kind, drives.tick, topic))
    most = drives.given[drives.tick][0][1].max()
    for _ in range(400):
        drives.sample()
        drives.command(np.full(18, 0.3, np.float32))
        ((who, given),) = drives.given[drives.tick]
        assert who == "retract" and given.max() <= most
        most = given.max()
    assert most == 0


def test_nothing_gives_the_drives_back_after_a_stop(drives: Drives) -> None:
    def order(kind: str, name: str, at: int = -1) -> None:
        drives.take(
            drives.hear(
                "run.order", "supervisor", drives.tick, Order(1, kind, "sampler", name, "", at, 0)
            )
        )

    def both() -> None:
        drives.sample()
        drives.command()
        drives.command(source="whisk.1")

    order("register", "whisk.1")
    for _ in range(100):
        both()
    order("swap", "whisk.1", at=drives.tick + 20)
    for _ in range(10):
        both()
    drives.take(drives.decide("stop", drives.tick))
    stopped = drives.tick + 1
    for _ in range(100):
        both()
    drives.take(drives.decide("start", drives.tick))
    order("swap", "whisk.1")
    for _ in range(100):
        both()
    order("rollback", "")
    for _ in range(100):
        both()
    assert {drives.given[tick][0][0] for tick in range(stopped, drives.tick)} == {"retract"}


def test_the_last_half_second_of_a_run_is_for_retracting(short: Experiment) -> None:
    drives = Drives(short)
    drives.take(drives.decide("start"))
    drives.sample(short.retract_tick - 1)
    drives.command()
    drives.sample()
    assert [drives.given[tick][0][0] for tick in sorted(drives.given)] == ["whisk", "retract"]
    drives.command()
    assert len(drives.given[short.retract_tick]) == 1


def test_other_decisions_and_other_nodes_do_not_touch_the_drives(drives: Drives) -> None:
    drives.sample()
    for kind in ("fault", "note", "degraded", ""):
        assert drives.decide(kind) == []
    drives.command()
    assert drives.given[0][0][0] == "whisk"


def test_the_sampler_counts_ticks_and_answers(drives: Drives) -> None:
    for tick in range(40):
        drives.sample()
        drives.command(late=int(tick % 4 == 0))
    counted = drives.node.counters()  # type: ignore[attr-defined]
    assert counted["ticks"] == 40
    assert counted["answered"] == 30
    assert counted["late"] == 10
