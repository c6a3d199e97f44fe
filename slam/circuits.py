"""Circuits of a closed route, found in the true poses of an agent that keeps coming back."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.slam.metrics import POSITION_THRESHOLD, MetricError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def circuit_numbers(poses: ArrayLike, near: float = POSITION_THRESHOLD) -> Ints:
    """The circuit, 0, 1, .., that each pose float[n, 3] belongs to.

    A circuit begins where the agent comes closest to its first pose on a visit within `near` (m)
    of it; between two visits it was further away than twice that. A stretch at the end that does
    not return counts as a circuit of its own.
    Raises MetricError for poses of another shape.
    """
    truth = np.asarray(poses, dtype=np.float64)
    if truth.ndim != 2 or truth.shape[1] != 3:
        raise MetricError(f"circuits: expected poses of shape (n, 3), found {truth.shape}")
    distance = np.hypot(*(truth[:, :2] - truth[:1, :2]).T)
    numbers = np.zeros(len(truth), dtype=np.int64)
    away, closest, begun = False, -1, 0
    for i, d in enumerate(distance.tolist()):
        if d > 2.0 * near:
            if closest >= 0:
                begun += 1
                numbers[closest:] = begun
                closest = -1
            away = True
        elif away and d < near and (closest < 0 or d < distance[closest]):
            closest = i
    return numbers


def directions(poses: ArrayLike, numbers: ArrayLike) -> Ints:
    """The sense of each circuit seen from above: 1 anticlockwise, -1 clockwise, 0 neither.

    poses: float[n, 3]; numbers: int[n], from `circuit_numbers`. By the signed area of the path.
    """
    truth = np.asarray(poses, dtype=np.float64)
    circuit = np.asarray(numbers, dtype=np.int64)
    senses = []
    for number in range(int(circuit.max(initial=-1)) + 1):
        x, y = truth[circuit == number, 0], truth[circuit == number, 1]
        area = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2.0
        senses.append(int(math.copysign(1.0, area)) if abs(area) > 1e-9 else 0)
    return np.array(senses, dtype=np.int64)
