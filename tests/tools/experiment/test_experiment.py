"""The experiment as a whole, in small: common random numbers, cache, resumption, report."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vibrissa.tools.experiment import design, paper, tasks
from vibrissa.tools.experiment.mapping import MapCase, noisy, run_map
from vibrissa.tools.experiment.recording import IMAGES, Recording, RigCase, plant_params, record
from vibrissa.tools.experiment.tasks import Work, mapped, missing, recorded, rig_key, run_all

MAZE = """\
+---+---+
|       |
+   +   +
|   |   |
+   +---+
| S     |
+---+---+
"""
RIG = RigCase(MAZE, 5, "rcp", "CC", speed=0.2, calibration_cycles=1)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(RIG)


def test_a_recording_covers_its_circuits_and_feels_something(recording: Recording) -> None:
    assert set(recording.circuit) == {0, 1}
    assert (recording.images > 0).any(axis=(0, 2)).all()
    assert (np.diff(recording.cycle) == 1).all()


def test_control_schemes_share_path_and_odometry_noise(recording: Recording) -> None:
    other = record(replace(RIG, controller="open_loop"))
    np.testing.assert_array_equal(recording.truth, other.truth)
    np.testing.assert_array_equal(noisy(recording, "full", 5), noisy(other, "full", 5))
    assert (recording.images != other.images).any()


def test_what_is_varied_reaches_the_plant() -> None:
    usual = plant_params(RIG)
    changed = plant_params(replace(RIG, taper=10.0, noise=5.0, servo=0.03))
    assert changed.shaft_tip_diameter == changed.shaft_base_diameter
    assert changed.sensor_noise == 5.0 * usual.sensor_noise
    assert changed.servo_stiffness == 0.03


def test_blind_runs_see_one_image_and_shuffled_ones_the_same_images(recording: Recording) -> None:
    case = MapCase("contact_angle", 5)
    assert run_map(recording, replace(case, control="blind")).templates == 1
    seen = run_map(recording, case)
    shuffled = run_map(recording, replace(case, control="shuffled"))
    np.testing.assert_array_equal(seen.reckoned, shuffled.reckoned)
    assert shuffled.templates > 1


def test_kidnapping_cuts_whisks_and_leaves_no_jump_in_the_odometry(recording: Recording) -> None:
    plain = MapCase("contact_angle", 5, "full")
    cut = run_map(recording, replace(plain, skips=((1, 0.2, 0.3),)))
    whole = run_map(recording, plain)
    gone = len(whole.truth) - len(cut.truth)
    step = np.hypot(*np.diff(cut.truth[:, :2], axis=0).T)
    assert gone >= 1 and step.max() > 0.29
    assert cut.reckoned[:3].tobytes() == whole.reckoned[:3].tobytes()
    reckoned = np.hypot(*np.diff(cut.reckoned[:, :2], axis=0).T)
    assert reckoned.max() < 0.29


def test_the_cache_serves_what_was_made_and_only_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = MapCase("contact_angle", 5)
    first = mapped(tmp_path, RIG, case)
    monkeypatch.setattr(tasks, "record", lambda rig: pytest.fail("made again"))
    assert mapped(tmp_path, RIG, case) == first
    other = mapped(tmp_path, RIG, replace(case, threshold=0.05))  # maps anew, from the recording
    assert other["templates"] < first["templates"]
    assert rig_key(RIG) != rig_key(replace(RIG, servo=0.1))


def test_half_a_file_is_made_again(tmp_path: Path) -> None:
    whole = recorded(tmp_path, RIG)
    file = tmp_path / f"{rig_key(RIG)}.npz"
    file.write_bytes(file.read_bytes()[:1000])
    assert missing(tmp_path, [Work(RIG)]) == [Work(RIG)]
    assert recorded(tmp_path, RIG).images.tobytes() == whole.images.tobytes()


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    works = [Work(RIG, tuple(MapCase(image, 5) for image in IMAGES))]

    def interrupt(cost: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_all(tmp_path, works, 1, lambda rig: 10.0, interrupt)
    assert missing(tmp_path, works) == []
    run_all(tmp_path, works, 1, lambda rig: 10.0, lambda cost: pytest.fail("done again"))


def test_the_report_opens_alone_and_names_every_control(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(design, "maze_text", lambda: MAZE)
    monkeypatch.setattr(paper, "maze_text", lambda: MAZE)
    monkeypatch.setattr(design, "THRESHOLDS", (0.004,))
    monkeypatch.setattr("vibrissa.tools.experiment.analysis.THRESHOLDS", (0.004,))
    wanted = replace(design.scale(1, True), speed=0.2, sequence="CCAACA")
    results = paper.run_paper(wanted, 1, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert not re.search(r'(src|href)="(?!data:)', page), "the page needs something from outside"
    assert page.count("<img") == 7
    for word in ("blind", "shuffled", "its odometry", "templates", "to earlier circuits"):
        assert word in page
    for row in results["table"]:
        for name in ("arr", "templates", "experiences", "earlier", "em_whisk_all", "odo_whisk_all"):
            assert name in row["scores"]
    assert {row["control"] for row in results["table"]} == {"none", "blind", "shuffled"}
    assert results["scale"]["tuning_seeds"] and not set(results["scale"]["tuning_seeds"]) & set(
        results["scale"]["seeds"]
    )
