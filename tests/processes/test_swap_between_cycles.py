"""SLAMs and the arm's circuits are swapped between whisk cycles: simulated, logged, re-run."""

from __future__ import annotations

import collections
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.processes.bench import of
from tests.processes.logs import message
from tests.processes.swaps import events
from tests.processes.test_arm import Arm
from vibrissa.messages.codec import Message
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.types import Order, SlamPose, SlamView
from vibrissa.processes.arm import make_path
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.mapping import Sight
from vibrissa.processes.results import RunError
from vibrissa.processes.simulate import simulate
from vibrissa.processes.slam_others import PART, Others
from vibrissa.processes.slam_shadow import SlamShadowNode
from vibrissa.processes.verify import verify
from vibrissa.slam.interface import Odometry

MAPPED = """\
[run]
duration = 9
[whisk]
period = 0.4
calibration_cycles = 1
[arm]
speed = 0.25
lift = 0.05
[slams]
twin = "tests.slams_for_tests:Twin"
fragile = "tests.slams_for_tests:Fragile"
{swaps}
"""


def made(folder: Path, *swaps: tuple[str, int, str]) -> Experiment:
    """Short cycles and swaps (node, cycle, name)."""
    path = folder / "experiment.toml"
    listed = "\n".join(
        f'[[swap]]\nnode = "{node}"\nat_cycle = {cycle}\nto = "{name}"'
        for node, cycle, name in swaps
    )
    path.write_text(MAPPED.format(swaps=listed))
    return load_experiment(path)


def said(out: Path, topic: str) -> dict[str, list[Any]]:
    """source -> the bodies of a topic."""
    found: dict[str, list[Any]] = collections.defaultdict(list)
    for record in LogReader(out / "run.mcap"):
        if record.topic == topic:
            found[record.source].append(message(record).body)
    return found


