"""What-if and paced replay: a new node on recorded input, and a log to look at."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import zmq

from tests.conftest import Recorded
from tests.messages.strategies import bits
from tests.messages.test_transport import PATIENCE_S
from tests.processes import nodes
from tests.processes.logs import message, write
from vibrissa.messages.codec import decode
from vibrissa.messages.log_format import Record
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.transport import ZmqPort
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.replay import affected, play, what_if
from vibrissa.processes.results import RunError, UnusableLogError
from vibrissa.processes.table import PROCESSES
from vibrissa.processes.verify import verify


def slam_by(node: type) -> dict[str, str]:
    return {"slam": f"{nodes.__name__}:{node.__name__}"}


def said(records: list[Record], source: str) -> list[Record]:
    """What a source said, apart from what its host said about it."""
    about = ("node.receipt", "node.telemetry")
    return [r for r in records if r.source == source and r.topic not in about]


@pytest.fixture(scope="session")
def shifted(simulated_run: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The simulated run with another SLAM."""
    out = tmp_path_factory.mktemp("what-if") / "shifted"
    return Recorded.of(out, what_if(simulated_run.log, slam_by(nodes.Shifted), out))


def test_a_what_if_run_keeps_what_was_recorded_and_changes_what_was_replaced(
    simulated_run: Recorded, shifted: Recorded
) -> None:
    for source in ("rig", "sampler", "whisk", "arm", "supervisor"):
        assert said(shifted.records, source) == said(simulated_run.records, source)
    before, after = said(simulated_run.records, "slam"), said(shifted.records, "slam")
    assert [r.topic for r in before] == [r.topic for r in after]
    moved = [
        message(b).body.estimate - message(a).body.estimate
        for a, b in zip(before, after, strict=True)
        if a.topic == "slam.pose"
    ]
    assert moved and all(m.tolist() == [pytest.approx(1.0), 0.0, 0.0] for m in moved)


def test_a_what_if_run_is_deterministic_against_itself(
    simulated_run: Recorded, shifted: Recorded, tmp_path: Path
) -> None:
    what_if(simulated_run.log, slam_by(nodes.Shifted), tmp_path / "again")
    assert (tmp_path / "again" / "run.mcap").read_bytes() == shifted.log.read_bytes()


def test_a_what_if_log_is_verified_with_the_same_replacement(shifted: Recorded) -> None:
    fused = verify(shifted.log, replacements=slam_by(nodes.Shifted))
    lockstep = verify(shifted.log, "lockstep", replacements=slam_by(nodes.Shifted))
    assert fused.identical and lockstep.identical
    assert fused.steps == lockstep.steps == shifted.summary["steps"]


def test_a_what_if_log_is_refused_when_the_replacement_is_not_named(shifted: Recorded) -> None:
    with pytest.raises(UnusableLogError, match="Shifted") as caught:
        verify(shifted.log)
    assert "--replace" in str(caught.value) and str(caught.value).isprintable()


def test_a_what_if_log_diverges_with_another_replacement(shifted: Recorded) -> None:
    found = verify(
        shifted.log, replacements={"slam": "vibrissa.processes.slam:SlamNode"}
    ).first_difference
    assert found is not None
    assert (found.node, found.topic, found.field) == ("slam", "slam.pose", "estimate[0]")


@pytest.mark.parametrize("kind", ["simulated", "live"])
def test_slam_replaced_by_its_own_class_finds_the_same(
    kind: str, simulated_run: Recorded, live_run: Recorded, tmp_path: Path
) -> None:
    run = {"simulated": simulated_run, "live": live_run}[kind]
    replacement = {"slam": "vibrissa.processes.slam:SlamNode"}
    found = Recorded.of(tmp_path / "if", what_if(run.log, replacement, tmp_path / "if"))
    before, after = ([message(r) for r in said(f.records, "slam")] for f in (run, found))
    assert [(m.topic, bits(m.body)) for m in before] == [(m.topic, bits(m.body)) for m in after]
    assert verify(found.log, replacements=replacement).identical


