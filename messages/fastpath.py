"""Encoders and decoders specialised to one message type.

The 2 kHz loop frames and unframes ten thousand messages a second, so the checks of a type are
written out as straight code from its fields, once, at import. The straight code knows only whether
all is well; whatever else it meets it leaves to the careful path (`codec.py`), which goes through
the fields one by one and names the wrong one. Types with arrays of other kinds always take the
careful path.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import msgpack
import numpy as np
import numpy.typing as npt

from vibrissa.messages.fields import Array, Field, Int, Real, Text
from vibrissa.numerics import compiled

HEADER_CHECK = (
    "type(source) is str and 0 < len(source) <= 40"
    " and source.isascii() and source.isprintable() and ' ' not in source"
    f" and type(epoch) is int and 0 <= epoch < {2**63} and type(seq) is int"
    f" and 0 <= seq < {2**32} and type(t) is int and {-(2**63)} <= t < {2**63}"
)


@compiled
def within(block: npt.NDArray[np.float32], limits: npt.NDArray[np.float32]) -> bool:
    """Whether every |block[i]| <= limits[i]; false for NaN."""
    for i in range(block.shape[0]):  # noqa: SIM110 - numba compiles the plain loop
        if not abs(block[i]) <= limits[i]:
            return False
    return True


def decoder(
    prefix: bytes,
    topic: str,
    version: int,
    body: type[Any],
    message: type[Any],
    fields: dict[str, Field],
    order: tuple[list[str], list[str]],
    careful: Callable[[bytes], Any],
) -> Callable[[bytes], Any]:
    """decode(frame) -> message, for a type whose fields travel in `order` (single, block)."""
    single, block = order
    checks = [HEADER_CHECK, f"type(version) is int and version == {version}"]
    checks += [_check(fields[name], f"f_{name}") for name in single]
    limits = _limits(fields, block)
    if block:
        checks.append(f"type(raw) is bytes and len(raw) == {4 * limits.size}")
    lines = ["def decode(frame):", " try:"]
    names = ["version", "source", "epoch", "seq", "t", *_local(single), *(["raw"] if block else [])]
    lines += [f"  {', '.join(names)} = unpackb(frame[{len(prefix)}:])"]
    lines += [" except Exception:", "  return careful(frame)"]
    lines += [f" if not ({' and '.join(checks)}):", "  return careful(frame)"]
    if block:
        lines += [" raw = frombuffer(raw, F4)"]
        lines += [" if not within(raw, limits):", "  return careful(frame)"]
        lines += [
            f" f_{name} = raw[{start}:{stop}]" for name, start, stop in _slices(fields, block)
        ]
    lines += [f" return message(topic, source, epoch, seq, t, body({', '.join(_local(fields))}))"]
    return _define("decode", lines, locals())


def encoder(
    prefix: bytes,
    version: int,
    body: type[Any],
    fields: dict[str, Field],
    order: tuple[list[str], list[str]],
    careful: Callable[[str, int, int, int, Any], bytes],
) -> Callable[[str, int, int, int, Any], bytes]:
    """encode(source, epoch, seq, t, value) -> frame."""
    single, block = order
    limits = _limits(fields, block)
    lines = ["def encode(source, epoch, seq, t, value):", " if type(value) is body:"]
    lines += [f"  f_{name} = value.{name}" for name in fields]
    checks = [HEADER_CHECK, *(_check(fields[name], f"f_{name}") for name in single)]
    checks += [f"f_{n}.shape == {_array(fields[n]).shape} and f_{n}.dtype == F4" for n in block]
    lines += ["  try:", f"   fine = {' and '.join(checks)}"]
    lines += ["  except AttributeError:", "   fine = False", "  if fine:"]
    values = ["version", "source", "epoch", "seq", "t", *_local(single)]
    if block:
        parts = _local(block)
        joined = parts[0] if len(parts) == 1 else f"concatenate(({', '.join(parts)}))"
        lines += [f"   raw = {joined}", "   if within(raw, limits):"]
        lines += [f"    return prefix + pack(({', '.join(values)}, raw.tobytes()))"]
    else:
        lines += [f"   return prefix + pack(({', '.join(values)},))"]
    lines += [" return careful(source, epoch, seq, t, value)"]
    return _define("encode", lines, locals())


def _check(field: Field, name: str) -> str:
    if isinstance(field, Int):
        return f"type({name}) is int and {field.low} <= {name} <= {field.high}"
    if isinstance(field, Real):
        return f"type({name}) is float and -{field.limit!r} <= {name} <= {field.limit!r}"
    if isinstance(field, Text):
        return f"type({name}) is str and len({name}) <= {field.longest} and {name}.isascii()"
    return "False"


def _local(names: Iterable[str]) -> list[str]:
    return [f"f_{name}" for name in names]  # apart from the names of the header


def _array(field: Field) -> Array:
    assert isinstance(field, Array)
    return field


def _limits(fields: dict[str, Field], block: list[str]) -> npt.NDArray[np.float32]:
    parts = [np.full(_array(fields[n]).shape, _array(fields[n]).limit, np.float32) for n in block]
    return np.concatenate(parts) if parts else np.empty(0, np.float32)


def _slices(fields: dict[str, Field], block: list[str]) -> list[tuple[str, int, int]]:
    found, start = [], 0
    for name in block:
        stop = start + _array(fields[name]).shape[0]
        found.append((name, start, stop))
        start = stop
    return found


def _define(name: str, lines: list[str], names: dict[str, Any]) -> Callable[..., Any]:
    scope = dict(names)
    scope |= {"F4": np.dtype("<f4"), "within": within, "concatenate": np.concatenate}
    scope |= {"frombuffer": np.frombuffer, "unpackb": msgpack.unpackb, "pack": _PACKER.pack}
    exec("\n".join(lines), scope)
    made: Callable[..., Any] = scope[name]
    return made


_PACKER = msgpack.Packer()
