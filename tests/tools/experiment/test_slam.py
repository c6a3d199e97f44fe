"""`vibrissa experiment slam`: in small, from the command line to the report, and its table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from vibrissa.processes.results import silent
from vibrissa.tools import bench_touch
from vibrissa.tools.cli import app
from vibrissa.tools.experiment import slam_report, slam_runs
from vibrissa.tools.experiment.slam_markdown import interval, ratios
from vibrissa.tools.experiment.slam_runs import FIRST_SEED, NOISES, ROWS, VARIANTS, works


def test_the_quick_form_writes_its_report_and_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slam_runs, "NOISES", ("jit",))
    monkeypatch.setattr(slam_runs, "MAZES", {"A": (0.75, 0.6)})
    arguments = ["experiment", "slam", "--quick", "--seeds", "1", "--jobs", "1"]
    done = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "1 data sets to go" in done.output and str(tmp_path / "report.html") in done.output
    results = json.loads((tmp_path / "results.json").read_text())
    cells = {(cell["row"], cell["noise"]) for cell in results["table"]}
    assert cells == {(row.name, "jit") for row in ROWS}
    blind = next(c for c in results["table"] if c["row"] == "sequence, batch, blind")
    assert blind["loops"] == 0
    assert [blind[r]["ratio"] for r in ("consecutive", "interval", "all")] == pytest.approx(
        [1.0] * 3
    )
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png") + page.count("<svg") >= 2
    assert all(row.name in page for row in ROWS)
    table = (tmp_path / "report.md").read_text()
    assert (
        all(f"| {row.name} | " in table for row in ROWS) and "## plain (1 runs per cell)" in table
    )
    assert "| sequence, batch, blind | 1.00 / 1.00 / 1.00 (1.00, 1.00, 1.00); 0 0 0 |" in table
    again = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path)])
    assert "0 data sets to go" in again.output


def test_every_group_has_fresh_mazes_and_all_noises() -> None:
    found = works(5, quick=False)
    assert {work.group for work in found} == set(VARIANTS)
    for group in VARIANTS:
        mine = [work for work in found if work.group == group]
        assert {work.noise for work in mine} == set(NOISES)
        assert len({work.rig.maze for work in mine}) == len(mine) / len(NOISES)
    assert min(work.rig.seed for work in found) >= FIRST_SEED
    assert {work.group for work in works(1, False, ["plain"])} == {"plain"}


def test_the_table_counts_wins_and_takes_geometric_means() -> None:
    run: dict[str, Any] = {
        "group": "plain",
        "row": ROWS[0].name,
        "noise": "jit",
        "loops": 4,
        "right": 0.5,
        "ended": "",
    }
    runs = [
        run | {"consecutive": 0.5, "interval": 1.0, "all": 2.0},
        run | {"consecutive": 0.125, "interval": 0.9995, "all": 0.5, "right": None},
        run | {"consecutive": None, "interval": None, "all": None, "ended": "lost"},
    ]
    (cell,) = slam_report.tabulate(runs)
    assert cell["consecutive"]["ratio"] == pytest.approx(0.25)
    assert [cell[r]["wins"] for r in ("consecutive", "interval", "all")] == [2, 0, 1]
    assert (cell["n"], cell["ended"], cell["right"]) == (3, 1, 0.5)
    assert cell["all"]["worst"] == 2.0
    assert ratios(cell) == "0.25 / 1.00 / 1.00 (0.50, 1.00, 2.00); 2 0 1; 1 ended"
    assert interval(cell).endswith("; 4, 50.0 % right")


def test_places_as_seen_from_the_first_pose() -> None:
    poses = np.array([[1.0, 2.0, np.pi / 2.0], [1.0, 3.0, 0.0], [0.0, 2.0, 0.0]])
    assert slam_report.from_first(poses) == pytest.approx(np.array([[0, 0], [1, 0], [0, 1]]))


def test_the_bench_judges_wins_loops_without_touch_and_cost(tmp_path: Path) -> None:
    found = bench_touch.bench(tmp_path, 0.0, silent, quick=True)
    assert {row["row"] for row in found.rows} == {*bench_touch.TOUCH, *bench_touch.CONTROLS}
    aims = {target.name: target for target in found.targets}
    assert aims["loops blind or shuffled"].met
    assert aims["lag 100, processor time per whisk"].value > 0.0
    assert [t.bound for t in found.targets] == [0.95, 0.95, 0, 5]
