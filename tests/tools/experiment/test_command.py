"""`vibrissa experiment` and its bench, as a person types them."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from vibrissa.tools import bench, bench_experiment
from vibrissa.tools.cli import app
from vibrissa.tools.experiment.recording import RigCase

MAZE = "+---+---+\n|       |\n+   +   +\n|       |\n+---+---+\n"


def test_an_unknown_experiment_is_named_with_those_there_are() -> None:
    result = CliRunner().invoke(app, ["experiment", "rats"])
    assert result.exit_code == 2
    assert "'rats'" in result.output and "paper" in result.output


def test_an_unknown_group_is_named_with_those_there_are() -> None:
    result = CliRunner().invoke(app, ["experiment", "slam", "--group", "cats"])
    assert result.exit_code == 2
    assert "'cats'" in result.output and "plain" in result.output


def test_the_bench_is_found_by_name() -> None:
    assert bench.load("experiment") is bench_experiment.bench


def test_a_data_set_is_timed_part_by_part() -> None:
    rows = bench_experiment.data_set(RigCase(MAZE, 1, "rcp", "C", speed=0.2, calibration_cycles=1))
    *parts, whole = rows
    assert whole["what"] == "rcp: whole data set" and len(parts) == 3
    assert parts[1]["cpu_s"] + parts[2]["cpu_s"] == pytest.approx(whole["cpu_s"])
    for row in rows:
        assert row["ms_per_second"] == pytest.approx(1e3 * row["cpu_s"] / row["logical_s"])
