"""Whisker recordings as CSV: the exchange format of the paper, one row per sample.

Columns, in this order, with a header row:

    t            s, device time, increasing
    theta_00 .. theta_17   rad, protraction from the start angle
    x_00 .. x_17           N m, base bending moment sideways
    y_00 .. y_17           N m, base bending moment in the whisking plane
    x, y, z, yaw           m and rad, pose of the head; left out when it was not recorded

Whisker i = ring*6 + k: ring 0 front (50 mm), 1 mid, 2 rear. Decimal point, comma between, one
header, UTF-8. Numbers are written so that they read back to the same float32 (t and poses:
float64).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vibrissa.control.kinematics import WHISKERS, Float32s, Float64s

SIGNALS = tuple(f"{kind}_{i:02d}" for kind in ("theta", "x", "y") for i in range(WHISKERS))
POSE = ("x", "y", "z", "yaw")
COLUMNS = ("t", *SIGNALS)
COLUMNS_TEXT = "t, theta_00..17, x_00..17, y_00..17 and perhaps x, y, z, yaw"


class CsvError(ValueError):
    """A file that is no whisker recording: says which line, what was expected, what was found."""


@dataclass(frozen=True, eq=False)
class Recording:
    """A stretch of samples: t float64[n], s; theta, x, y float32[n, 18]; pose float64[n, 4]."""

    t: Float64s
    theta: Float32s
    x: Float32s
    y: Float32s
    pose: Float64s | None = None


def write_csv(path: Path, recording: Recording) -> None:
    """Write a recording. Raises CsvError when its arrays don't belong together, OSError."""
    n = len(recording.t)
    for name in ("theta", "x", "y"):
        shape = getattr(recording, name).shape
        if shape != (n, WHISKERS):
            raise CsvError(f"{path}: {name}: expected shape {(n, WHISKERS)}, found {shape}")
    pose = recording.pose
    if pose is not None and pose.shape != (n, 4):
        raise CsvError(f"{path}: pose: expected shape {(n, 4)}, found {pose.shape}")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS if pose is None else (*COLUMNS, *POSE))
        for k in range(n):
            signals = np.concatenate((recording.theta[k], recording.x[k], recording.y[k]))
            row = [repr(float(recording.t[k])), *(str(v) for v in signals.astype(np.float32))]
            if pose is not None:
                row += [repr(float(v)) for v in pose[k]]
            writer.writerow(row)


def read_csv(path: Path) -> Recording:
    """Read a recording. Raises CsvError naming file, line and column, or OSError."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(_rows(path, file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise CsvError(f"{path}: not a CSV file in UTF-8: {error}") from None
    values = np.array(rows, np.float64)
    signals = values[:, 1:55].astype(np.float32)
    theta, x, y = (np.ascontiguousarray(signals[:, k : k + WHISKERS]) for k in (0, 18, 36))
    pose = np.ascontiguousarray(values[:, 55:]) if values.shape[1] > 55 else None
    return Recording(np.ascontiguousarray(values[:, 0]), theta, x, y, pose)


def _rows(path: Path, file: io.TextIOBase) -> Iterator[list[float]]:
    reader = csv.reader(file)
    header = tuple(name.strip() for name in next(reader, []))
    if header not in (COLUMNS, (*COLUMNS, *POSE)):
        pairs = enumerate(zip(header, (*COLUMNS, *POSE), strict=False), 1)
        found = f"{len(header)} columns"
        found = next((f"column {k} {a[:40]!r}" for k, (a, b) in pairs if a != b), found)
        raise CsvError(f"{path}: line 1: expected {COLUMNS_TEXT}, found {found}")
    last = -math.inf
    count = 0
    for row in reader:
        line = reader.line_num
        if len(row) != len(header):
            raise CsvError(f"{path}: line {line}: expected {len(header)} values, found {len(row)}")
        numbers = [_number(path, line, name, text) for name, text in zip(header, row, strict=True)]
        if numbers[0] <= last:
            raise CsvError(f"{path}: line {line}: t: expected more than {last}, found {numbers[0]}")
        last = numbers[0]
        count += 1
        yield numbers
    if not count:
        raise CsvError(f"{path}: expected samples after the header, found none")


def _number(path: Path, line: int, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) < 1e30:
        raise CsvError(f"{path}: line {line}: {name}: expected a number, found {text[:40]!r}")
    return value
