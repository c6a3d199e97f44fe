"""Every verb explains itself, answers in JSON, and tells success from failure by its exit code."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.tools.conftest import rewrite, vibrissa, with_body
from vibrissa.messages.log_format import Record

VERBS = ("run", "simulate", "verify", "replay", "info", "recover", "plot", "bench", "doctor")


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_with_an_example(verb: str) -> None:
    outcome = vibrissa(verb, "--help")
    assert outcome.code == 0
    assert f"Example: vibrissa {verb}" in " ".join(outcome.out.split())


def test_help_lists_every_verb() -> None:
    outcome = vibrissa("--help")
    assert outcome.code == 0
    assert all(f" {verb} " in outcome.out for verb in VERBS)


def test_help_loads_nothing_heavy() -> None:
    heavy = ("numpy", "numba", "scipy", "matplotlib", "zmq", "mcap", "pydantic")
    code = f"import sys, vibrissa.tools.cli; print([m for m in {heavy} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_simulate_writes_log_and_summary(simulated: Path) -> None:
    summary = json.loads((simulated / "summary.json").read_text())
    assert (simulated / "run.mcap").is_file()
    assert summary["ticks"] == 6000
    assert summary["ok"] is True


def test_simulate_reports_to_people_too(experiment: Path, tmp_path: Path) -> None:
    outcome = vibrissa("simulate", experiment, "--duration", "1", "--out", tmp_path / "run")
    assert outcome.code == 0
    assert "completed: 2000 ticks" in outcome.out
    assert "whisk.command" in outcome.out


def test_overrides_reach_the_run(experiment: Path, tmp_path: Path) -> None:
    arguments = ("--seed", "9", "--controller", "open_loop", "--duration", "1")
    outcome = vibrissa("simulate", experiment, *arguments, "--out", tmp_path / "run", "--json")
    recorded = json.loads(vibrissa("info", tmp_path / "run", "--json").out)["metadata"]
    assert outcome.code == 0
    assert recorded["experiment"]["run"]["seed"] == 9
    assert recorded["experiment"]["whisk"]["controller"] == "open_loop"
    assert recorded["experiment"]["run"]["duration"] == 1


def test_verify_answers_in_json(simulated: Path) -> None:
    outcome = vibrissa("verify", simulated, "--json")
    verdict = json.loads(outcome.out)
    assert outcome.code == 0
    assert verdict["identical"] is True
    assert verdict["executor"] == "fused"
    assert verdict["steps"] > 6000
    assert verdict["compared_bytes"] > 0
    assert verdict["realtime_factor"] > 0
    assert verdict["first_difference"] is None


def test_a_divergence_is_named_with_exit_code_1(simulated: Path, tmp_path: Path) -> None:
    def nudge(record: Record) -> Record:
        if record.topic == "whisk.command" and record.seq == 1234:
            command = np.full(18, 0.125, np.float32)
            return with_body(record, command=command)
        return record

    log = rewrite(simulated / "run.mcap", tmp_path / "altered.mcap", nudge)
    told = vibrissa("verify", log)
    outcome = vibrissa("verify", log, "--json")
    difference = json.loads(outcome.out)["first_difference"]
    assert outcome.code == told.code == 1
    assert difference["node"] == "whisk"
    assert difference["topic"] == "whisk.command"
    assert difference["field"].startswith("command")
    assert difference["recorded"] == "0.125"
    assert difference["recorded"] != difference["recomputed"]
    assert "node whisk" in told.err and "0.125" in told.err


def test_info_answers_in_json(simulated: Path) -> None:
    outcome = vibrissa("info", simulated / "run.mcap", "--json")
    found = json.loads(outcome.out)
    assert outcome.code == 0
    assert found["complete"] is True
    assert found["end"]["cause"] == "completed"
    counts = {(c["topic"], c["source"]): c["count"] for c in found["channels"]}
    assert counts["head.sample", "sampler"] == 6000
    assert "whisk.command" in vibrissa("info", simulated).out


def test_doctor_answers_in_json() -> None:
    outcome = vibrissa("doctor", "--json")
    found = json.loads(outcome.out)
    assert outcome.code == 0
    assert {"cpu", "cores", "kernel", "python", "versions", "privileges"} <= found.keys()
    assert all(isinstance(granted, bool) for granted in found["privileges"].values())
    assert vibrissa("doctor").code == 0


def test_plot_draws_a_picture(simulated: Path, tmp_path: Path) -> None:
    outcome = vibrissa("plot", simulated, "--out", tmp_path / "run.png")
    assert outcome.code == 0
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")


def test_a_what_if_run_answers_in_json(simulated: Path, tmp_path: Path) -> None:
    replace = "whisk=vibrissa.processes.whisk:WhiskNode"
    out = tmp_path / "if"
    outcome = vibrissa("replay", simulated, "--replace", replace, "--out", out, "--json")
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["ok"] is True
    assert vibrissa("verify", out, "--replace", replace).code == 0


def test_a_log_is_played_at_its_pace(experiment: Path, tmp_path: Path) -> None:
    vibrissa("simulate", experiment, "--duration", "1", "--out", tmp_path / "run")
    outcome = vibrissa("replay", tmp_path / "run", "--paced", "--json")
    assert outcome.code == 0, outcome.err
    json.loads(outcome.out)
