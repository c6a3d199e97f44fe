"""Where live runs are listed, so that a client finds them: private files of this user."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from vibrissa.processes.results import RunError


def folder() -> Path:
    """The directory of this user's live runs; nobody else may look into it. Raises RunError."""
    path = Path(tempfile.gettempdir()) / f"vibrissa-live-{os.getuid()}"
    path.mkdir(mode=0o700, exist_ok=True)
    state = path.stat()
    if state.st_uid != os.getuid() or state.st_mode & 0o077:
        raise RunError(f"{path}: expected a private directory of yours")
    return path


@contextlib.contextmanager
def listed(out: Path, control: str) -> Iterator[None]:
    """List a run while it goes on."""
    name = hashlib.sha256(control.encode()).hexdigest()[:8]
    entry = folder() / f"{os.getpid()}-{name}.json"
    entry.write_text(json.dumps({"out": str(out.absolute()), "control": control}))
    try:
        yield
    finally:
        entry.unlink(missing_ok=True)


def _entries() -> list[dict[str, str]]:
    found = []
    for path in sorted(folder().glob("*.json")):
        with contextlib.suppress(OSError, ValueError):  # just ended
            if Path(f"/proc/{path.stem.partition('-')[0]}").exists():
                found.append(json.loads(path.read_text()))
    return found


def live_endpoints() -> list[str]:
    """The control endpoints of all live runs."""
    return [entry["control"] for entry in _entries()]


def control_endpoint(run: Path | None = None) -> str:
    """The control endpoint of a live run: of the one in directory `run`, or of the only one.

    Raises RunError when there is none, or several and none was named.
    """
    entries = _entries()
    if run is not None:
        entries = [e for e in entries if Path(e["out"]) == run.absolute()]
    if not entries:
        where = f" in {run}" if run else ""
        raise RunError(f"no live run{where}; start one with: vibrissa run")
    if len(entries) > 1:
        names = ", ".join(e["out"] for e in entries)
        raise RunError(f"several live runs ({names}); name one with --run")
    return entries[0]["control"]
