"""What a log says about where it came from: code, configuration, versions, machine class."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import platform
from pathlib import Path
from typing import Any

import vibrissa

_ROOMS = ("messages", "control", "slam", "rig", "processes")


@functools.cache
def code_hash() -> str:
    """SHA-256 over the source of everything that can change what a node computes."""
    root = Path(vibrissa.__file__).parent
    digest = hashlib.sha256()
    files = [*root.glob("*.py"), *(f for room in _ROOMS for f in (root / room).glob("**/*.py"))]
    for file in sorted(files, key=lambda f: f.relative_to(root).as_posix()):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0")
        digest.update(file.read_bytes() + b"\0")
    return digest.hexdigest()


def config_hash(experiment: str) -> str:
    """SHA-256 of a resolved experiment in JSON."""
    return hashlib.sha256(experiment.encode()).hexdigest()


def versions() -> str:
    """Versions of what the numbers depend on, one line."""
    names = ("numpy", "numba", "llvmlite", "msgpack", "pyzmq", "mcap")
    found = [f"{n} {importlib.metadata.version(n)}" for n in names]
    return ", ".join([f"vibrissa {vibrissa.__version__}", f"Python {_python()}", *found])


def metadata(experiment: str, mode: str) -> dict[str, str]:
    """The "run" record of a log. Nothing in it depends on the time of day."""
    return {
        "mode": mode,
        "experiment": experiment,
        "config_hash": config_hash(experiment),
        "code_hash": code_hash(),
        "versions": versions(),
        "machine": platform.machine(),
    }


def mismatches(recorded: dict[str, Any]) -> list[str]:
    """How the present code and versions differ from a log's, one line each."""
    notes = []
    for key, now in (("code_hash", code_hash()), ("versions", versions())):
        then = recorded.get(key, "")
        if then != now:
            notes.append(f"{key.replace('_', ' ')}: the log has {then[:60]}, here is {now[:60]}")
    return notes


def _python() -> str:
    return platform.python_version()
