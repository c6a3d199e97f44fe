"""Sampler and whisk in the process of the head's device: in memory all is as it is over the bus.

Time is turned by the test, so every figure is exact, on any machine.
"""

from __future__ import annotations

import collections
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.processes.device_process import Bus, HeadWorld
from vibrissa.messages.codec import Message, decode
from vibrissa.messages.types import Event
from vibrissa.processes.node import Stepper
from vibrissa.processes.receipts import entries
from vibrissa.processes.table import PUBLISHED_BY_HOSTS, ROWS, build
from vibrissa.processes.whisk import WhiskNode
from vibrissa.rig.devices.errors import DeviceLimit

AT = 1000
"""Tick at which things go wrong."""
NODES = ("sampler", "whisk")
Patch = pytest.MonkeyPatch


def joined(patch: Patch, folder: Path) -> HeadWorld:
    return HeadWorld(patch, folder, nodes=NODES)


def nodes_are_accounted_for(world: HeadWorld) -> None:
    """By its receipts a node took, once and in order, all that was said and that it hears; made
    afresh and fed with that, it says what was said, byte for byte."""
    said = {decode(frame)[:4]: frame for frame in world.bus.frames}
    for name in NODES:
        stepper = Stepper(name, build(name, world.experiment))
        taken: collections.defaultdict[tuple[str, str, int], list[int]]
        taken = collections.defaultdict(list)
        for receipt in (m for m in world.bus.said if m[:2] == ("node.receipt", name)):
            for entry in entries(receipt):
                step = stepper.step(said[*entry.stream, entry.seq])
                assert step.digest == entry.digest
                taken[entry.stream].append(entry.seq)
        heard = collections.Counter(key[:3] for key in said if key[0] in ROWS[name].hears)
        assert taken == {stream: list(range(count)) for stream, count in heard.items()}
        own = collections.Counter(m.topic for m in world.bus.said if m.source == name)
        assert stepper.sent == {t: n for t, n in own.items() if t not in PUBLISHED_BY_HOSTS}


def answers_come_first(bus: Bus) -> int:
    """How many samples there were; each was answered before the next was said."""
    samples: list[int] = []
    commands: list[int] = []
    for message in bus.said:
        if message.topic == "rig.sample":
            assert commands == samples
            samples.append(message.body.tick)
        elif message.topic == "head.command":
            commands.append(message.body.tick)
    return len(samples)


def owner(bus: Bus) -> str:
    """Who had the drives in the end."""
    found: str = bus.of("head.owner")[-1].controller
    return found


def test_a_loop_that_is_closed_in_memory_answers_every_sample_and_is_accounted_for(
    monkeypatch: Patch, tmp_path: Path
) -> None:
    world = joined(monkeypatch, tmp_path)
    world.orders[AT] = world.far_end.reset
    bus = world.run()
    assert answers_come_first(bus) == len(bus.of("rig.sample")) >= 3995
    assert sorted(e.kind for e in bus.of("rig.event")) == ["gap", "opened", "reset"]
    # a command is on the wire one tick after its sample was taken, and in force from then on
    assert all(s.tick - s.answers <= 2 for s in bus.of("rig.sample")[-100:])
    nodes_are_accounted_for(world)
    kind, bye = bus.control[-1]
    assert kind == "bye" and bye["counters"]["sampler"]["ticks"] == len(bus.of("rig.sample"))
    assert set(bye["stats"]) == set(bye["counters"]) == {"head-device", *NODES}
    assert bye["sent"] == collections.Counter(m.topic for m in bus.said)


def forbid(world: HeadWorld) -> None:
    def refuse(*_: object) -> bool:
        raise DeviceLimit("whisker 3: too far")

    world.patch.setattr(world.head, "write", refuse)


ENDING: dict[str, tuple[Callable[[HeadWorld], object], str]] = {
    "another head on the wire": (lambda w: w.far_end.impostor(), "found head VIB-OTHER too"),
    "a command the limits forbid": (forbid, "whisker 3: too far"),
    "the supervisor is gone": (lambda w: w.leave_alone(), "supervisor gone"),
}


@pytest.mark.parametrize("fault", ENDING)
def test_what_ends_the_run_reaches_the_nodes_and_they_are_accounted_for_to_the_end(
    fault: str, monkeypatch: Patch, tmp_path: Path
) -> None:
    order, cause = ENDING[fault]
    world = joined(monkeypatch, tmp_path)
    world.orders[AT] = lambda: order(world)
    bus = world.run()
    (retract,) = bus.events("retract")
    assert cause in retract.cause and AT - 2 <= retract.tick <= AT + 100
    assert owner(bus) == "retract"
    nodes_are_accounted_for(world)
    assert bool(bus.of("host.event")) == (fault == "the supervisor is gone")
    assert bus.control[-1][0] == "bye"


def test_an_arm_that_stops_stops_the_nodes_but_not_the_samples(
    monkeypatch: Patch, tmp_path: Path
) -> None:
    world = joined(monkeypatch, tmp_path)
    cause = Event(AT, "retract", "arm-device", "protective stop")
    world.orders[AT] = lambda: world.bus.tell("rig.event", "arm-device", cause)
    bus = world.run()
    assert not bus.events("retract") and owner(bus) == "retract"
    assert answers_come_first(bus) == 4000
    nodes_are_accounted_for(world)


def test_a_node_that_fails_ends_the_run_and_the_head_is_left_alone(
    monkeypatch: Patch, tmp_path: Path
) -> None:
    step = WhiskNode.step

    def fail(self: WhiskNode, message: Message) -> object:
        if message.topic == "head.sample" and message.body.tick == AT:
            raise ZeroDivisionError("on fire")
        return step(self, message)

    monkeypatch.setattr(WhiskNode, "step", fail)
    bus = joined(monkeypatch, tmp_path).run()
    assert ("fault", {"cause": "ZeroDivisionError: on fire"}) in bus.control
    assert [e.cause for e in bus.events("retract")] == ["ZeroDivisionError: on fire"]
    assert bus.of("head.command")[-1].tick == AT - 1
    assert bus.of("rig.sample")[-1].tick == 3999  # the log goes on
    assert bus.of("rig.sample")[-1].answers == -1  # the firmware retracts
    assert bus.control[-1][0] == "bye"