def test_the_nodes_that_hear_a_replaced_one_are_re_run_and_the_devices_are_not(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    replacement = {"whisk": "vibrissa.processes.whisk:WhiskNode"}
    summary = what_if(simulated_run.log, replacement, tmp_path / "if")
    assert summary["rerun"] == affected(replacement) == ["sampler", "whisk", "arm", "slam"]
    records = Recorded.of(tmp_path / "if", summary).records
    assert said(records, "rig") == said(simulated_run.records, "rig")
    assert {r.source for r in records if r.topic == "node.receipt"} == set(summary["rerun"])
    assert verify(tmp_path / "if" / "run.mcap", replacements=replacement).identical


@pytest.mark.parametrize("node", [n for n, row in PROCESSES.items() if not row.source])
def test_a_replaced_node_is_among_those_that_are_re_run(node: str) -> None:
    assert node in affected({node: "module:Class"})
    assert not any(PROCESSES[n].source for n in affected({node: "module:Class"}))


@pytest.mark.parametrize(
    "node",
    [
        nodes.ReadsTheClock,
        nodes.DrawsGlobalNumbers,
        nodes.DrawsGlobalNumpyNumbers,
        nodes.RemembersOthers,
    ],
)
def test_a_node_that_uses_what_is_no_input_is_caught_and_located(
    node: type, simulated_run: Recorded, tmp_path: Path
) -> None:
    summary = what_if(simulated_run.log, slam_by(node), tmp_path / "if")
    run = Recorded.of(tmp_path / "if", summary)
    found = verify(run.log, replacements=slam_by(node)).first_difference
    assert found is not None
    first = next(r for r in run.records if r.topic == "slam.view")
    assert (found.node, found.topic, found.field) == ("slam", "slam.view", "error")
    assert found.t_s == pytest.approx(first.t * 1e-9)
    assert found.recorded == repr(message(first).body.error) != found.recomputed


RE_RUN = """\
import json, sys
from pathlib import Path
from vibrissa.processes.replay import what_if
from vibrissa.processes.verify import verify
log, out, replacement = sys.argv[1], sys.argv[2], {"slam": sys.argv[3]}
if out:
    what_if(Path(log), replacement, Path(out))
else:
    print(json.dumps(verify(Path(log), replacements=replacement).to_json()))
"""


def re_run(log: Path, out: Path | str, replacement: str, hash_seed: str) -> str:
    command = [sys.executable, "-c", RE_RUN, str(log), str(out), replacement]
    environment = os.environ | {"PYTHONHASHSEED": hash_seed}
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return found.stdout


def test_a_node_that_follows_the_order_of_a_set_is_caught_under_another_hash_seed(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    replacement = slam_by(nodes.FollowsSetOrder)["slam"]
    re_run(simulated_run.log, tmp_path / "if", replacement, "1")
    log = tmp_path / "if" / "run.mcap"
    assert json.loads(re_run(log, "", replacement, "1"))["identical"]
    verdict: Mapping[str, Any] = json.loads(re_run(log, "", replacement, "2"))
    assert not verdict["identical"]
    assert verdict["first_difference"]["topic"] == "slam.view"


@pytest.mark.parametrize("executor", ["fused", "lockstep"])
def test_a_node_that_fails_is_located(executor: Any, simulated_run: Recorded) -> None:
    found = verify(simulated_run.log, executor, replacements=slam_by(nodes.Fails)).first_difference
    assert found is not None
    assert (found.node, found.topic, found.field) == ("slam", "head.sample", "step")
    assert found.recomputed == "ZeroDivisionError: no tenth sample, please"
    assert found.t_s == pytest.approx(0.005)


@pytest.mark.parametrize(
    "replacement",
    [
        {},
        {"nobody": "a:B"},
        {"recorder": "a:B"},
        {"slam": "no_such_module:Node"},
        {"slam": "json:Nothing"},
        {"slam": "json"},
        {"slam": ":"},
        {"slam": ""},
        slam_by(nodes.NoNode),
        {"slam": f"{nodes.__name__}:no_class"},
    ],
)
def test_a_replacement_that_can_not_be_made_is_refused_and_writes_nothing(
    replacement: dict[str, str], simulated_run: Recorded, tmp_path: Path
) -> None:
    with pytest.raises(UnusableLogError, match="--replace") as caught:
        what_if(simulated_run.log, replacement, tmp_path / "if")
    assert str(caught.value).isprintable()
    assert not (tmp_path / "if").exists()


def test_a_what_if_run_overwrites_nothing(simulated_run: Recorded, tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("precious")
    with pytest.raises(RunError, match="exists"):
        what_if(simulated_run.log, slam_by(nodes.Shifted), tmp_path)
    assert (tmp_path / "run.mcap").read_text() == "precious"


def test_a_cut_log_is_no_ground_for_a_what_if_run(simulated_run: Recorded, tmp_path: Path) -> None:
    log = tmp_path / "cut.mcap"
    log.write_bytes(simulated_run.log.read_bytes()[:500_000])
    with pytest.raises(UnusableLogError, match="cut off"):
        what_if(log, slam_by(nodes.Shifted), tmp_path / "if")
    assert not (tmp_path / "if").exists()


def test_a_paced_replay_is_heard_in_the_order_of_logical_time(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    early = [r for r in simulated_run.records if r.t < 600_000_000]
    log = write(simulated_run.log, tmp_path / "early.mcap", early)
    endpoint = f"ipc://{tmp_path}/replay"
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    listener = ZmqPort(context, f"ipc://{tmp_path}/own", ["head.sample"], [endpoint])
    told: dict[str, Any] = {}
    playing = threading.Thread(target=lambda: told.update(play(log, endpoint=endpoint)))
    heard = []
    try:
        playing.start()
        frame = listener.receive(PATIENCE_S)
        while frame is not None:
            heard.append(frame)
            frame = listener.receive(0.5)
    finally:
        playing.join()
        listener.close()
        context.destroy(linger=0)
    frames = [frame_of(r) for r in early if r.topic == "head.sample"]
    assert heard and heard == frames[-len(heard) :]
    assert told == {
        "ok": True,
        "published": len(early),
        "duration_s": max(r.t for r in early) * 1e-9,
        "endpoint": endpoint,
    }


def test_what_is_played_is_what_was_recorded(live_run: Recorded) -> None:
    for record in LogReader(live_run.log):
        assert decode(frame_of(record))[:4] == (record.topic, record.source, 0, record.seq)
