"""Verbs for live runs refuse in one line, and a new controller works from its first minute on."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.processes.swaps import experiment, identical, owners
from tests.tools.conftest import refused, vibrissa
from vibrissa.processes.config import load_experiment
from vibrissa.processes.controllers import make_controller
from vibrissa.processes.results import RunError
from vibrissa.processes.simulate import simulate
from vibrissa.tools.new_controller import FILES, write

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "half_amplitude_controller"
VERBS = {
    "controllers": (),
    "load": ("rcp",),
    "swap": ("rcp", "--at-cycle", "--blend", "0.1", "--param", "gain=4"),
    "rollback": (),
    "unload": ("rcp",),
    "set": ("rcp.gain", "4"),
}


@pytest.fixture(autouse=True)
def no_live_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine of our own, as far as live runs are concerned."""
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_with_an_example(verb: str) -> None:
    outcome = vibrissa(verb, "--help")
    assert outcome.code == 0
    assert f"Example: vibrissa {verb}" in " ".join(outcome.out.split())


@pytest.mark.parametrize("verb", VERBS)
def test_a_run_that_is_not_there_is_named(verb: str, tmp_path: Path) -> None:
    outcome = vibrissa(verb, *VERBS[verb], "--run", tmp_path / "none")
    assert refused(outcome, "no live run in", str(tmp_path / "none"), "vibrissa run")


def test_without_a_run_the_installed_controllers_are_shown() -> None:
    outcome = vibrissa("controllers", "--json")
    found = json.loads(outcome.out)
    assert outcome.code == 0
    assert found["installed"]["rcp"] == "built in" and found["loaded"] == []
    assert "open_loop" in vibrissa("controllers").out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("swap", "rcp", "--param", "gain"), ("--param gain", "KEY=VALUE")),
        (("load", "rcp", "--param", "a-b=1"), ("--param a-b=1", "KEY=VALUE")),
        (("set", "gain", "4"), ("'gain'", "NODE.KEY")),
        (("set", "rcp.", "4"), ("'rcp.'", "NODE.KEY")),
        (("new-controller", "Half-Amplitude"), ("'Half-Amplitude'", "lower-case")),
        (("new-controller", "rcp"), ("'rcp'", "built in")),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(
    arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    assert refused(vibrissa(*arguments), *words)


def test_a_new_controller_overwrites_nothing(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("precious")
    outcome = vibrissa("new-controller", "mine", "--out", tmp_path / "mine")
    assert refused(outcome, str(tmp_path / "mine"), "exists")
    assert [f.name for f in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_the_example_is_what_new_controller_writes(tmp_path: Path) -> None:
    outcome = vibrissa("new-controller", "half_amplitude", "--out", tmp_path / "new", "--json")
    assert outcome.code == 0
    written = [Path(p) for p in json.loads(outcome.out)["files"]]
    assert len(written) == len(FILES)
    for path in written:
        assert path.read_text() == (EXAMPLE / path.name).read_text()


def test_a_new_controllers_own_test_passes(tmp_path: Path) -> None:
    write("slow_poke", tmp_path)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the example installed, as pip does it."""
    folder = tmp_path_factory.mktemp("site")
    source = folder / "source"
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("__pycache__", "build"))
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--target", str(folder / "lib")]
    command = [sys.executable, "-m", "pip", "install", *options, str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / "lib"


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The example is installed, here and in the processes of a run."""
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), str(ROOT)]))
    yield
    sys.modules.pop("half_amplitude_controller", None)


@pytest.mark.usefixtures("installed")
def test_an_installed_controller_is_found_and_checks_its_parameters() -> None:
    listed = json.loads(vibrissa("controllers", "--json").out)["installed"]
    assert listed["half_amplitude"] == "half_amplitude_controller:HalfAmplitude (installed)"
    with pytest.raises(RunError, match="controller half_amplitude: share: found 7, expected 0"):
        make_controller("half_amplitude", load_experiment(), '{"share": 7}')


@pytest.mark.usefixtures("installed")
def test_an_installed_controller_is_swapped_in_and_the_log_re_runs(tmp_path: Path) -> None:
    made = experiment(tmp_path, duration=2.4, swaps=((4, "half_amplitude"),))
    summary = simulate(made, tmp_path / "run")
    got = owners(tmp_path / "run")
    assert summary["cause"] == "completed"
    switched = range(4 * made.period_ticks, made.retract_tick)
    assert {got[t] for t in switched} == {"whisk.1"}
    assert identical(tmp_path / "run")


def test_a_log_whose_controller_is_not_installed_says_so(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.syspath_prepend(str(site))
        made = experiment(tmp_path, duration=1.6, swaps=((4, "half_amplitude"),))
        simulate(made, tmp_path / "run")
        sys.modules.pop("half_amplitude_controller")
    for executor in ("fused", "lockstep"):
        outcome = vibrissa("verify", tmp_path / "run", "--executor", executor)
        assert refused(outcome, "controller half_amplitude is not installed", "whisk.1", "rcp")


def test_a_log_whose_first_controller_is_not_installed_says_so(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.syspath_prepend(str(site))
        made = load_experiment(duration=1.2, controller="half_amplitude")
        simulate(made, tmp_path / "run")
        sys.modules.pop("half_amplitude_controller")
    assert refused(
        vibrissa("verify", tmp_path / "run"),
        "whisk can't be made",
        "controller half_amplitude is not installed",
    )
