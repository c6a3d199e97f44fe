"""How kernels are compiled, and how long the compiled code on disk stays valid."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import types
from numba.core.caching import IndexDataCacheFile
from numba.core.registry import cpu_target
from numba.extending import intrinsic
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])

Table = NDArray[np.float64]

_PACKAGE = Path(__file__).parent
_DIGEST = 32
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]*(?:\(([^)]*)\)|(.+))|import[ \t]+(.+))", re.M
)


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


def kept(kernel: Any, case: object, shape: tuple[int, ...], make: Callable[[], Table]) -> Table:
    """What `make` computes with a compiled kernel, float64[shape], read-only; once per machine.

    On disk beside the kernel's machine code and valid for as long: named after the sources it
    depends on, the processor, and `case`, which tells apart what one kernel is used for. A file
    that is damaged or can't be read counts as none.
    """
    folder = getattr(getattr(kernel, "_cache", None), "cache_path", None)
    if folder is None:  # not compiled, or nowhere to keep it
        table = make()
    else:
        source = source_digest(kernel.py_func.__code__.co_filename)
        key = (source, cpu_target.target_context.codegen().magic_tuple(), case, shape)
        name = f"{kernel.py_func.__name__}.{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}"
        file = Path(folder) / f"{name}.table"
        found = _load(file, shape)
        table = make() if found is None else found
        if found is None:
            _store(file, table)
    table.setflags(write=False)
    return table


def _load(file: Path, shape: tuple[int, ...]) -> Table | None:
    try:
        data = file.read_bytes()
    except OSError:
        return None
    digest, content = data[:_DIGEST], data[_DIGEST:]
    if len(content) != 8 * math.prod(shape) or hashlib.sha256(content).digest() != digest:
        return None
    return np.frombuffer(content, np.float64).reshape(shape).copy()


def _store(file: Path, table: Table) -> None:
    content = table.tobytes()
    scratch = file.with_name(f".{file.name}-{os.getpid()}")
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_bytes(hashlib.sha256(content).digest() + content)
        scratch.replace(file)


@functools.cache
def source_digest(path: str) -> str:
    """SHA-256 over a source file and all files of this package that it imports, at any depth."""
    found: dict[str, bytes] = {}
    open_files = [Path(path).resolve()]
    while open_files:
        file = open_files.pop()
        name = os.path.relpath(file, _PACKAGE)
        if name not in found:
            found[name], imported = _read(file)
            open_files += imported
    digest = hashlib.sha256()
    for name, source in sorted(found.items()):
        digest.update(f"{name}\0{len(source)}\0".encode() + source)
    return digest.hexdigest()


@functools.cache
def _read(file: Path) -> tuple[bytes, list[Path]]:
    source = file.read_bytes()
    places = [_PACKAGE.joinpath(*name.split(".")[1:]) for name in imports(source.decode())]
    files = [file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")]
    return source, [file.resolve() for file in files if file.is_file()]


def imports(source: str) -> set[str]:
    """Whatever a source may import from this package: modules, and names that may be modules.

    By its text: every process of a run looks through some fifty files, and parsing them takes a
    quarter of a second. Too much does no harm, and a test sees to it that nothing is missed.
    """
    found: set[str] = set()
    for module, inside, behind, plain in _IMPORT.findall(source):
        listed = [name.partition("#")[0] for name in (inside or behind or plain).splitlines()]
        names = [name.split()[0] for name in ",".join(listed).split(",") if name.strip()]
        found |= {module, *(f"{module}.{name}" for name in names)} if module else set(names)
    return {name for name in found if name.partition(".")[0] == _PACKAGE.name}
