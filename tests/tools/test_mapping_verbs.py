"""Datasets, tuning, figures and export: what they say is what the log holds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.tools import file_interface

from tests.tools.conftest import Outcome, refused, rewrite, vibrissa
from tests.tools.mapping import PLACES, SENSES, write_log
from vibrissa.messages.log_format import Record
from vibrissa.processes.config import load_experiment
from vibrissa.processes.results import UnusableLogError
from vibrissa.processes.slams import make_slam_config
from vibrissa.slam.interface import Odometry
from vibrissa.slam.metrics import energy_metric, experience_metric, first_circuit, fixed_interval
from vibrissa.slam.ratslam import RatSlam
from vibrissa.slam.tuning import dead_reckoning
from vibrissa.tools import tune
from vibrissa.tools.dataset import DatasetError, load
from vibrissa.tools.figures import FIGURES, aligned, draw_experiences, draw_map, draw_odometry
from vibrissa.tools.tune import one_thread, parse_axis

AXES = (
    "--axis=vt_match_threshold=0.001,0.002,0.004",
    "--axis=pc_vt_inject_energy=0.1",
    "--axis=pc_dim_xy=21",
    "--axis=pc_cell_x_size=0.06",
    "--axis=exp_delta_pc_threshold=1.0",
)


@pytest.fixture(scope="module")
def tuned(mapped: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Outcome, Path]:
    out = tmp_path_factory.mktemp("tuned")
    return vibrissa("tune", mapped, *AXES, "--out", out, "--jobs", 2, "--json"), out


def test_a_dataset_drives_slam_to_the_recorded_experiences(mapped: Path) -> None:
    data = load(mapped / "run.mcap")
    assert len(data) == len(SENSES) * PLACES - 1
    assert data.cycles.tolist() == list(range(1, len(data) + 1))
    slam = RatSlam(make_slam_config(data.experiment))
    images = data.images[data.experiment.slam.image]
    for k, (v, w, dt) in enumerate(data.odometry.tolist()):
        step = slam.step(images[k], Odometry(v, w, dt))
        assert (step.experience, step.action) == (data.experience[k], data.action[k])
        assert step.template == data.template[k]
        assert [step.x, step.y, step.heading] == data.estimate[k].tolist()
    assert data.map is not None
    assert (slam.map().poses == data.map.poses).all()
    assert (data.images["contact_angle"] == 255 - images).all()


def test_logs_that_are_no_dataset_are_refused_by_name(mapped: Path, tmp_path: Path) -> None:
    blind = write_log(tmp_path / "blind.mcap", views=False)
    with pytest.raises(DatasetError, match=r"expected slam.view messages, found none"):
        load(blind)

    def without_truth(record: Record) -> Record | None:
        return None if record.topic == "slam.pose" else record

    lost = rewrite(mapped / "run.mcap", tmp_path / "lost.mcap", without_truth)
    with pytest.raises(DatasetError, match=r"expected slam.pose messages.*no ground truth"):
        load(lost)
    with pytest.raises(UnusableLogError, match="no such file"):
        load(tmp_path / "none.mcap")
    for verb, option in (("tune", "--out"), ("export", "--tum")):
        assert refused(vibrissa(verb, blind, option, tmp_path / "x"), "slam.view")

    def half_a_lap(record: Record) -> Record | None:
        return record if record.t < PLACES // 2 * 10**9 else None

    short = rewrite(mapped / "run.mcap", tmp_path / "short.mcap", half_a_lap)
    outcome = vibrissa("tune", short, "--out", tmp_path / "x")
    assert refused(outcome, "more than one circuit")


def test_the_sweep_holds_every_point_with_its_controls(tuned: tuple[Outcome, Path]) -> None:
    outcome, out = tuned
    assert outcome.code == 0, outcome.err
    found = json.loads(outcome.out)
    thresholds = [trial["point"]["vt_match_threshold"] for trial in found["trials"]]
    assert thresholds == [0.001, 0.002, 0.004]
    for trial in found["trials"]:
        assert trial["blind"]["templates"] == 1
        assert trial["touch"]["templates"] == 2 * PLACES
        assert trial["touch"]["earlier_right"] > trial["blind"]["earlier_right"]
        assert trial["touch"]["whisks"].keys() == {"consecutive", "interval", "all"}
    assert found["stage"] == "stable"
    assert found["chosen"]["vt_match_threshold"] == 0.002
    assert "both controls" in found["reason"]
    assert (out / "tune.png").read_bytes().startswith(b"\x89PNG")


def test_a_point_scores_as_the_log_does(tuned: tuple[Outcome, Path], mapped: Path) -> None:
    """At the parameters of the run, the sweep's Experience Metric is that of the log."""
    outcome = vibrissa(
        "tune",
        mapped,
        "--axis=vt_match_threshold=0.002",
        "--axis=pc_vt_inject_energy=0.02",
        *AXES[2:],
        "--out",
        tuned[1] / "one",
        "--jobs",
        1,
        "--json",
    )
    touch = json.loads(outcome.out)["trials"][0]["touch"]
    data = load(mapped / "run.mcap")
    metric = experience_metric(data.experience, data.truth, first_circuit(data.truth))
    assert (touch["arr"], touch["arcr"]) == (metric.arr, metric.arcr)
    assert touch["experiences"] == len(data.map.poses)
    odometry = json.loads(outcome.out)["odometry"]["consecutive"]
    expected = energy_metric(dead_reckoning(data.odometry), data.truth, fixed_interval(len(data)))
    assert odometry["rotation"] == pytest.approx(expected.rotation)


