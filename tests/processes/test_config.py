"""Experiment files: what is wrong is named with key, value and what is allowed, in one line."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from pydantic import ValidationError

from vibrissa.processes.config import DEFAULT_MAZE, Experiment, Section, load_experiment
from vibrissa.processes.emulators import head_cores
from vibrissa.processes.results import RunError
from vibrissa.processes.run_plan import layout_of_run

RAGGED = "+---+---+\n|   |\n+   +---+\n|  |    |\n+---+---+\n"
SQUARE = "+---+---+\n|       |\n+   +   +\n|       |\n+---+---+\n"


def refusal(folder: Path, text: str, **overrides: object) -> str:
    path = folder / "bad.toml"
    path.write_text(text)
    with pytest.raises(RunError) as caught:
        load_experiment(path, **overrides)  # type: ignore[arg-type]
    line = str(caught.value)
    assert line.isprintable() and line.startswith(str(path)) and len(line) < 1000
    return line


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[run]\nduraton = 3", ("run.duraton", "unknown key", "duration")),
        ("[runn]\nduration = 3", ("runn", "unknown key", "run")),
        ("duration = 3", ("duration", "unknown key")),
        ("[run]\nduration = 0.5", ("run.duration", "0.5", "1")),
        ("[run]\nduration = -3", ("run.duration", "-3")),
        ("[run]\nduration = nan", ("run.duration", "nan")),
        ("[run]\nduration = inf", ("run.duration", "inf")),
        ("[run]\nduration = 1e9", ("run.duration", "1000000000", "604800")),
        ("[run]\nduration = 'long'", ("run.duration", "long", "number")),
        ("[run]\nduration = [3]", ("run.duration", "[3]")),
        ("[run]\nseed = -1", ("run.seed", "-1", "0")),
        ("[run]\nseed = 1.5", ("run.seed", "1.5", "integer")),
        ("[run]\nseed = 99999999999", ("run.seed", "99999999999")),
        ("[run]\ntransport = 'udp'", ("run.transport", "udp", "ipc")),
        ("[run]\ntcp_port = 80", ("run.tcp_port", "80", "1024")),
        ("[run]\ntogether = [['sampler', 'whisker']]", ("run.together", "whisker", "whisk")),
        ("[run]\ntogether = [['arm'], ['arm']]", ("run.together", "arm", "twice")),
        ("[run]\ntogether = 'all'", ("run.together", "all", "list")),
        ("run = 3", ("run", "3")),
        ("[head]\nmotor_stiffness = 0", ("head.motor_stiffness", "0", "greater")),
        ("[head]\nmoment_noise = 1.0", ("head.moment_noise", "1.0", "0.001")),
        ("[head]\nangle_noise = nan", ("head.angle_noise", "nan", "finite")),
        ("[whisk]\ncontroller = 'pid'", ("controller", "pid", "open_loop", "rcp")),
        ("[whisk]\ncontroller = 7", ("whisk.controller", "7", "string")),
        ("[whisk]\nperiod = 99", ("whisk.period", "99", "10")),
        ("[whisk]\ncalibration_cycles = 0", ("whisk.calibration_cycles", "0", "1")),
        ("[arm]\nsequence = 'CXA'", ("arm.sequence", "CXA")),
        ("[arm]\nspeed = 0", ("arm.speed", "0", "greater")),
        ("[arm]\nspeed = 0.3", ("arm.speed", "0.3", "0.25")),
        ("[arm]\nlift = -0.1", ("arm.lift", "-0.1")),
        ("[maze]\nfile = 'nowhere.maze'", ("maze.file", "nowhere.maze", DEFAULT_MAZE)),
        ("[maze]\nfile = ''", ("maze.file",)),
        ("[maze]\nfile = '.'", ("maze.file", "'.'")),
        ("[maze]\nfile = 'ragged.maze'", ("ragged.maze", "line 4")),
        ("[maze]\nfile = 'binary.maze'", ("binary.maze", "text")),
        ("[slam]\npreset = 'best'", ("slam.preset", "best", "whisker")),
        ("[slam]\nimage = 'photo'", ("slam.image", "photo", "contact_angle")),
        ("[slam]\nodometry_noise = 'much'", ("slam.odometry_noise", "much", "none")),
        ("[slam.parameters]\nvt_threshold = 1", ("slam.parameters.vt_threshold",)),
        ("[slam.parameters]\nvt_match_threshold = 'low'", ("slam.parameters.vt_match_threshold",)),
        ("[run\n", ("not a TOML file", "line 1")),
        ("[run]\nseed = 1\nseed = 2", ("not a TOML file",)),
    ],
)
def test_a_mistake_is_named_with_key_value_and_what_is_allowed(
    text: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "ragged.maze").write_text(RAGGED)
    (tmp_path / "binary.maze").write_bytes(b"\xff\xfe\x00\x80")
    line = refusal(tmp_path, text + "\n")
    for word in words:
        assert word in line, line


def test_nodes_may_share_the_process_of_a_real_head(tmp_path: Path) -> None:
    path = tmp_path / "joined.toml"
    path.write_text(
        """[run]\ntogether = [["whisk", "rig", "sampler"]]\n[rig]\nhead = "serial:/dev/ttyACM0"\n"""
    )
    experiment = load_experiment(path)
    assert head_cores(experiment) == "any" and head_cores(Experiment()) == "reflex"
    layout = layout_of_run(experiment, tmp_path, tmp_path, {})
    joined = "head-device+sampler+whisk"
    assert layout.hosts[joined] == ["head-device", "sampler", "whisk"]
    assert set(layout.hosts) == {joined, "arm-device", "arm", "slam"}
    assert "head.command" in layout.says(joined) and "head.command" not in layout.hears(joined)
    assert {"rig.arm", "rig.event", "run.event"} <= set(layout.hears(joined))
    assert layout.metadata["nodes"] == "sampler,whisk,arm,slam"


def test_several_mistakes_are_named_together(tmp_path: Path) -> None:
    line = refusal(tmp_path, "[run]\nseed = -1\nduraton = 3\n[arm]\nspeed = 0\n")
    assert all(key in line for key in ("run.seed", "run.duraton", "arm.speed"))


def test_a_file_that_is_missing_or_no_text_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"none\.toml: No such file"):
        load_experiment(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(RunError, match=r"bytes\.toml: not a TOML file"):
        load_experiment(tmp_path / "bytes.toml")
    with pytest.raises(RunError, match=f"{tmp_path}: Is a directory"):
        load_experiment(tmp_path)


def test_an_override_is_checked_like_what_stands_in_the_file(tmp_path: Path) -> None:
    assert "run.duration" in refusal(tmp_path, "", duration=0.0)
    assert "run.seed" in refusal(tmp_path, "", seed=-5)
    assert "pid" in refusal(tmp_path, "", controller="pid")


def test_an_override_replaces_what_stands_in_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("[run]\nduration = 9\nseed = 3\n")
    made = load_experiment(tmp_path / "a.toml", duration=4.0, controller="open_loop")
    assert (made.run.duration, made.run.seed, made.whisk.controller) == (4.0, 3, "open_loop")


def test_without_a_file_there_is_a_default_experiment() -> None:
    made = load_experiment()
    assert made.maze.file == DEFAULT_MAZE and made.maze.text.startswith(("+", "o"))
    assert made.run.seed == Experiment().run.seed


def test_a_maze_is_found_beside_the_experiment_and_travels_with_it(tmp_path: Path) -> None:
    (tmp_path / "own.maze").write_text(SQUARE)
    (tmp_path / "a.toml").write_text("[maze]\nfile = 'own.maze'\n")
    made = load_experiment(tmp_path / "a.toml")
    assert made.maze.text == SQUARE
    (tmp_path / "own.maze").unlink()
    assert Experiment.model_validate_json(made.model_dump_json()) == made


def test_an_experiment_survives_the_way_through_json_to_the_bit() -> None:
    made = load_experiment(duration=3.3, seed=123)
    text = made.model_dump_json()
    assert Experiment.model_validate_json(text).model_dump_json() == text


def test_an_experiment_can_not_be_changed() -> None:
    with pytest.raises(ValidationError):
        load_experiment().run.seed = 5  # type: ignore[misc]


def test_times_are_whole_ticks_and_the_last_half_second_is_for_retracting() -> None:
    made = load_experiment(duration=3.0)
    assert (made.ticks, made.retract_tick) == (6000, 5000)
    assert made.period_ticks == round(2000 * made.whisk.period)


@pytest.mark.parametrize("section", [s for s, v in Experiment() if isinstance(v, Section)])
def test_every_key_can_be_set_in_a_file_to_what_it_is_by_default(
    section: str, tmp_path: Path
) -> None:
    for key, value in Experiment().model_dump()[section].items():
        if value in ("", {}, []) or value is None:
            continue
        shown = str(value).lower() if isinstance(value, bool) else repr(value)
        text = f"[{section}]\n{key} = {shown}\n"
        assert tomllib.loads(text) == {section: {key: value}}
        (tmp_path / "a.toml").write_text(text)
        assert load_experiment(tmp_path / "a.toml") == load_experiment()
