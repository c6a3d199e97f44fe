"""A bench says what it measured, on what, and which aims were met, in one form for all."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.tools.conftest import rewrite, vibrissa
from vibrissa.messages.log_format import Record
from vibrissa.tools import bench, bench_devices, bench_live, bench_replay, floors
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.console import plain


def small(_out: Path, duration: float, _on_progress: object) -> Bench:
    rows = [{"what": "a", "us": 1.5}, {"what": "b", "us": math.nan}, {"count": np.int64(3)}]
    targets = [
        Target("quick", duration, "s", "<=", 5.0),
        Target("none lost", 1, "messages", "==", 0),
        Target("not measured", math.nan, "us", "<", 50.0),
    ]
    return Bench("small", rows, targets, Figure())


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setitem(bench.BENCHES, "small", f"{__name__}:small")
    monkeypatch.setattr(bench, "load", lambda name: small)
    yield


def test_json_holds_machine_rows_and_every_target(tmp_path: Path) -> None:
    outcome = vibrissa("bench", "small", "--duration", "4", "--json", "--out", tmp_path / "b")
    found = json.loads(outcome.out)
    assert outcome.code == 0
    assert found["bench"] == "small"
    assert {"cpu", "cores", "kernel", "python", "versions", "privileges"} <= found["machine"].keys()
    assert found["rows"] == [{"what": "a", "us": 1.5}, {"what": "b", "us": None}, {"count": 3}]
    assert found["targets"] == [
        {"name": "quick", "value": 4.0, "unit": "s", "target": "<= 5", "met": True},
        {"name": "none lost", "value": 1, "unit": "messages", "target": "== 0", "met": False},
        {"name": "not measured", "value": None, "unit": "us", "target": "< 50", "met": False},
    ]
    assert json.loads((tmp_path / "b" / "bench-small.json").read_text())["rows"] == found["rows"]
    assert (tmp_path / "b" / "bench-small.png").read_bytes().startswith(b"\x89PNG")


def test_missed_targets_are_printed_and_are_no_failure() -> None:
    outcome = vibrissa("bench", "small", "--duration", "9")
    assert outcome.code == 0
    assert outcome.out.count(" no ") == 3


def test_every_registered_bench_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert set(bench.BENCHES) >= {"live", "replay"}
    assert all(callable(bench.load(name)) for name in bench.BENCHES)


def test_medians_are_taken_figure_by_figure() -> None:
    found = [{"echo": {"p50": p50, "max": 10 - p50}} for p50 in (1.0, 2.0, 9.0)]
    assert floors.medians(found) == {"echo": {"p50": 2.0, "max": 8.0}}


def test_a_whole_log_misses_no_receipt_and_a_lost_one_is_counted(
    simulated: Path, tmp_path: Path
) -> None:
    assert bench_live.receipts_missing(simulated / "run.mcap") == 0

    def without(seq: int) -> Path:
        def drop(record: Record) -> Record | None:
            lost = (record.topic, record.source, record.seq) == ("node.receipt", "whisk", seq)
            return None if lost else record

        return rewrite(simulated / "run.mcap", tmp_path / f"without-{seq}.mcap", drop)

    assert bench_live.receipts_missing(without(3)) == 400
    last = json.loads(vibrissa("info", simulated, "--json").out)
    count = next(
        c["last_seq"]
        for c in last["channels"]
        if (c["topic"], c["source"]) == ("node.receipt", "whisk")
    )
    assert bench_live.receipts_missing(without(count)) > 0


def test_live_targets_name_every_aim_and_judge_it() -> None:
    def summary(p50: float, answered: int) -> dict[str, object]:
        return {
            "ticks": 1000,
            "ticks_answered": answered,
            "messages": {"head.sample": {"sent": 1000, "lost": 1}},
            "receipts_missing": 0,
            "cpu_cores": 1.0,
            "latency_us": {"sampler": {"p50": p50}},
            "counters": {"sampler": {"obeyed": answered - 9}},
        }

    live, joined = summary(300.0, 999), summary(20.0, 1000)
    totals = [bench_live.total_row("live", live), bench_live.total_row("together", joined)]
    met = {t.name: t.met for t in bench_live.targets(totals, live, joined, echo=100.0)}
    assert met == {
        "messages lost on recorded topics": False,
        "steps without receipt": True,
        "ticks answered within one period": True,
        "latency p50 over that of a bare echo in the same set-up": False,
        "processor use": True,
        "sampler and whisk in one process: ticks answered within the same tick": True,
        "sampler and whisk in one process: latency p50": True,
    }


def test_the_replay_floor_reads_every_message(simulated: Path) -> None:
    row = bench_replay.floor_row(simulated / "run.mcap", 3.0)
    assert row["messages"] == json.loads(vibrissa("info", simulated, "--json").out)["records"]
    assert row["times_real_time"] > 0


def test_json_has_no_word_for_nan_and_knows_numpy() -> None:
    assert plain({"a": np.float32(0.5), "b": [math.inf, np.arange(2)], 3: Path("x")}) == {
        "a": 0.5,
        "b": [None, [0, 1]],
        "3": "x",
    }


@pytest.mark.live
def test_devices_are_measured_beside_a_virtual_rig(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    can = bench_devices.rigs()["can"]
    monkeypatch.setattr(bench_devices, "rigs", lambda: {"can": can})
    monkeypatch.setattr(bench_devices, "QUICK_S", 1.0)
    found = bench_devices.bench(tmp_path, 60.0, lambda _progress: None, quick=True)
    run, *parsers = found.rows
    assert run["rig"] == "can" and run["ticks"] > 0 and run["verified"] == "yes"
    assert run["obeyed_p50_ticks"] >= 1 and run["latency_p50_us"] > 0
    assert [row["parser"] for row in parsers] == ["serial", "can"]
    assert {t.name: t.met for t in bench_devices.targets([run, run], parsers)}[
        "can: logs that verify"
    ]