def test_the_chosen_parameters_are_an_experiment_that_runs(
    tuned: tuple[Outcome, Path], mapped: Path
) -> None:
    outcome, out = tuned
    experiment = load_experiment(out / "tuned.toml")
    chosen = json.loads(outcome.out)["chosen"]
    assert dict(experiment.slam.parameters) == chosen
    config = make_slam_config(experiment)
    assert all(getattr(config, name) == value for name, value in chosen.items())
    base = make_slam_config(load(mapped / "run.mcap").experiment)
    assert replace(config, **{n: getattr(base, n) for n in chosen}) == base


def test_the_sweep_is_told_as_tables(mapped: Path, tmp_path: Path) -> None:
    outcome = vibrissa("tune", mapped, *AXES[1:], AXES[0][:-6], "--out", tmp_path, "--jobs", 1)
    assert outcome.code == 0, outcome.err
    assert "Energy Metric" in outcome.out and "chosen (" in outcome.out
    assert "vt_match_threshold = " in outcome.out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("vt_match_threshold", "expected NAME=V1,V2"),
        ("vt_match_threshold=a", "expected NAME=V1,V2"),
        ("=1", "expected NAME=V1,V2"),
    ],
)
def test_malformed_axes_are_refused(mapped: Path, text: str, message: str) -> None:
    outcome = vibrissa("tune", mapped, "--axis", text)
    assert outcome.code == 2
    assert message in outcome.err.replace("\n", " ")


def test_unknown_and_impossible_parameters_are_refused(mapped: Path, tmp_path: Path) -> None:
    for axis, words in (
        ("warp=1", ("grid warp", "no such RatSLAM parameter")),
        ("pc_dim_xy=-3", ("grid pc_dim_xy", "expected > 0")),
    ):
        assert refused(vibrissa("tune", mapped, "--axis", axis, "--out", tmp_path), *words)
    assert parse_axis("pc_dim_xy=11,21") == ("pc_dim_xy", (11, 21))
    assert parse_axis("pc_cell_x_size=1e-2,.5") == ("pc_cell_x_size", (0.01, 0.5))


