"""Arrays that grow by doubling."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", bound=np.generic)


def grown(array: NDArray[T], length: int) -> NDArray[T]:
    """The array itself when it has `length` rows, else a copy with at least twice as many."""
    if length <= array.shape[0]:
        return array
    rows = max(length, 2 * array.shape[0])
    result = np.zeros((rows, *array.shape[1:]), dtype=array.dtype)
    result[: array.shape[0]] = array
    return result