def test_a_slam_in_shadow_is_swapped_in_and_back_and_the_log_re_runs(tmp_path: Path) -> None:
    experiment = made(tmp_path, ("slam", 12, "twin"), ("slam", 16, "ratslam"))
    out = tmp_path / "run"
    summary = simulate(experiment, out)
    assert summary["cause"] == "completed"
    owned = said(out, "slam.owner")["slam"]
    period = experiment.period_ticks
    assert [(o.tick // period, o.controller) for o in owned] == [(12, "slam.1"), (16, "slam")]
    assert all(o.tick % period == 0 for o in owned)
    first, twin = (said(out, "slam.pose")[name] for name in ("slam", "slam.1"))
    assert len(first) > 8
    assert {p.cycle for p in twin} == {p.cycle for p in first}
    for a, b in zip(first, twin, strict=True):
        assert a.odometry.tobytes() == b.odometry.tobytes()
        assert a.estimate.tobytes() == b.estimate.tobytes()  # the same law on the same data
    for executor in ("fused", "lockstep"):
        verdict = verify(out / "run.mcap", executor)
        assert verdict.identical, verdict.first_difference
        assert verdict.notes == ()


def test_a_slam_that_raises_an_error_ends_itself_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "run"
    summary = simulate(made(tmp_path, ("slam", 14, "fragile")), out)
    assert summary["cause"] == "completed"
    failed = [why for _, kind, why in events(out) if kind == "failed"]
    assert failed == ["slam.1 ValueError: lost"]
    owned = [o.controller for o in said(out, "slam.owner")["slam"]]
    fallen = [why for _, kind, why in events(out) if kind == "fallback"]
    assert owned in ([], ["slam.1", "slam"]) and len(fallen) == len(owned) // 2
    assert verify(out / "run.mcap").identical


def test_circuits_are_swapped_where_one_ends_and_the_log_re_runs(tmp_path: Path) -> None:
    plain, swapped = tmp_path / "plain", tmp_path / "swapped"
    simulate(made(tmp_path), plain)
    experiment = made(tmp_path, ("arm", 10, "A"))
    simulate(experiment, swapped)
    (answer,) = said(swapped, "node.answer")["arm"]
    assert answer.accepted and answer.text.startswith("A instead of CCAAACACA after 1 circuits")
    one, other = (said(out, "arm.setpoint")["arm"] for out in (plain, swapped))
    assert all((a.pose == b.pose).all() for a, b in zip(one, other, strict=True))
    assert verify(swapped / "run.mcap").identical


@pytest.mark.parametrize(
    ("swaps", "words"),
    [
        ((("slam", 4, "rcp"),), ("swap.to 'rcp'", "ratslam")),
        ((("arm", 4, "CXA"),), ("'CXA'", "expected letters C and A")),
        ((("slam", 4, "twin"), ("slam", 5, "ratslam")), ("at_cycle of slam", "at least 2")),
    ],
)
def test_a_schedule_that_makes_no_sense_is_refused(
    swaps: tuple[tuple[str, int, str], ...], words: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(RunError) as caught:
        made(tmp_path, *swaps)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def sight(cycle: int) -> Sight:
    image = np.full(18, cycle % 200, np.uint8)
    images = dict.fromkeys(("max_angle_gated", "max_angle_ungated", "contact_angle"), image)
    return Sight(cycle, images, Odometry(0.01 * cycle, 0.0, 0.4), np.array([0.1, 0.2, 0.077, 0.0]))


def order(kind: str, name: str, request: int = 0, node: str = "slam") -> Order:
    return Order(request, kind, node, name, "", -1, 0)


def refusal(others: Others, kind: str, name: str) -> str:
    ((topic, answer), *rest) = others.obey(order(kind, name), 8000)
    assert topic == "node.answer" and not answer.accepted and not rest
    return str(answer.text)


def test_refusals_of_a_slam_swap_are_named() -> None:
    others = Others("max_angle_gated", 800)
    for cycle in range(10):
        assert others.saw(sight(cycle)) == []
    assert refusal(others, "swap", "slam.1").startswith("unknown")
    assert refusal(others, "swap", "slam").startswith("active already")
    others.obey(order("register", "slam.1"), 8000)
    for cycle in range(10, 17):
        others.saw(sight(cycle))
    assert refusal(others, "swap", "slam.1") == (
        "not ready: its last pose is of cycle 9, the last cycle seen is 16"
    )
    assert refusal(others, "dance", "slam.1") == "can't dance"


def test_a_slam_that_falls_silent_is_replaced_by_the_first() -> None:
    others = Others("max_angle_gated", 800)
    others.saw(sight(0))
    others.obey(order("register", "slam.1"), 900)
    others.heard("slam.1", 0)
    ((_, answer), (topic, owned)) = others.obey(order("swap", "slam.1"), 900)
    assert answer.accepted and topic == "slam.owner"
    assert (owned.tick, owned.controller) == (1600, "slam.1")
    assert refusal(others, "forget", "slam.1").startswith("active")
    said_after = [others.saw(sight(cycle)) for cycle in range(1, 7)]
    assert said_after[:5] == [[]] * 5
    (event,), (back,) = of(said_after[5], "node.event"), of(said_after[5], "slam.owner")
    assert event.kind == "fallback" and back.controller == "slam"
    assert back.tick == 7 * 800


@pytest.mark.parametrize("cycles", [0, 3, PART, 2 * PART + 7])
def test_a_late_slam_is_handed_over_everything_seen_and_is_then_the_same(
    cycles: int, tmp_path: Path
) -> None:
    """One that heard everything and one that came later say the same from then on."""
    experiment = made(tmp_path)
    early, late = (SlamShadowNode(experiment, name) for name in ("slam.1", "slam.2"))
    front = Others("max_angle_gated", 800)

    def hear(node: SlamShadowNode, topic: str, body: Any, source: str = "slam") -> list[Any]:
        return list(node.step(Message(topic, source, 0, 0, 0, body)))

    def loaded(node: SlamShadowNode, request: int) -> list[Any]:
        hear(node, "run.order", order("assign", "ratslam", node=node.name), "supervisor")
        parts = of(front.obey(order("register", node.name, request), 0), "slam.history")
        return [answer for part in parts for answer in hear(node, "slam.history", part)]

    loaded(early, 1)
    for cycle in range(cycles):
        front.saw(sight(cycle))
        see(hear, early, cycle)
    ((topic, answer),) = loaded(late, 2)
    assert topic == "node.answer" and answer.request == 2
    assert answer.text == f"{cycles} cycles handed over"
    for cycle in range(cycles, cycles + 3):
        told = [of(see(hear, node, cycle), "slam.pose") for node in (early, late)]
        assert told[0][0].estimate.tobytes() == told[1][0].estimate.tobytes()
        assert told[0][0].experience == told[1][0].experience


def see(hear: Any, node: SlamShadowNode, cycle: int) -> list[Any]:
    seen = sight(cycle)
    odometry = np.array([seen.odometry.v, seen.odometry.w, seen.odometry.dt])
    hear(node, "slam.view", SlamView(cycle=cycle, **seen.images, template=0, new=0, error=-1.0))
    pose = SlamPose(cycle, -1, 0, np.zeros(3), odometry, seen.truth)
    found: list[Any] = hear(node, "slam.pose", pose)
    return found


def swap_circuits(arm: Arm, name: str) -> Any:
    body = order("swap", name, node="arm")
    ((_, answer),) = arm.hear("run.order", "supervisor", arm.tick, body)
    return answer


def test_swapped_circuits_never_make_the_arm_jump(arm: Arm, short: Experiment) -> None:
    """Before the departure, on the way, and after the last circuit."""
    arm.decide("start")
    arm.run(3)
    assert swap_circuits(arm, "A").accepted  # after the first, which the head faces already
    arm.calibrate()
    told = [arm.run(500)]
    assert swap_circuits(arm, "").accepted
    path = make_path(short, "C")
    told.append(arm.run(int(path.duration * 125) + 50))
    assert not np.ptp(told[-1][-10:], axis=0).any()  # one circuit, then rest
    assert swap_circuits(arm, "AC").accepted
    told.append(arm.run(1500))  # which begins with a turn on the spot
    all_told = np.vstack([arm.start, *told])
    step = np.linalg.norm(np.diff(all_told[:, :3], axis=0), axis=1) * 125
    turn = np.abs(np.diff(all_told[:, 3])) * 125
    assert step.max() <= 0.25 * (1 + 1e-6) and turn.max() <= np.radians(30) * (1 + 1e-6)
    assert np.ptp(told[-1], axis=0)[0] > 0.1
    refused = swap_circuits(arm, "CX")
    assert not refused.accepted and "expected letters C and A" in refused.text
    arm.decide("retract", arm.tick)
    refused = swap_circuits(arm, "C")
    assert not refused.accepted and "the run is ending" in refused.text


@pytest.fixture
def arm(short: Experiment) -> Arm:
    return Arm(short)