def test_workers_have_one_thread_and_the_parent_keeps_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    with one_thread():
        assert all(tune.os.environ[name] == "1" for name in tune.ONE_THREAD)
    assert tune.os.environ["OMP_NUM_THREADS"] == "7"
    assert "NUMBA_NUM_THREADS" not in tune.os.environ


def test_plot_writes_the_overview_and_the_papers_figures(mapped: Path, tmp_path: Path) -> None:
    outcome = vibrissa("plot", mapped, "--out", tmp_path / "pictures")
    assert outcome.code == 0, outcome.err
    names = {path.name for path in (tmp_path / "pictures").iterdir()}
    assert names == {"run.png", *(f"{name}.png" for name in FIGURES)}
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in (tmp_path / "pictures").iterdir())


def test_figures_hold_the_logs_numbers(mapped: Path) -> None:
    data = load(mapped / "run.mcap")
    ax = draw_experiences(data).axes[0]
    drawn = np.concatenate([np.asarray(line.get_xdata()) for line in ax.lines[2:5]])
    assert sorted(drawn) == list(range(len(data)))
    metric = experience_metric(data.experience, data.truth, first_circuit(data.truth))
    assert f"correct re-localisation ({metric.correct})" in [
        str(text.get_text()) for text in ax.get_legend().get_texts()
    ]
    assert f"ARR {metric.arr:.3f}" in ax.get_title(loc="left")
    plan = draw_odometry(data).axes[0]
    x, y = (np.asarray(v) for v in plan.lines[0].get_data())
    first = data.truth[: len(x), :2]
    np.testing.assert_array_equal(np.column_stack([x, y]), first)
    before, after = draw_map(data).axes
    assert {line.get_color() for line in before.lines} == {"tab:red", "tab:green"}
    points = sum(len(np.asarray(line.get_xdata())) for line in after.lines)
    assert points == len(data.map.poses)


def test_alignment_undoes_a_rigid_motion() -> None:
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(20, 3))
    c, s = np.cos(2.0), np.sin(2.0)
    moved = np.column_stack(
        [truth[:, :2] @ np.array([[c, s], [-s, c]]) + [3.0, -1.0], truth[:, 2] + 2.0]
    )
    np.testing.assert_allclose(aligned(moved, truth), truth, atol=1e-12)


def test_export_writes_three_trajectories(mapped: Path, tmp_path: Path) -> None:
    outcome = vibrissa("export", mapped, "--tum", tmp_path / "tum")
    assert outcome.code == 0, outcome.err
    data = load(mapped / "run.mcap")
    for name, poses in (
        ("truth", data.truth),
        ("odometry", dead_reckoning(data.odometry)),
        ("estimate", data.estimate),
    ):
        rows = np.loadtxt(tmp_path / "tum" / f"{name}.tum")
        np.testing.assert_allclose(rows[:, 0], data.times, atol=1e-9)
        np.testing.assert_allclose(rows[:, 1:3], poses[:, :2], atol=1e-9)
        np.testing.assert_allclose(
            np.exp(2j * np.arctan2(rows[:, 6], rows[:, 7])), np.exp(1j * poses[:, 2]), atol=1e-8
        )


def test_exported_trajectories_are_what_evo_reads(mapped: Path, tmp_path: Path) -> None:
    vibrissa("export", mapped, "--tum", tmp_path)
    paths = [
        file_interface.read_tum_trajectory_file(tmp_path / f"{name}.tum")
        for name in ("truth", "estimate")
    ]
    data = load(mapped / "run.mcap")
    found = energy_metric(data.estimate, data.truth, fixed_interval(len(data)))
    for part, expected in (
        (evo_metrics.PoseRelation.translation_part, found.translation),
        (evo_metrics.PoseRelation.rotation_angle_rad, found.rotation),
    ):
        rpe = evo_metrics.RPE(part, delta=1, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        rpe.process_data(tuple(paths))
        rmse = rpe.get_statistic(evo_metrics.StatisticsType.rmse)
        assert rmse**2 == pytest.approx(expected, rel=1e-6, abs=1e-9)
