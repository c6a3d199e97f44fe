"""The documents match the code, and the scripts that build everything are sound."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import pytest

from vibrissa.messages.topics import TOPICS
from vibrissa.processes.config import load_experiment
from vibrissa.processes.table import PROCESSES
from vibrissa.tools import docs
from vibrissa.tools.machine import advice

ROOT = Path(__file__).resolve().parents[2]


def test_generated_tables_match_the_code() -> None:
    assert docs.outdated() == []


def test_a_table_that_does_not_match_is_noticed_and_renewed() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    stale = text.replace("| `whisk.command` |", "| `whisk.order` |")
    assert stale != text
    assert docs.renewed(stale) == text


def test_architecture_holds_every_process_and_topic() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    assert all(f"| `{name}` |" in text for name in (*PROCESSES, *TOPICS))


@pytest.mark.parametrize("document", sorted(ROOT.glob("*.md")) + sorted(ROOT.glob("docs/*.md")))
def test_documents_link_to_files_that_exist(document: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", document.read_text())
    missing = [link for link in links if not (document.parent / link).exists()]
    assert missing == []


@pytest.mark.parametrize("target", ["help", "demo", "test", "bench", "docs", "clean"])
def test_every_make_target_is_sound(target: str) -> None:
    made = subprocess.run(
        ["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr


@pytest.mark.parametrize("script", [".ci/run", "tools/demo.sh", "tools/find_python.sh"])
def test_scripts_are_sound_and_executable(script: str) -> None:
    path = ROOT / script
    shell = path.read_text().splitlines()[0].split("/")[-1].split()[-1]
    assert path.stat().st_mode & 0o111
    subprocess.run([shell, "-n", str(path)], check=True)


def test_a_python_that_will_not_do_is_refused_in_one_line() -> None:
    found = subprocess.run(
        ["sh", str(ROOT / "tools" / "find_python.sh")],
        env={"PATH": "/usr/bin:/bin", "PYTHON": "false"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 1
    assert found.stdout == ""
    assert found.stderr.count("\n") == 1 and "3.11" in found.stderr


def test_the_example_for_two_cores_is_what_doctor_advises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {0, 1})
    experiment = load_experiment(ROOT / "docs" / "examples" / "two_cores.toml")
    assert any(json.dumps(experiment.run.together) in line for line in advice())
