"""Bad input costs one line that says what and where, exit code 2, and nothing else."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tools.conftest import refused, vibrissa

RAGGED = """\
+---+---+
|   |
+   +---+
|  |    |
+---+---+
"""


@pytest.mark.parametrize("verb", ["run", "simulate"])
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[run]\nduraton = 3\n", ("run.duraton", "duration")),
        ("[whisk]\nperiod = 99\n", ("whisk.period", "99", "10")),
        ("[whisk]\nperiod = 'slow'\n", ("whisk.period", "slow")),
        ("[run]\nseed = -1\n", ("run.seed", "-1")),
        ("[whisk]\ncontroller = 'pid'\n", ("whisk.controller", "pid", "open_loop")),
        ("[slam.parameters]\nvt_threshold = 1\n", ("vt_threshold",)),
        ("[run\n", ("not a TOML file",)),
        ("[maze]\nfile = 'nowhere.maze'\n", ("maze.file", "nowhere.maze")),
        ("[maze]\nfile = 'ragged.maze'\n", ("ragged.maze", "line 4")),
    ],
)
def test_a_bad_experiment_is_named_and_starts_nothing(
    verb: str, text: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "ragged.maze").write_text(RAGGED)
    (tmp_path / "bad.toml").write_text(text)
    outcome = vibrissa(verb, tmp_path / "bad.toml", "--out", tmp_path / "run")
    assert refused(outcome, *words), outcome
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("verb", ["run", "simulate"])
def test_a_missing_experiment_file_is_named(verb: str, tmp_path: Path) -> None:
    outcome = vibrissa(verb, tmp_path / "none.toml", "--out", tmp_path / "run")
    assert refused(outcome, "none.toml", "No such file")


@pytest.mark.parametrize("verb", ["run", "simulate"])
def test_an_existing_run_directory_is_left_as_it_is(verb: str, tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text("precious")
    outcome = vibrissa(verb, "--duration", "1", "--out", tmp_path)
    assert refused(outcome, str(tmp_path), "exists")
    assert [(f.name, f.read_text()) for f in tmp_path.iterdir()] == [("summary.json", "precious")]


def test_a_port_in_use_is_named_before_anything_starts(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        (tmp_path / "tcp.toml").write_text(f"[run]\ntransport = 'tcp'\ntcp_port = {port}\n")
        outcome = vibrissa("run", tmp_path / "tcp.toml", "--out", tmp_path / "run")
    assert refused(outcome, str(port), "in use")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("verb", ["verify", "replay", "info", "recover", "plot"])
def test_a_foreign_file_is_no_log(verb: str, tmp_path: Path) -> None:
    log = tmp_path / "foreign.mcap"
    log.write_bytes(b"\x7fELF" + bytes(1000))
    outcome = vibrissa(verb, log)
    assert refused(outcome, "foreign.mcap", "not an MCAP file"), outcome
    assert [f.name for f in tmp_path.iterdir()] == ["foreign.mcap"]


@pytest.mark.parametrize("verb", ["verify", "replay", "info", "recover", "plot"])
def test_a_missing_log_is_named(verb: str, tmp_path: Path) -> None:
    outcome = vibrissa(verb, tmp_path / "none.mcap")
    assert refused(outcome, "none.mcap", "o such file"), outcome


def test_a_flipped_bit_makes_a_log_unusable_and_info_says_where(
    simulated: Path, tmp_path: Path
) -> None:
    data = bytearray((simulated / "run.mcap").read_bytes())
    data[len(data) // 2] ^= 0x10
    log = tmp_path / "flipped.mcap"
    log.write_bytes(data)
    assert refused(vibrissa("verify", log), "flipped.mcap", "damaged at byte")
    told = vibrissa("info", log)
    assert told.code == 1
    assert "damaged at byte" in told.err.splitlines()[-1]


def test_a_truncated_log_is_named_recovered_and_verified(simulated: Path, tmp_path: Path) -> None:
    data = (simulated / "run.mcap").read_bytes()
    log = tmp_path / "cut.mcap"
    log.write_bytes(data[: len(data) * 2 // 3])
    told = vibrissa("info", log)
    assert told.code == 1
    assert "cut off" in told.err and "recover" in told.err

    saved = vibrissa("recover", log, "--json")
    found = json.loads(saved.out)
    assert saved.code == 0
    assert found["lossless"] is False and found["kept"] > 1000
    assert log.read_bytes() == data[: len(data) * 2 // 3]
    assert vibrissa("verify", found["out"]).code == 0
    assert refused(vibrissa("recover", log), "cut-recovered.mcap", "exists")


@pytest.mark.parametrize(
    "replace", ["whisk", "nobody=a:B", "whisk=no_such_module:Node", "whisk=json:nothing", "whisk="]
)
def test_a_replacement_that_can_not_be_made_is_refused(
    replace: str, simulated: Path, tmp_path: Path
) -> None:
    outcome = vibrissa("replay", simulated, "--replace", replace, "--out", tmp_path / "if")
    assert outcome.code == 2
    assert "--replace" in outcome.err
    assert not (tmp_path / "if").exists()


def test_an_unknown_bench_is_refused_with_those_there_are() -> None:
    outcome = vibrissa("bench", "nothing")
    assert outcome.code == 2
    assert "live" in outcome.err


def test_a_bug_is_not_dressed_up_as_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> dict[str, object]:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("vibrissa.tools.machine.machine", broken)
    with pytest.raises(ZeroDivisionError):
        vibrissa("doctor")


def test_the_installed_command_fails_without_a_traceback(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from vibrissa.tools.cli import main; main()"]
    found = subprocess.run(
        [*command, "verify", str(tmp_path / "none.mcap")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 2
    assert found.stderr.count("\n") == 1 and "Traceback" not in found.stderr
