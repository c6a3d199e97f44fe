"""`vibrissa bench slam` measures what it says, at small sizes."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from tests.tools.conftest import vibrissa
from vibrissa.processes.results import silent
from vibrissa.slam.optimum import map_cost
from vibrissa.tools import bench_slam, bench_slam_stress
from vibrissa.tools.slam_accuracy import precision_rows, relaxation_front
from vibrissa.tools.slam_speed import SMALL, exponent, library, wandered_map


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    out = tmp_path_factory.mktemp("bench")
    cores = os.sched_getaffinity(0)
    outcome = vibrissa("bench", "slam", "--quick", "--json", "--out", out)
    assert outcome.code == 0, outcome.err
    assert os.sched_getaffinity(0) == cores
    return json.loads(outcome.out), out


def test_every_part_is_measured_beside_its_peers(found: tuple[dict, Path]) -> None:
    rows, _ = found[0]["rows"], found[1]
    speeds = {row["what"]: row for row in rows if "plain NumPy us" in row}
    assert speeds["pose cells 11x11x36"]["OpenRatSLAM us"] == 580
    assert all(row["us"] > 0 for row in speeds.values())
    columns = set().union(*(row.keys() for row in rows))
    assert columns >= {
        "ns per link visit",
        "exponent",
        "bytes each",
        "grid",
        "pc_global_inhib",
        "cost over optimum",
        "different ids or errors",
    }
    assert (found[1] / "bench-slam.png").read_bytes().startswith(b"\x89PNG")


def test_pruning_has_no_error(found: tuple[dict, Path]) -> None:
    pruning = [row for row in found[0]["rows"] if "different ids or errors" in row]
    assert len(pruning) == 2
    assert all(row["different ids or errors"] == 0 for row in pruning)
    target = next(t for t in found[0]["targets"] if "differ" in t["name"])
    assert target["met"]


def test_relaxation_approaches_the_optimum_from_above() -> None:
    front = relaxation_front(90)
    costs = [row["cost over optimum"] for row in front]
    assert costs[-1] == 1.0
    assert min(costs[:-1]) > 1.0
    assert costs[-2] < 0.5 * costs[0]
    distances = [row["rms distance mm"] for row in front]
    assert distances[-1] == pytest.approx(0.0, abs=1e-9)
    assert distances[-2] < distances[0]


def test_single_precision_moves_the_packet_a_little_and_double_is_the_measure() -> None:
    double, single = precision_rows(60)
    assert (double["precision"], single["precision"]) == ("double", "single")
    assert double["error mm"] == 0.0
    # the rounding of single precision is there, and stays far below the 60 mm of a cell
    assert 1e-7 < single["error mm"] < 1.0
    assert double["us"] > 0.0
    assert single["us"] > 0.0


def test_the_map_that_is_relaxed_has_something_to_relax() -> None:
    emap = wandered_map(90)
    assert map_cost(emap.poses, emap.links(), emap.link_values()) > 1e-4


@pytest.mark.parametrize("equal", [False, True])
def test_a_library_holds_what_it_says(equal: bool) -> None:
    view, unseen, seen = library(SMALL, 200, equal)
    means = view.templates.mean(axis=(1, 2))
    assert len(view) == 200
    assert bool(np.ptp(means) < 1e-12) is equal
    assert len(seen) == 50
    errors = [view.nearest(query, float(query.mean()))[1] for query in seen]
    assert max(errors) <= 1 / 255 + 1e-12
    assert min(view.nearest(query, float(query.mean()))[1] for query in unseen) > 1 / 255


def test_a_fitted_exponent_is_the_slope() -> None:
    sizes = [10, 100, 1000]
    assert exponent(sizes, [n**1.5 for n in sizes]) == pytest.approx(1.5)


def test_stress_finds_no_drift_and_every_input_has_an_outcome() -> None:
    result = bench_slam_stress.bench(Path(), 0.0, silent, quick=True)
    assert all(target.met for target in result.targets)
    inputs = {row["input"]: row["outcome"] for row in result.rows if "input" in row}
    assert inputs["no motion"].startswith("finite")
    assert inputs["steps of 1e5 cells"].startswith("SlamInputError: odometry v")
    assert inputs["an empty map"].startswith("ExperienceMapError")
    assert len(inputs) >= 14


def test_stress_counts_an_input_without_an_outcome() -> None:
    rows = [{"input": "a", "outcome": "! NaN"}, {"input": "b", "outcome": "finite"}]
    assert bench_slam_stress.failures(rows) == 1


def test_targets_are_judged_by_the_measured_rows() -> None:
    speeds = [
        {"what": "pose cells 11x11x36", "us": 20.0},
        {"what": "18 pixels, 10000 templates, spread", "us": math.nan},
        {"what": "18 pixels, 100000 templates, equal", "us": 99.0},
    ]
    relaxation = [{"experiences": 5000, "ns per link visit": 23.0}]
    pruning = [{"different ids or errors": 1}]
    met = [(t.name, t.bound, t.met) for t in bench_slam.targets(speeds, relaxation, pruning)]
    assert [row[2] for row in met] == [True, False, False, True, False, False]


def test_only_benches_with_a_short_form_take_quick(tmp_path: Path) -> None:
    outcome = vibrissa("bench", "replay", "--quick", "--out", tmp_path)
    assert outcome.code == 2
    said = " ".join(outcome.err.replace("│", " ").split())  # without the box around it
    assert "has no --quick" in said
