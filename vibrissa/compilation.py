"""How kernels are compiled, and how long the compiled code on disk stays valid."""

from __future__ import annotations

import ast
import functools
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import types
from numba.core.caching import IndexDataCacheFile
from numba.extending import intrinsic

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parent


def compiled(function: F) -> F:
    """Compile in nopython mode with strict IEEE arithmetic; the machine code is cached on disk."""
    return cast(F, _checked(numba.njit(cache=True, fastmath=False, error_model="numpy")(function)))


def inlined(function: F) -> F:
    """Like `compiled`, and part of whatever calls it, so that loops over it are vectorised."""
    jit = numba.njit(cache=True, fastmath=False, error_model="numpy", forceinline=True)
    return cast(F, _checked(jit(function)))


def _apart(_context: Any) -> Any:
    def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        attributes = builder.function.attributes
        attributes.discard("alwaysinline")
        attributes.add("noinline")
        return context.get_dummy_value()

    return types.void(), generate


stay_apart = cast(Callable[[], None], intrinsic(_apart))
"""Called in a compiled function: keeps it a function of its own wherever it is used.

For what is long or rarely needed: copied into each of its callers and theirs, the optimiser would
have it a dozen times (the contact of one whisker grew to 3.5 MB of machine code).
"""


class CacheFile(IndexDataCacheFile):
    """Compiled code on disk, tied to every source it was made from, whoever writes at a time.

    numba looks at the file of the function alone, but the code contains what the function calls
    and the constants it uses: unnoticed, yesterday's sine would live on in today's kernels. It
    also writes the index before the code it points to, under a number that is the next free one:
    of two processes that compile at once, one could load what the other's number held before,
    the code of another source or of other argument types. Here a file is named after what it
    holds, says from which source, and is there before the index names it. Writers that overtake
    each other lose an entry at most, which is then compiled again.
    """

    def save(self, key: Any, data: Any) -> None:
        """Keep `data` as the code of `key`, a signature and its target."""
        digest = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        name = f"{Path(self._index_name).stem}.{digest}.nbc"
        files: Any = self
        files._save_data(name, (self._source_stamp, data))
        files._save_index(files._load_index() | {key: name})

    def load(self, key: Any) -> Any:
        """The code of `key`; None when there is none, or one of another source."""
        found: Any = super()
        stamp, data = found.load(key) or (None, None)
        return data if stamp == self._source_stamp else None


def _checked(dispatcher: Any) -> Any:
    """Keep the compiled code in a `CacheFile`, where there is a place to keep it."""
    cache = getattr(dispatcher, "_cache", None)
    place = getattr(cache, "_impl", None)
    if cache is not None and place is not None:
        stamp = source_digest(dispatcher.py_func.__code__.co_filename)
        make: Any = CacheFile
        cache._cache_file = make(cache.cache_path, place.filename_base, stamp)
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
