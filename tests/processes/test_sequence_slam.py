"""The sequence SLAM as the run's SLAM: chosen, swapped with RatSLAM, logged and re-run."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from tests.processes.test_swap_between_cycles import said
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.results import RunError
from vibrissa.processes.simulate import simulate
from vibrissa.processes.slams import make_sequence_config, make_slam, make_slam_config
from vibrissa.processes.verify import verify
from vibrissa.slam.config import WHISKER

CORNERS = """\
+---+---+
|       |
+   +   +
|       |
+---+---+
"""


CRANK = """\
+---+---+---+
|   |       |
+   +---+   +
|       |   |
+---+---+---+
"""


takes_minutes = pytest.mark.skipif(
    not os.environ.get("VIBRISSA_ALL_TESTS"), reason="takes minutes: VIBRISSA_ALL_TESTS=1"
)


def made(
    folder: Path,
    slam: str,
    swaps: str = "",
    duration: float = 9.0,
    maze: str = CORNERS,
    sequence: str = "CCCCCC",
) -> Experiment:
    (folder / "corners.maze").write_text(maze)
    path = folder / "experiment.toml"
    path.write_text(
        f"""\
[run]
duration = {duration}
[maze]
file = "corners.maze"
[whisk]
period = 0.4
calibration_cycles = 1
[arm]
speed = 0.25
lift = 0.05
sequence = "{sequence}"
[slam]
{"" if "image =" in slam else 'image = "contact_angle"'}
{slam}
{swaps}
"""
    )
    return load_experiment(path)


def swap(cycle: int, to: str) -> str:
    return f'[[swap]]\nnode = "slam"\nat_cycle = {cycle}\nto = "{to}"\n'


def test_ratslam_hands_over_to_the_sequence_slam_and_back_and_the_log_re_runs(
    tmp_path: Path,
) -> None:
    out = tmp_path / "run"
    swaps = swap(12, "sequence") + swap(16, "ratslam")
    summary = simulate(made(tmp_path, "", swaps), out)
    assert summary["cause"] == "completed"
    assert [o.controller for o in said(out, "slam.owner")["slam"]] == ["slam.1", "slam"]
    first, other = (said(out, "slam.pose")[name] for name in ("slam", "slam.1"))
    assert {p.cycle for p in other} == {p.cycle for p in first}
    # an experience of the sequence SLAM is a whisk, and places seen again are too few here
    assert [p.experience for p in other] == list(range(len(other)))
    for executor in ("fused", "lockstep"):
        verdict = verify(out / "run.mcap", executor)
        assert verdict.identical, verdict.first_difference
        assert verdict.notes == ()


def test_as_the_runs_first_slam_it_maps_every_whisk_and_the_log_re_runs(tmp_path: Path) -> None:
    parameters = 'algorithm = "sequence"\nparameters = { lag = 10, gap = 6 }'
    out = tmp_path / "run"
    experiment = made(tmp_path, parameters, swap(14, "ratslam"))
    assert simulate(experiment, out)["cause"] == "completed"
    assert [o.controller for o in said(out, "slam.owner")["slam"]] == ["slam.1"]
    seen = said(out, "slam.view")["slam"]
    last = said(out, "slam.map")["slam"][-1]
    assert len(last.poses) == len(seen) > 8
    contacts = {tuple(view.contact_angle > 0) for view in seen}
    assert max(view.template for view in seen) == len(contacts) - 1
    verdict = verify(out / "run.mcap")
    assert verdict.identical, verdict.first_difference


@takes_minutes
def test_loops_that_were_closed_in_a_run_are_closed_again_to_the_byte(tmp_path: Path) -> None:
    slam = (
        'algorithm = "sequence"\nodometry_noise = "third"\nparameters = { lag = 2, gap = 3,'
        " evidence = 1.0, certain = 0.6, enter = 0.02, leave = 0.02, gate = 8.0 }"
    )
    out = tmp_path / "run"
    experiment = made(tmp_path, slam, duration=35.5, maze=CRANK, sequence="CACA")
    assert simulate(experiment, out)["cause"] == "completed"
    last = said(out, "slam.map")["slam"][-1]
    loops = last.links[len(last.poses) - 1 :]
    poses = said(out, "slam.pose")["slam"]
    place = np.array([pose.truth[:2] for pose in poses])
    apart = np.hypot(*(place[loops[:, 0]] - place[loops[:, 1]]).T)
    assert len(loops) >= 3 and np.median(apart) < 0.1, "loops join whisks at one place"
    known = [pose.experience < k for k, pose in enumerate(poses)]
    assert any(known), "places were recognised on the way"
    for executor in ("fused", "lockstep"):
        verdict = verify(out / "run.mcap", executor)
        assert verdict.identical, verdict.first_difference


@pytest.mark.parametrize(
    ("slam", "words"),
    [
        ("parameters = { lag = 100 }", "slam.parameters.lag: no such RatSLAM parameter"),
        (
            'algorithm = "sequence"\nparameters = { vt_match_threshold = 0.1 }',
            "slam.parameters.vt_match_threshold: no such parameter of the sequence SLAM",
        ),
        (
            'algorithm = "sequence"\nparameters = { window = 1 }',
            "slam.parameters.window: expected 2 to 100000, found 1",
        ),
        (
            'algorithm = "sequence"\nparameters = { odometer_turn = 0.0 }',
            "slam.parameters.odometer_turn: expected a finite number > 0, found 0.0",
        ),
        (
            'image = "max_angle_gated"\nalgorithm = "sequence"\nparameters = { compass = true }',
            "slam.parameters.compass: expected slam.image 'contact_angle' with it",
        ),
        ('algorithm = "cartographer"', "'cartographer': expected one of ratslam, sequence"),
    ],
)
def test_a_bad_parameter_is_refused_in_one_line(slam: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(RunError) as caught:
        made(tmp_path, slam)
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"lag": 1.5}, "slam.parameters.lag: expected int, found 1.5"),
        ({"odometer_turn": True}, "slam.parameters.odometer_turn: expected a number, found True"),
    ],
)
def test_a_bad_parameter_of_a_load_is_refused(
    parameters: dict[str, object], words: str, tmp_path: Path
) -> None:
    experiment = made(tmp_path, "")
    with pytest.raises(RunError, match=words):
        make_slam("sequence", experiment, json.dumps(parameters))


def test_parameters_of_the_section_are_those_of_its_algorithm(tmp_path: Path) -> None:
    experiment = made(tmp_path, 'algorithm = "sequence"\nparameters = { lag = 7 }')
    assert make_sequence_config(experiment, {"odometer_turn": 0.5}).lag == 7
    assert make_sequence_config(experiment, {"odometer_turn": 0.5}).odometer.turn == 0.5
    assert make_slam_config(experiment) == WHISKER
    assert make_sequence_config(made(tmp_path, "")).lag == 100
