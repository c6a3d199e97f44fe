"""`vibrissa bench rig` measures what it says, in its short form."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.tools.conftest import vibrissa
from vibrissa.rig.plant import HeadPlantParams, head_model
from vibrissa.rig.rows import THETA, at
from vibrissa.tools import bench_rig, carried_head


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    out = tmp_path_factory.mktemp("bench")
    outcome = vibrissa("bench", "rig", "--quick", "--duration", "20", "--json", "--out", out)
    assert outcome.code == 0, outcome.err
    return json.loads(outcome.out), out


def rows(found: tuple[dict, Path], column: str) -> dict:
    return {row[column]: row for row in found[0]["rows"] if column in row}


def test_every_part_is_measured(found) -> None:
    assert set(rows(found, "beam")) == {"linear", "table 9", "table 17", "table 33", "exact"}
    assert list(rows(found, "rate Hz")) == [500, 1000, 2000, 4000]
    assert set(rows(found, "walls")) == {"nothing", "border only", "50% of walls", "100% of walls"}
    assert "touching" in rows(found, "whisker step") and len(rows(found, "long run")) == 1
    assert (found[1] / "bench-rig.png").read_bytes().startswith(b"\x89PNG")


def test_finer_tables_have_smaller_errors_and_the_exact_form_almost_none(found) -> None:
    beam = rows(found, "beam")
    errors = [beam[name]["largest error"] for name in ("linear", "table 9", "table 33", "exact")]
    assert errors == sorted(errors, reverse=True) and errors[-1] < 1e-9
    assert all(
        beam["exact"]["ns, shaft on a peg"] > row["ns, shaft on a peg"] * 50
        for name, row in beam.items()
        if name != "exact"
    )


def test_no_byte_depends_on_skipping_and_walls_are_touched_more_the_more_there_are(found) -> None:
    walls = rows(found, "walls")
    assert all(row["differs"] == 0 for row in walls.values())
    assert walls["nothing"]["touching"] == 0 < walls["50% of walls"]["touching"]
    target = next(t for t in found[0]["targets"] if "skipping" in t["name"])
    assert target["met"]


def test_bytes_that_differ_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    carry = bench_rig.carry

    def off(model, params, over, **options):
        felt = carry(model, params, over, **options)
        if not options.get("skip", True):
            felt.state[at(THETA, 3)] = np.nextafter(felt.state[at(THETA, 3)], 1)
        return felt

    monkeypatch.setattr(bench_rig, "carry", off)
    row = bench_rig._skipping_row(
        "nothing", np.zeros((0, 5)), HeadPlantParams(), carried_head.tour(0.05, 2000)
    )
    assert row["differs"] == 1


def test_a_carried_head_feels_the_same_twice() -> None:
    params, over = HeadPlantParams(), carried_head.tour(0.2, 2000)
    model = head_model(np.zeros((0, 5)), params)
    first, again = (carried_head.carry(model, params, over) for _ in range(2))
    assert first.bytes() == again.bytes() and first.held == 0 and first.ticks == 400
