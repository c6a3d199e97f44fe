"""How kernels are compiled, and how long the compiled code on disk stays valid."""

from __future__ import annotations

import ast
import functools
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parent


def compiled(function: F) -> F:
    """Compile in nopython mode with strict IEEE arithmetic; the machine code is cached on disk."""
    return cast(F, _checked(numba.njit(cache=True, fastmath=False, error_model="numpy")(function)))


def inlined(function: F) -> F:
    """Like `compiled`, and part of whatever calls it, so that loops over it are vectorised."""
    jit = numba.njit(cache=True, fastmath=False, error_model="numpy", forceinline=True)
    return cast(F, _checked(jit(function)))


def _checked(dispatcher: Any) -> Any:
    """Tie the cached code to every source it was made from.

    numba looks at the file of the function alone, but the code contains what the function calls
    and the constants it uses. Unnoticed, yesterday's sine would live on in today's kernels.
    """
    file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if file is not None:
        file._source_stamp = source_digest(dispatcher.py_func.__code__.co_filename)
    return dispatcher


@functools.cache
def source_digest(path: str) -> str:
    """SHA-256 over a source file and all files of this package that it imports, at any depth."""
    found: dict[str, bytes] = {}
    open_files = [Path(path)]
    while open_files:
        file = open_files.pop().resolve()
        if str(file) not in found:
            found[str(file)], imported = _parsed(file)
            open_files += imported
    digest = hashlib.sha256()
    for name, source in sorted(found.items()):
        digest.update(f"{name}\0{len(source)}\0".encode() + source)
    return digest.hexdigest()


@functools.cache
def _parsed(file: Path) -> tuple[bytes, list[Path]]:
    source = file.read_bytes()
    names = [name for node in ast.walk(ast.parse(source)) for name in _imported(node)]
    parts = [name.split(".")[1:] for name in names if name.split(".")[0] == _PACKAGE.name]
    places = [_PACKAGE.joinpath(*part) for part in parts]
    files = [file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")]
    return source, [file for file in files if file.is_file()]


def _imported(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module:
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
