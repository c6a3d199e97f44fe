"""Simulate: one seed, one result, the same bytes in every executor and every process."""

from __future__ import annotations

import collections
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Recorded, short_experiment
from tests.processes.logs import message
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.topics import TOPICS
from vibrissa.processes.config import Experiment
from vibrissa.processes.results import RunError
from vibrissa.processes.simulate import simulate
from vibrissa.processes.table import PROCESSES

SIMULATE = """\
import sys
from pathlib import Path
from vibrissa.processes.config import Experiment
from vibrissa.processes.simulate import simulate
simulate(Experiment.model_validate_json(Path(sys.argv[1]).read_text()), Path(sys.argv[2]))
"""


def test_one_seed_gives_the_same_file(
    short: Experiment, simulated_run: Recorded, tmp_path: Path
) -> None:
    simulate(short, tmp_path / "again")
    assert (tmp_path / "again" / "run.mcap").read_bytes() == simulated_run.log.read_bytes()


def test_another_seed_gives_another_file(simulated_run: Recorded, tmp_path: Path) -> None:
    simulate(short_experiment(tmp_path, seed=8), tmp_path / "other")
    other = list(LogReader(tmp_path / "other" / "run.mcap"))
    touched = [r.data for r in simulated_run.records if r.topic == "rig.sample"]
    assert touched != [r.data for r in other if r.topic == "rig.sample"]


def test_both_executors_write_the_same_file(tmp_path: Path) -> None:
    shorter = short_experiment(tmp_path, duration=1.2)
    simulate(shorter, tmp_path / "fused", "fused")
    simulate(shorter, tmp_path / "lockstep", "lockstep")
    fused, lockstep = (tmp_path / name / "run.mcap" for name in ("fused", "lockstep"))
    assert fused.read_bytes() == lockstep.read_bytes()


def test_no_hash_seed_and_no_thread_count_changes_the_file(
    short: Experiment, simulated_run: Recorded, tmp_path: Path
) -> None:
    (tmp_path / "experiment.json").write_text(short.model_dump_json())
    running = []
    for hash_seed, threads in (("1", "1"), ("2", "2")):
        command = [
            sys.executable,
            "-c",
            SIMULATE,
            tmp_path / "experiment.json",
            tmp_path / hash_seed,
        ]
        environment = os.environ | {"PYTHONHASHSEED": hash_seed, "OPENBLAS_NUM_THREADS": threads}
        running.append(subprocess.Popen(command, env=environment))
    assert [process.wait() for process in running] == [0, 0]
    for hash_seed in ("1", "2"):
        assert (tmp_path / hash_seed / "run.mcap").read_bytes() == simulated_run.log.read_bytes()


def test_the_loop_is_closed_in_every_tick(short: Experiment, simulated_run: Recorded) -> None:
    assert simulated_run.summary["ticks"] == short.ticks
    assert simulated_run.summary["ticks_answered"] == short.ticks
    commanded = {}
    for record in simulated_run.records:
        body = message(record).body if record.topic in ("head.command", "rig.sample") else None
        if record.topic == "head.command":
            assert body.tick not in commanded
            commanded[body.tick] = body.command
        elif record.topic == "rig.sample":
            assert body.answers == body.tick - 1
    assert sorted(commanded) == list(range(short.ticks))


def test_the_whiskers_whisk_touch_and_retract(short: Experiment, simulated_run: Recorded) -> None:
    samples = [message(r).body for r in simulated_run.records if r.topic == "head.sample"]
    theta = np.stack([s.theta for s in samples])
    y = np.stack([s.y for s in samples])
    calibrated = short.period_ticks
    assert theta[:calibrated].max() > 0.5
    quiet = np.abs(y[:calibrated]).max()
    assert np.abs(y).max() > 5 * quiet, "nothing was touched"
    assert theta[-1].max() < 0.25 * theta[: short.retract_tick].max()


def test_the_summary_counts_what_the_log_holds(simulated_run: Recorded) -> None:
    found = collections.Counter(record.topic for record in simulated_run.records)
    told = simulated_run.summary["messages"]
    assert {topic: told[topic]["received"] for topic in told} == dict(found)
    assert all(told[topic]["lost"] == 0 for topic in told)


def test_every_message_of_the_log_is_readable_and_numbered_without_gaps(
    simulated_run: Recorded,
) -> None:
    numbers: collections.Counter[tuple[str, str]] = collections.Counter()
    for record in simulated_run.records:
        read = message(record)
        assert read[:2] == (record.topic, record.source)
        assert (read.seq, read.t) == (record.seq, record.t)
        assert record.seq == numbers[record.topic, record.source]
        numbers[record.topic, record.source] += 1


def test_every_compared_topic_of_the_nodes_appears_in_the_short_experiment(
    simulated_run: Recorded,
) -> None:
    """So that what the other tests do to compared topics is done to all of them."""
    said = {topic for row in PROCESSES.values() for topic in row.says}
    on_demand = {"node.answer", "head.shadow", "whisk.failure", "rig.event", "rig.clock"}
    on_demand |= {"slam.owner", "slam.history"}
    expected = {t for t in said if TOPICS[t].compared} - on_demand
    assert expected <= {record.topic for record in simulated_run.records}


def test_an_output_inherits_the_time_of_the_input_that_caused_it(simulated_run: Recorded) -> None:
    for record in simulated_run.records:
        if record.topic in ("rig.sample", "head.sample", "head.command", "whisk.command"):
            assert record.t == message(record).body.tick * 500_000


def test_an_existing_directory_is_refused_and_left_alone(short: Experiment, tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("precious")
    with pytest.raises(RunError, match="exists") as caught:
        simulate(short, tmp_path)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)
    assert [(f.name, f.read_text()) for f in tmp_path.iterdir()] == [("run.mcap", "precious")]


def test_a_directory_that_can_not_be_made_is_refused(short: Experiment, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="Not a directory"):
        simulate(short, tmp_path / "file" / "run")
