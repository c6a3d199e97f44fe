"""Live runs in which something goes wrong at a chosen moment."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from vibrissa.processes.results import Progress

PATIENCE_S = 60.0


def children(parent: int | None = None) -> dict[str, int]:
    """name -> pid of the processes of a run that this process (or another) started."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            state, ppid = (entry / "stat").read_text().rpartition(")")[2].split()[:2]
            command = (entry / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue  # gone meanwhile
        ours = int(ppid) == (parent or os.getpid()) and b"vibrissa.processes.main" in command
        if ours and state != "Z":
            name = command[command.index(b"vibrissa.processes.main") + 1].decode()
            found[name] = int(entry.name)
    return found


def send(name: str, number: signal.Signals) -> Callable[[], None]:
    """An action: send a signal to a process of the run."""
    return lambda: os.kill(children()[name], number)


class Schedule:
    """Does things when the run reports that it has come so far; a progress callback."""

    def __init__(self, *actions: tuple[float, Callable[[], None]], phase: str = "running") -> None:
        self._phase = phase
        self._actions = sorted(actions, key=lambda action: action[0])
        self.times: list[float] = []
        """Seconds of run time at which the actions happened."""

    def __call__(self, progress: Progress) -> None:
        while (
            self._actions
            and progress.phase == self._phase
            and progress.done_s >= self._actions[0][0]
        ):
            self._actions.pop(0)[1]()
            self.times.append(progress.done_s)


def wait_for(condition: Callable[[], bool], what: str) -> None:
    """Until something is so that must become so; how long it takes is not asserted."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.02)
