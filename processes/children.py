"""The processes of a live run as the supervisor has them: started, heard, and what is wrong."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from vibrissa.processes.layout import Layout
from vibrissa.processes.table import RECORDER_SILENCE, ROWS, SLOTS

ONE_THREAD: Final = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


class Child:
    """A process the supervisor started, and what it has said so far."""

    def __init__(self, name: str, popen: subprocess.Popen[bytes], silence: float) -> None:
        self.name = name
        self.popen = popen
        self.silence = silence
        self.missing: list[str] = []
        self.ready = False
        self.heard = time.monotonic()
        self.t = 0
        self.steps = 0
        self.done = False
        self.last_words = ""
        self.bye: dict[str, Any] | None = None
        self.closed: dict[str, Any] | None = None

    def trouble(self, now: float, t: int) -> str | None:
        """Why the run can't go on with this process, if so; t is the present time in ns."""
        code = self.popen.poll()
        if self.last_words and (self.bye or code is not None):
            return self.last_words
        if code is not None and self.bye is None and self.closed is None:
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            return f"{self.name} ended unexpectedly ({how})"
        if now - self.heard > self.silence:
            what = "has been silent for" if self.ready else "was not ready after"
            return f"{self.name} {what} {self.silence:g} s"
        if self.name in SLOTS and 0 < self.t < t - self.silence * 1e9:
            return f"{self.name} is more than {self.silence:g} s behind"
        return None


def start_process(name: str, layout: Layout, folder: Path) -> Child:
    """Start a process of the run that is laid out in `folder`."""
    command = [sys.executable, "-m", "vibrissa.processes.main", name, str(folder)]
    popen = subprocess.Popen(command, env=os.environ | ONE_THREAD, start_new_session=True)
    nodes = layout.hosts.get(name, [name])
    silence = RECORDER_SILENCE if name == "recorder" else min(ROWS[n].silence for n in nodes)
    return Child(name, popen, silence)


def dead(child: Child) -> bool:
    """Whether its process has ended."""
    return child.popen.poll() is not None


def summary(
    children: Iterable[Child], sent: Mapping[str, int], cause: str | None, wall: float, cpu: float
) -> dict[str, Any]:
    """What the processes of an ended run have counted and measured.

    sent: messages put on the bus, by topic; wall: s; cpu: s of the supervisor itself.
    """
    children = list(children)
    byes = [c.bye for c in children if c.bye]
    stats = {node: s for bye in byes for node, s in bye["stats"].items()}
    counters = {node: c for bye in byes for node, c in bye["counters"].items()}
    closed = next((c.closed for c in children if c.closed), None)
    received = closed["received"] if closed else {}
    messages = {
        topic: {
            "sent": n,
            "received": received.get(topic, 0),
            "lost": max(n - received.get(topic, 0), 0),
        }
        for topic, n in sorted(sent.items())
    }
    cpu += sum(bye["cpu_s"] for bye in byes) + (closed["cpu_s"] if closed else 0.0)
    sampler = counters.get("sampler", {})
    lost = sum(m["lost"] for m in messages.values())
    return {
        "ok": cause == "completed" and lost == 0,
        "cause": cause,
        "ticks": sampler.get("ticks", 0),
        "ticks_answered": sampler.get("answered", 0),
        "cycles": counters.get("whisk", {}).get("cycles", 0),
        "messages": messages,
        **{
            key: {node: s[key] for node, s in stats.items() if s[key]}
            for key in ("latency_us", "lateness_us", "work_us", "period_us")
        },
        "cpu_cores": round(cpu / max(wall, 1e-9), 3),
        "steps": {child.name: child.steps for child in children},
        "counters": counters,
    }
