"""Verify: whole logs are identical, and every kind of tampering is caught and located."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import Recorded, short_experiment
from tests.processes.logs import find, message, one_byte_changed, replaced, with_body, write
from vibrissa.messages.codec import CODECS
from vibrissa.messages.log_format import Record
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.topics import TOPICS
from vibrissa.messages.types import TICK_NS
from vibrissa.processes import provenance
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.results import UnusableLogError
from vibrissa.processes.table import PROCESSES
from vibrissa.processes.verify import verify

SAID = {t: row.name for row in PROCESSES.values() for t in row.says if TOPICS[t].compared}
"""Compared topics and a node that says them."""
RARE = ("node.answer", "head.shadow", "whisk.failure", "slam.owner", "slam.history", "rig.event")
COMPARED = [t for t in SAID if t not in RARE]
"""Those that the short experiment holds."""


def refusal(log: Path, **options: Any) -> str:
    """The one line with which verify refuses a log."""
    with pytest.raises(UnusableLogError) as caught:
        verify(log, **options)
    line = str(caught.value)
    assert line.isprintable() and 0 < len(line) < 400
    return line


def test_a_simulated_log_re_runs_to_the_same_bytes(simulated_run: Recorded) -> None:
    verdict = verify(simulated_run.log)
    compared = [
        r for r in simulated_run.records if r.source in PROCESSES and TOPICS[r.topic].compared
    ]
    assert verdict.identical and verdict.first_difference is None and verdict.notes == ()
    assert verdict.executor == "fused"
    assert verdict.steps == simulated_run.summary["steps"]
    assert verdict.compared_messages == len(compared)
    assert verdict.compared_bytes == sum(len(frame_of(r)) for r in compared)
    assert verdict.duration_s == 3.0


def test_a_simulated_log_re_runs_to_the_same_bytes_in_processes_of_its_own(
    simulated_run: Recorded,
) -> None:
    lockstep, fused = verify(simulated_run.log, "lockstep"), verify(simulated_run.log)
    assert lockstep.identical and lockstep.executor == "lockstep"
    counts = ("steps", "compared_bytes", "compared_messages", "duration_s", "notes")
    assert all(getattr(lockstep, name) == getattr(fused, name) for name in counts)


@pytest.mark.parametrize("topic", COMPARED)
def test_one_changed_byte_is_located(topic: str, simulated_run: Recorded, tmp_path: Path) -> None:
    records = simulated_run.records
    count = sum(r.topic == topic for r in records)
    at = find(records, topic, min(count - 1, 700))
    changed, field = one_byte_changed(records[at])
    verdict = verify(
        write(simulated_run.log, tmp_path / "changed.mcap", replaced(records, at, changed))
    )
    found = verdict.first_difference
    assert not verdict.identical and found is not None
    assert (found.node, found.topic) == (records[at].source, topic)
    assert found.field.split("[")[0] == field
    assert found.t_s == pytest.approx(records[at].t * 1e-9)
    assert found.step in steps_at(simulated_run.records, found.node, records[at].t)
    assert (found.recorded, found.recomputed) == values(found.field, changed, records[at])
    for told in (found.node, str(found.step), topic, field, found.recorded, found.recomputed):
        assert told in str(found)


def steps_at(records: list[Record], node: str, t: int) -> set[int]:
    """The steps of a node that consumed a message of this time, from the receipts alone."""
    times = {(r.topic, r.source, r.seq): r.t for r in records}
    found = set()
    for record in records:
        if (record.topic, record.source) == ("node.receipt", node):
            body = message(record).body
            streams = [line.split(" ")[:2] for line in body.streams.splitlines()]
            for offset, (stream, seq) in enumerate(zip(body.stream, body.seq, strict=True)):
                topic, source = streams[stream]
                consumed = (
                    int(seq) * TICK_NS if topic == "host.timer" else times[topic, source, seq]
                )
                if consumed == t:
                    found.add(body.first_step + offset)
    return found


def values(field: str, recorded: Record, right: Record) -> tuple[str, str]:
    """Recorded and right value of a field or of one element of it, as text."""
    name, _, index = field.rstrip("]").partition("[")
    both = [getattr(message(r).body, name) for r in (recorded, right)]
    if index:
        both = [value.reshape(-1)[int(index)].item() for value in both]
    return repr(both[0]), repr(both[1])


def test_lockstep_locates_the_same_difference(simulated_run: Recorded, tmp_path: Path) -> None:
    at = find(simulated_run.records, "whisk.command", 500)
    changed, _ = one_byte_changed(simulated_run.records[at])
    log = write(
        simulated_run.log, tmp_path / "x.mcap", replaced(simulated_run.records, at, changed)
    )
    assert verify(log, "lockstep").first_difference == verify(log).first_difference


def test_of_several_differences_the_first_in_time_is_named(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    for topic, number in (("arm.state", 60), ("whisk.command", 900), ("head.sample", 600)):
        at = find(records, topic, number)
        records = replaced(records, at, one_byte_changed(records[at])[0])
    found = verify(write(simulated_run.log, tmp_path / "x.mcap", records)).first_difference
    assert found is not None and (found.topic, found.node) == ("head.sample", "sampler")


@pytest.mark.parametrize("topic", COMPARED)
def test_a_lost_message_is_located(topic: str, simulated_run: Recorded, tmp_path: Path) -> None:
    records = simulated_run.records
    count = sum(r.topic == topic for r in records)
    at = find(records, topic, min(count - 1, 700))
    verdict = verify(write(simulated_run.log, tmp_path / "lost.mcap", replaced(records, at)))
    found = verdict.first_difference
    assert not verdict.identical and found is not None
    assert (found.node, found.topic) == (records[at].source, topic)
    assert found.step in steps_at(simulated_run.records, found.node, records[at].t)
    assert str(records[at].seq) in found.recomputed


@pytest.mark.parametrize("topic", ["head.sample", "whisk.cycle", "slam.pose"])
def test_a_message_too_many_is_located(topic: str, simulated_run: Recorded, tmp_path: Path) -> None:
    records = simulated_run.records
    at = find(records, topic, 0)
    twice = replaced(records, at, records[at], records[at])
    verdict = verify(write(simulated_run.log, tmp_path / "twice.mcap", twice))
    assert verdict.first_difference is not None
    assert (verdict.first_difference.topic, verdict.first_difference.field) == (topic, "seq")


def test_the_last_message_too_many_makes_a_log_unusable(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    at = find(records, "slam.pose", -1)
    again = message(records[at])
    raw = CODECS["slam.pose"].encode("slam", 0, again.seq + 1, again.t, again.body)
    extra = records[at]._replace(seq=again.seq + 1, data=raw[len("slam.pose") + 1 :])
    log = write(simulated_run.log, tmp_path / "x.mcap", replaced(records, at, records[at], extra))
    line = refusal(log)
    assert "no receipt accounts for" in line and f"slam.pose #{again.seq + 1}" in line


@pytest.mark.parametrize("apart", [1, 2, 3])
@pytest.mark.parametrize("node", PROCESSES)
def test_two_swapped_receipts_are_located(
    node: str, apart: int, simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    at = find(records, "node.receipt", 0, source=node)
    body = message(records[at]).body
    key = list(zip(body.stream, body.seq, strict=True))
    i = next(i for i in range(40, len(key)) if key[i] != key[i + apart])
    stream, seq = body.stream.copy(), body.seq.copy()
    for column in (stream, seq):
        column[[i, i + apart]] = column[[i + apart, i]]
    swapped = with_body(records[at], stream=stream, seq=seq)
    verdict = verify(write(simulated_run.log, tmp_path / "x.mcap", replaced(records, at, swapped)))
    found = verdict.first_difference
    assert not verdict.identical and found is not None
    assert (found.node, found.step) == (node, body.first_step + i)


def test_swapped_receipts_whose_digests_were_swapped_as_well_are_located(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    at = find(records, "node.receipt", 1, source="slam")
    body = message(records[at]).body
    columns = {name: getattr(body, name).copy() for name in ("stream", "seq", "digest")}
    for column in columns.values():
        column[[50, 51]] = column[[51, 50]]
    log = write(
        simulated_run.log,
        tmp_path / "x.mcap",
        replaced(records, at, with_body(records[at], **columns)),
    )
    found = verify(log).first_difference
    assert found is not None and (found.node, found.step) == ("slam", body.first_step + 50)


def test_a_changed_digest_is_located(simulated_run: Recorded, tmp_path: Path) -> None:
    records = simulated_run.records
    at = find(records, "node.receipt", 1, source="slam")
    body = message(records[at]).body
    digest = body.digest.copy()
    digest[7] ^= 1
    log = write(
        simulated_run.log,
        tmp_path / "x.mcap",
        replaced(records, at, with_body(records[at], digest=digest)),
    )
    found = verify(log).first_difference
    assert found is not None
    assert (found.node, found.step, found.field) == ("slam", body.first_step + 7, "receipt")
    assert f"{int(digest[7]):08x}" in found.recorded
    assert f"{int(body.digest[7]):08x}" in found.recomputed


def test_a_receipt_of_a_message_that_never_was_makes_a_log_unusable(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    at = find(records, "node.receipt", 1, source="slam")
    body = message(records[at]).body
    seq = body.seq.copy()
    seq[3] = 4_000_000
    log = write(
        simulated_run.log,
        tmp_path / "x.mcap",
        replaced(records, at, with_body(records[at], seq=seq)),
    )
    line = refusal(log)
    assert f"slam, step {body.first_step + 3}" in line and "#4000000" in line


@pytest.mark.parametrize("which", [0, 4, -1])
@pytest.mark.parametrize("node", PROCESSES)
def test_lost_receipts_make_a_log_unusable(
    node: str, which: int, simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    count = sum((r.topic, r.source) == ("node.receipt", node) for r in records)
    at = find(records, "node.receipt", min(which, count - 1), source=node)
    log = write(simulated_run.log, tmp_path / "x.mcap", replaced(records, at))
    line = refusal(log)
    assert node in line and "receipt" in line


def test_a_log_without_receipts_is_unusable(simulated_run: Recorded, tmp_path: Path) -> None:
    kept = [r for r in simulated_run.records if r.topic != "node.receipt"]
    line = refusal(write(simulated_run.log, tmp_path / "x.mcap", kept))
    assert "receipt" in line


@pytest.mark.parametrize("node", PROCESSES)
def test_a_log_without_the_receipts_of_one_node_is_unusable(
    node: str, simulated_run: Recorded, tmp_path: Path
) -> None:
    kept = [r for r in simulated_run.records if (r.topic, r.source) != ("node.receipt", node)]
    line = refusal(write(simulated_run.log, tmp_path / "x.mcap", kept))
    assert node in line and "receipt" in line


def test_receipts_that_contradict_themselves_make_a_log_unusable(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    at = find(records, "node.receipt", 0, source="arm")
    body = message(records[at]).body
    bad = [
        {"seq": body.seq[:-1]},
        {"stream": np.full_like(body.stream, 200)},
        {"streams": "head.sample"},
        {"streams": "head.sample sampler zero\n" * 9},
        {"streams": ""},
    ]
    for number, fields in enumerate(bad):
        changed = replaced(records, at, with_body(records[at], **fields))
        line = refusal(write(simulated_run.log, tmp_path / f"{number}.mcap", changed))
        assert "receipt of arm" in line


def test_a_lost_decision_makes_a_log_unusable(simulated_run: Recorded, tmp_path: Path) -> None:
    at = find(simulated_run.records, "run.event", -1)
    log = write(simulated_run.log, tmp_path / "x.mcap", replaced(simulated_run.records, at))
    line = refusal(log)
    assert "run.event" in line and "not in the log" in line


def test_an_altered_decision_is_located_at_the_first_node_that_heard_it(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    at = find(records, "run.event", 0)
    changed = replaced(records, at, with_body(records[at], cause="something else"))
    found = verify(write(simulated_run.log, tmp_path / "x.mcap", changed)).first_difference
    assert found is not None
    assert (found.topic, found.field) == ("run.event", "receipt")


def test_a_message_put_under_another_number_is_caught(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    at = find(records, "arm.state", 50)
    wrong = replaced(records, at, records[at]._replace(seq=7_000))
    line = refusal(write(simulated_run.log, tmp_path / "x.mcap", wrong))
    assert "arm.state #50" in line


@pytest.mark.parametrize("topic", ["head.sample", "run.event", "node.receipt"])
def test_a_message_that_can_not_be_read_makes_a_log_unusable(
    topic: str, simulated_run: Recorded, tmp_path: Path
) -> None:
    records = simulated_run.records
    at = find(records, topic, 1)
    for number, data in enumerate((b"", b"\xc1", records[at].data[:-1], b"\x90")):
        changed = replaced(records, at, records[at]._replace(data=data))
        log = write(simulated_run.log, tmp_path / f"{number}.mcap", changed)
        try:
            verdict = verify(log)
        except UnusableLogError as error:
            assert str(error).isprintable()
        else:
            assert verdict.first_difference is not None
            assert verdict.first_difference.topic == topic


def test_an_altered_experiment_or_hash_makes_a_log_unusable(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    meta = LogReader(simulated_run.log).metadata
    other = meta["experiment"].replace('"seed":7', '"seed":8')
    assert other != meta["experiment"]
    bad = [
        meta | {"experiment": other},
        meta | {"config_hash": provenance.config_hash(other)},
        meta | {"experiment": "{}"},
        {k: v for k, v in meta.items() if k != "experiment"},
        {k: v for k, v in meta.items() if k != "config_hash"},
    ]
    for number, changed in enumerate(bad):
        log = write(simulated_run.log, tmp_path / f"{number}.mcap", simulated_run.records, changed)
        assert "does not match its config hash" in refusal(log)


@pytest.mark.parametrize(
    "text", ["{}", "no JSON", '{"run": {"speed": 3}}', '{"run": {"seed": -1}}']
)
def test_an_experiment_that_is_none_makes_a_log_unusable(
    text: str, simulated_run: Recorded, tmp_path: Path
) -> None:
    meta = LogReader(simulated_run.log).metadata
    meta |= {"experiment": text, "config_hash": provenance.config_hash(text)}
    log = write(simulated_run.log, tmp_path / "x.mcap", simulated_run.records, meta)
    refusal(log)


def test_a_log_of_another_experiment_with_its_hash_diverges_in_the_plant(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    text = short_experiment(tmp_path, seed=8).model_dump_json()
    meta = LogReader(simulated_run.log).metadata
    meta |= {"experiment": text, "config_hash": provenance.config_hash(text)}
    log = write(simulated_run.log, tmp_path / "x.mcap", simulated_run.records, meta)
    found = verify(log).first_difference
    assert found is not None and (found.node, found.topic) == ("rig", "rig.sample")


def test_a_log_of_other_code_or_versions_is_re_run_and_says_so(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    meta = LogReader(simulated_run.log).metadata
    changed = meta | {"code_hash": "0" * 64, "versions": "vibrissa 0.0.1"}
    verdict = verify(write(simulated_run.log, tmp_path / "x.mcap", simulated_run.records, changed))
    assert verdict.identical
    assert [note.split(":")[0] for note in verdict.notes] == ["code hash", "versions"]


def test_what_is_measured_with_a_clock_is_not_compared(live_run: Recorded, tmp_path: Path) -> None:
    records = live_run.records
    at = find(records, "node.telemetry", 3)
    changed = replaced(records, at, with_body(records[at], cpu_s=123.0))
    assert verify(write(live_run.log, tmp_path / "x.mcap", changed)).identical


def test_nodes_say_only_what_the_table_lets_them_say(
    simulated_run: Recorded, live_run: Recorded
) -> None:
    for record in [*simulated_run.records, *live_run.records]:
        if record.source in PROCESSES and TOPICS[record.topic].compared:
            assert record.topic in PROCESSES[record.source].says


def test_progress_is_reported(simulated_run: Recorded) -> None:
    seen = []
    verify(simulated_run.log, on_progress=seen.append)
    times = [progress.done_s for progress in seen]
    assert times == sorted(times) and times[-1] > 2.0
    assert {progress.total_s for progress in seen} == {3.0}


def test_a_verdict_is_plain_json(simulated_run: Recorded) -> None:
    verdict = dataclasses.asdict(verify(simulated_run.log))
    names = {"identical", "executor", "steps", "compared_bytes", "realtime_factor"}
    assert names | {"first_difference"} <= set(verdict)
