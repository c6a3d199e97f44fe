"""What a field of a message may hold.

A field states its limits once; encoding and decoding both check them. Scalars travel as msgpack
integers, floats and strings. Arrays travel as raw little-endian blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

TICK_LIMIT: Final = 2**40
"""Largest tick number on the wire: 17 years at 2 kHz."""


@dataclass(frozen=True, slots=True)
class Int:
    """An integer in [low, high]."""

    low: int = 0
    high: int = TICK_LIMIT
    unit: str = ""

    def fault(self, value: Any) -> str | None:
        if type(value) is not int:
            return f"expected an integer, found {_kind(value)}"
        if not self.low <= value <= self.high:
            return f"expected {self.low} to {self.high}, found {value}"
        return None

    def json_schema(self) -> dict[str, Any]:
        return {
            "type": "integer",
            "minimum": self.low,
            "maximum": self.high,
            "description": self.unit,
        }


@dataclass(frozen=True, slots=True)
class Real:
    """A finite float64 with |value| <= limit."""

    limit: float = 1e12
    unit: str = ""

    def fault(self, value: Any) -> str | None:
        if type(value) is not float:
            return f"expected a float, found {_kind(value)}"
        if not math.isfinite(value) or abs(value) > self.limit:
            return f"expected a finite number up to {self.limit:g}, found {value!r}"
        return None

    def json_schema(self) -> dict[str, Any]:
        return {
            "type": "number",
            "minimum": -self.limit,
            "maximum": self.limit,
            "description": self.unit,
        }


@dataclass(frozen=True, slots=True)
class Text:
    """A string of at most `longest` characters that has a UTF-8 form."""

    longest: int = 400

    def fault(self, value: Any) -> str | None:
        if type(value) is not str:
            return f"expected text, found {_kind(value)}"
        if len(value) > self.longest:
            return f"expected at most {self.longest} characters, found {len(value)}"
        try:
            value.encode()
        except UnicodeEncodeError:
            return "expected text that UTF-8 can express, found lone surrogates"
        return None

    def json_schema(self) -> dict[str, Any]:
        return {"type": "string", "maxLength": self.longest}


@dataclass(frozen=True, slots=True)
class Array:
    """A block of numbers: `shape` with -1 for one free dimension, |values| <= limit, finite."""

    dtype: str
    shape: tuple[int, ...]
    limit: float = math.inf
    unit: str = ""
    longest: int = 1 << 20

    @property
    def numpy_dtype(self) -> np.dtype[Any]:
        return np.dtype(self.dtype)

    @property
    def fixed(self) -> bool:
        return -1 not in self.shape

    @property
    def bytes_per_row(self) -> int:
        return self.numpy_dtype.itemsize * math.prod(n for n in self.shape if n != -1)

    def fault(self, value: Any) -> str | None:
        if not isinstance(value, np.ndarray):
            return f"expected an array, found {_kind(value)}"
        if value.dtype != self.numpy_dtype:
            return f"expected {self.numpy_dtype.name}, found {value.dtype.name}"
        if len(value.shape) != len(self.shape) or any(
            want not in (-1, have) for want, have in zip(self.shape, value.shape, strict=True)
        ):
            return f"expected shape {_shape(self.shape)}, found {_shape(value.shape)}"
        if value.size > self.longest:
            return f"expected at most {self.longest} numbers, found {value.size}"
        return self.range_fault(value)

    def range_fault(self, value: npt.NDArray[Any]) -> str | None:
        """Name the first element that is not finite or beyond the limit."""
        if value.dtype.kind != "f":
            return None
        flat = value.reshape(-1)
        bad = np.flatnonzero(~(np.abs(flat) <= self.limit))
        if bad.size == 0 and np.isfinite(flat).all():
            return None
        index = int(bad[0]) if bad.size else int(np.flatnonzero(~np.isfinite(flat))[0])
        found = float(flat[index])
        return f"element {index}: expected a finite number up to {self.limit:g}, found {found!r}"

    def json_schema(self) -> dict[str, Any]:
        shape = _shape(self.shape)
        return {
            "type": "string",
            "contentEncoding": "binary",
            "description": f"raw little-endian {self.numpy_dtype.name}{shape} {self.unit}".strip(),
        }


Field = Int | Real | Text | Array


def f32(*shape: int, limit: float, unit: str) -> Array:
    """A float32 block whose magnitude stays below `limit` in `unit`."""
    return Array("<f4", shape, limit, unit)


def f64(*shape: int, limit: float, unit: str) -> Array:
    """A float64 block whose magnitude stays below `limit` in `unit`."""
    return Array("<f8", shape, limit, unit)


def _kind(value: Any) -> str:
    return type(value).__name__


def _shape(shape: tuple[int, ...]) -> str:
    return "[" + ", ".join("n" if n == -1 else str(n) for n in shape) + "]"
