"""`vibrissa calibrate odometry`: from a drive to a file, from the file to a run, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.tools.conftest import vibrissa
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.results import RunError
from vibrissa.processes.slams import make_sequence_config
from vibrissa.slam.odometry import NOISE_MODELS

DRIVE = """\
[maze]
file = "corners.maze"
[whisk]
period = 0.4
calibration_cycles = 1
[arm]
speed = 0.25
lift = 0.05
[slam]
odometry_noise = "third"
"""
CORNERS = """\
+---+---+
|       |
+   +   +
|       |
+---+---+
"""


def experiment_file(folder: Path, more: str = "") -> Path:
    (folder / "corners.maze").write_text(CORNERS)
    path = folder / "rig.toml"
    path.write_text(DRIVE + more)
    return path


def content(noise: str = "third", **changes: object) -> str:
    odometer = {"distance": 0.002, "distance_share": 0.1, "turn": 0.03, "turn_share": 0.0}
    found = {"vibrissa_odometer": 1, "odometry_noise": noise, "odometer": odometer | changes}
    return json.dumps(found)


def test_a_drive_finds_the_noise_of_the_odometry_and_a_run_takes_it_from_the_file(
    tmp_path: Path,
) -> None:
    made = tmp_path / "odometer.json"
    arguments = ("--circuits", "1", "--out", made)
    done = vibrissa("calibrate", "odometry", experiment_file(tmp_path), *arguments)
    assert done.code == 0, done.err
    assert f'[slam] odometer = "{made}"' in done.err and str(made) in done.out
    found = json.loads(made.read_text())
    assert min(found["straights"], found["turns"]) >= 8
    assert found["odometry_noise"] == "third" and found["date"] and found["run_id"]
    model = NOISE_MODELS["third"]
    assert found["odometer"]["distance"] == pytest.approx(model.distance, rel=0.5)
    assert found["odometer"]["turn"] == pytest.approx(model.angle, rel=0.5)

    run = load_experiment(experiment_file(tmp_path, 'odometer = "odometer.json"\n'))
    made.unlink()
    from_its_log = Experiment.model_validate_json(run.model_dump_json())
    config = make_sequence_config(from_its_log, {"odometer_turn_share": 0.3})
    assert config.odometer.distance == found["odometer"]["distance"]
    assert config.odometer.turn == found["odometer"]["turn"]
    assert config.odometer.turn_share == 0.3, "a parameter goes before the file"


def test_a_recorded_run_without_enough_motion_is_refused(simulated: Path, tmp_path: Path) -> None:
    made = tmp_path / "odometer.json"
    done = vibrissa("calibrate", "odometry", simulated, "--out", made)
    assert done.code == 2 and not made.exists()
    assert str(simulated) in done.err and len(done.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "expected a file of vibrissa calibrate odometry"),
        ("[1]", "expected a file of vibrissa calibrate odometry"),
        (content().replace("0.03", '"far"'), "expected a file of vibrissa calibrate odometry"),
        (content(turn=-1.0), "odometer turn: expected a finite number > 0, found -1.0"),
        (content(speed=1.0), "expected a file of vibrissa calibrate odometry"),
        (content().replace('_odometer": 1', '_odometer": 9'), "expected odometer format 1"),
        (content("full"), "is of odometry_noise 'full', slam.odometry_noise is 'third'"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(RunError) as caught:
        load_experiment(experiment_file(tmp_path, 'odometer = "bad.json"\n'))
    assert words in str(caught.value) and "bad.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_wrong_word_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"slam\.odometer 'none\.json': No such file"):
        load_experiment(experiment_file(tmp_path, 'odometer = "none.json"\n'))
    done = vibrissa("calibrate", "wheels", tmp_path / "rig.toml")
    assert done.code == 2 and "expected head or odometry" in " ".join(done.err.split())
