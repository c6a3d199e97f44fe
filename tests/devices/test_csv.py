"""Whisker recordings as CSV: what was written is read, what is wrong is named by line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vibrissa.rig.devices.csv import COLUMNS, CsvError, Recording, read_csv, write_csv


def some(n: int = 20, *, pose: bool = True) -> Recording:
    rng = np.random.default_rng(4)
    signals = [rng.normal(0, s, (n, 18)).astype(np.float32) for s in (0.5, 1e-4, 1e-4)]
    poses = rng.normal(0, 1, (n, 4)) if pose else None
    return Recording(np.arange(n) * 0.0005 + 1 / 3, *signals, poses)


@pytest.mark.parametrize("pose", [True, False])
def test_a_recording_comes_back_to_the_bit(tmp_path: Path, pose: bool) -> None:
    path, wrote = tmp_path / "whiskers.csv", some(pose=pose)
    write_csv(path, wrote)
    read = read_csv(path)
    for name in ("t", "theta", "x", "y"):
        a, b = getattr(wrote, name), getattr(read, name)
        assert a.dtype == b.dtype and a.tobytes() == b.tobytes()
    assert (read.pose is None) == (not pose)
    if pose:
        assert read.pose is not None and wrote.pose is not None
        assert read.pose.tobytes() == wrote.pose.tobytes()


@pytest.mark.parametrize(
    ("line", "text", "complaint"),
    [
        (0, "t,theta_00,whisker", "line 1: expected t, .* found column 3 'whisker'"),
        (3, "1,2,3", "line 4: expected 55 values, found 3"),
        (3, "0.1," + ",".join(["0"] * 54), "line 4: t: expected more than"),
        (2, "0.3335,abc," + ",".join(["0"] * 53), "line 3: theta_00: expected a number, found 'a"),
        (2, "0.3335,nan," + ",".join(["0"] * 53), "line 3: theta_00: expected a number, found 'n"),
    ],
)
def test_a_file_that_is_wrong_is_refused_by_line(
    tmp_path: Path, line: int, text: str, complaint: str
) -> None:
    path = tmp_path / "whiskers.csv"
    write_csv(path, some(pose=False))
    lines = path.read_text().splitlines()
    lines[line] = text
    path.write_text("\n".join(lines))
    with pytest.raises(CsvError, match=complaint) as caught:
        read_csv(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_files_without_samples_or_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "whiskers.csv"
    path.write_text(",".join(COLUMNS) + "\n")
    with pytest.raises(CsvError, match="expected samples"):
        read_csv(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CsvError, match="not a CSV file"):
        read_csv(path)
    path.write_text("")
    with pytest.raises(CsvError, match="found 0 columns"):
        read_csv(path)


def test_arrays_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    good = some()
    bad = Recording(good.t[:-1], good.theta, good.x, good.y)
    with pytest.raises(CsvError, match=r"theta: expected shape \(19, 18\)"):
        write_csv(tmp_path / "a.csv", bad)
