"""Logs that were cut off, damaged or never were logs: said in one line, used as far as they go."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from tests.conftest import Recorded
from tests.processes.logs import find, message, one_byte_changed, replaced, write
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.recover import recover, summarise
from vibrissa.processes.results import UnusableLogError
from vibrissa.processes.table import PROCESSES
from vibrissa.processes.verify import verify

SHARES = [0.06, 0.2, 0.5, 0.77, 0.95, 0.999]


def cut(log: Path, out: Path, length: int) -> Path:
    out.write_bytes(log.read_bytes()[:length])
    return out


def refusal(log: Path, **options: Any) -> str:
    with pytest.raises(UnusableLogError) as caught:
        verify(log, **options)
    line = str(caught.value)
    assert line.isprintable() and str(log) in line and len(line) < 400
    return line


@pytest.fixture(params=["simulated", "live"])
def run(request: pytest.FixtureRequest) -> Recorded:
    found: Recorded = request.getfixturevalue(f"{request.param}_run")
    return found


@pytest.mark.parametrize("share", SHARES)
def test_a_cut_log_is_verified_to_its_last_complete_steps_and_says_so(
    share: float, run: Recorded, tmp_path: Path
) -> None:
    log = cut(run.log, tmp_path / "cut.mcap", int(share * run.log.stat().st_size))
    verdict = verify(log)
    assert verdict.identical, verdict.first_difference
    (note,) = verdict.notes
    assert "cut off" in note
    told = dict(part.rsplit(" ", 1) for part in note.partition("steps: ")[2].split(", "))
    assert set(told) == set(PROCESSES)
    assert sum(int(steps) for steps in told.values()) == verdict.steps
    assert verdict.steps == usable_steps(log)


def test_a_log_cut_before_its_first_receipts_is_refused(simulated_run: Recorded, tmp_path: Path):
    """They are written every 0.1 s of a 3 s run."""
    size = simulated_run.log.stat().st_size
    log = cut(simulated_run.log, tmp_path / "cut.mcap", int(0.02 * size))
    assert "it has no receipts, so nothing can be re-run" in refusal(log)


def usable_steps(log: Path) -> int:
    """Steps of all nodes up to the first whose input is not in the log."""
    present = set()
    receipts: dict[str, list[tuple[str, str, int]]] = {name: [] for name in PROCESSES}
    for record in LogReader(log, allow_cut=True):
        present.add((record.topic, record.source, record.seq))
        if record.topic == "node.receipt":
            body = message(record).body
            streams = [line.split(" ")[:2] for line in body.streams.splitlines()]
            for stream, seq in zip(body.stream, body.seq, strict=True):
                topic, source = streams[stream]
                receipts[record.source].append((topic, source, int(seq)))
    total = 0
    for entries in receipts.values():
        for key in entries:
            if key not in present and key[0] != "host.timer":
                break
            total += 1
    return total


def test_a_log_without_its_last_bytes_is_verified_whole(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    size = simulated_run.log.stat().st_size
    verdict = verify(cut(simulated_run.log, tmp_path / "cut.mcap", size - 1))
    assert verdict.identical and verdict.steps == simulated_run.summary["steps"]
    assert "cut off" in verdict.notes[0]


def test_lockstep_verifies_a_cut_log_as_far(simulated_run: Recorded, tmp_path: Path) -> None:
    log = cut(simulated_run.log, tmp_path / "cut.mcap", 1_000_000)
    fused, lockstep = verify(log), verify(log, "lockstep")
    assert lockstep.identical and lockstep.steps == fused.steps and lockstep.notes == fused.notes


def test_a_difference_in_a_cut_log_is_found(simulated_run: Recorded, tmp_path: Path) -> None:
    at = find(simulated_run.records, "head.sample", 300)
    changed = replaced(simulated_run.records, at, one_byte_changed(simulated_run.records[at])[0])
    log = write(simulated_run.log, tmp_path / "changed.mcap", changed)
    found = verify(cut(log, tmp_path / "cut.mcap", 1_000_000)).first_difference
    assert found is not None and (found.topic, found.t_s) == ("head.sample", pytest.approx(0.15))


@pytest.mark.parametrize("length", [0, 1, 8, 20, 100, 600])
def test_a_log_cut_before_its_first_message_is_refused(
    length: int, simulated_run: Recorded, tmp_path: Path
) -> None:
    refusal(cut(simulated_run.log, tmp_path / "cut.mcap", length))


def test_a_log_cut_before_its_first_receipt_is_refused(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    for length in range(2_000, 90_000, 8_000):
        log = cut(simulated_run.log, tmp_path / f"{length}.mcap", length)
        try:
            assert verify(log).steps > 0
        except UnusableLogError as error:
            assert str(log) in str(error) and str(error).isprintable()


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_recovered_log_verifies_to_its_last_complete_steps(
    share: float, run: Recorded, tmp_path: Path
) -> None:
    log = cut(run.log, tmp_path / "cut.mcap", int(share * run.log.stat().st_size))
    found = recover(log, tmp_path / "recovered.mcap")
    assert found.kept == found.readable > 0 and not found.lossless
    before, after = verify(log), verify(tmp_path / "recovered.mcap")
    assert after.identical and after.steps == before.steps
    assert "cut off" in after.notes[0]
    assert summarise(tmp_path / "recovered.mcap").complete


def test_a_flipped_bit_makes_a_log_unusable_wherever_it_is(
    simulated_run: Recorded, tmp_path: Path
) -> None:
    data = simulated_run.log.read_bytes()
    draw = random.Random(3)
    places = [draw.randrange(len(data) // 2) for _ in range(10)]
    places += [0, 9, 30, len(data) - 300, len(data) - 40, len(data) - 1]
    for place in places:
        changed = bytearray(data)
        changed[place] ^= 1 << draw.randrange(8)
        log = tmp_path / f"{place}.mcap"
        log.write_bytes(changed)
        try:
            verdict = verify(log)
        except UnusableLogError as error:
            assert str(log) in str(error) and str(error).isprintable()
        else:  # the end mark itself was hit: the log counts as cut off, and is whole otherwise
            assert verdict.identical and "cut off" in verdict.notes[0]
        log.unlink()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n",
        b"not a log at all\n" * 1000,
        b"\x7fELF" + bytes(5000),
        b"\x89MCAP0\r\n",
        b"\x89MCAP0\r\n" + bytes(5000),
        b"\x89MCAP0\r\n" * 500,
        b"#ROSBAG V2.0\n" + bytes(5000),
        random.Random(1).randbytes(100_000),
        b"\x89MCAP0\r\n" + random.Random(2).randbytes(100_000) + b"\x89MCAP0\r\n",
    ],
    ids=range(10),
)
def test_a_foreign_file_is_refused(content: bytes, tmp_path: Path) -> None:
    log = tmp_path / "foreign.mcap"
    log.write_bytes(content)
    refusal(log)


def test_an_mcap_file_of_another_program_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "other.mcap"
    with log.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        writer.finish()
    assert "ros2" in refusal(log)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "none.mcap")
    refusal(tmp_path)
