"""Test vectors, and the plain formulas of RatSLAM that compiled kernels are compared with."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np

from vibrissa.tools.plain_ratslam import (
    TAU,
    convolve,
    energy,
    experience_metric,
    kernel,
    match,
    move,
    read_out,
    relax,
    stages,
    wrap,
)

__all__ = [
    "TAU",
    "convolve",
    "energy",
    "experience_metric",
    "kernel",
    "lines",
    "match",
    "move",
    "read_out",
    "relax",
    "stages",
    "table",
    "wrap",
]

DATA = Path(__file__).parent / "data"


def lines(name: str) -> list[str]:
    with gzip.open(DATA / f"{name}.csv.gz", "rt") as file:
        return file.read().splitlines()


def table(name: str) -> np.ndarray:
    """The numeric rows of a vector file, without its header."""
    return np.array([[float(v) for v in row.split(",")] for row in lines(name)[1:]])
