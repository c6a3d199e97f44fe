"""Floors to measure a live run against: the least a message hop and a timed loop cost here.

Both run in processes of their own, once as such a program comes and once with the real-time set-up
of the reflex loop (timer slack, SCHED_FIFO, a core of its own). `echo` is two processes and two
hops over ZeroMQ PUB/SUB on ipc: 256-byte messages at 2 kHz, each sent back at once. `loop` sleeps
to absolute deadlines at 2 kHz and does nothing else.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any, Final

import zmq

from vibrissa.messages.types import TICK_HZ, TICK_NS
from vibrissa.processes import realtime
from vibrissa.processes.results import OnProgress, Progress, RunError, silent
from vibrissa.processes.stats import Histogram

SET_UPS: Final = ("as it comes", "set up like the reflex loop")
PRIORITY: Final = 48
BYTES: Final = 256
WARM_TICKS: Final = 500
REPEATS: Final = 2
SECONDS: Final = 4.0

Times = dict[str, float]
"""p50, p99, p999, max in us."""


def measure(on_progress: OnProgress = silent) -> list[dict[str, Times]]:
    """Both floors in both set-ups, REPEATS times in turn; each {name: times}."""
    found = []
    each = 2 * SECONDS * len(SET_UPS)
    for repeat in range(REPEATS):
        floors: dict[str, Times] = {}
        for count, set_up in enumerate(SET_UPS):
            done = each * repeat + 2 * SECONDS * count
            on_progress(Progress("floors", done, each * REPEATS, set_up))
            with tempfile.TemporaryDirectory(prefix="vibrissa-floor-") as folder:
                echo = _start("echo", folder, set_up)
                try:
                    floors[f"bare echo, {set_up}, latency"] = _result("ping", folder, set_up)
                finally:
                    echo.kill()
                    echo.communicate()
                loop = _result("loop", folder, set_up)
            floors[f"bare loop, {set_up}, lateness"] = loop["lateness"]
            floors[f"bare loop, {set_up}, period"] = loop["period"]
        found.append(floors)
    return found


def medians(found: list[dict[str, Times]]) -> dict[str, Times]:
    """The median of each figure over repeats."""
    return {
        what: {key: statistics.median(run[what][key] for run in found) for key in found[0][what]}
        for what in found[0]
    }


def _start(role: str, folder: str, set_up: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "vibrissa.tools.floors", role, folder, set_up]
    return subprocess.Popen(command, stdout=subprocess.PIPE)


def _result(role: str, folder: str, set_up: str) -> dict[str, Any]:
    process = _start(role, folder, set_up)
    text, _ = process.communicate(timeout=60)
    if process.returncode:
        raise RunError(f"the floor {role} could not be measured: exit code {process.returncode}")
    found: dict[str, Any] = json.loads(text)
    return found


def _prepare(set_up: str) -> None:
    if set_up != SET_UPS[0]:
        realtime.prepare(PRIORITY, "reflex")


def _sockets(folder: str, mine: str, other: str, set_up: str) -> tuple[Any, Any]:
    _prepare(set_up)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    out, back = context.socket(zmq.PUB), context.socket(zmq.SUB)
    out.bind(f"ipc://{folder}/{mine}")
    back.connect(f"ipc://{folder}/{other}")
    back.subscribe(b"")
    return out, back


def _echo(folder: str, set_up: str) -> None:
    realtime.die_with_parent()
    out, back = _sockets(folder, "back", "out", set_up)
    while True:
        out.send(back.recv())


def _ping(folder: str, set_up: str) -> None:
    out, back = _sockets(folder, "out", "back", set_up)
    payload = bytes(BYTES)
    deadline = time.monotonic() + 20
    while not back.poll(100):  # the first messages to a fresh subscriber are lost
        if time.monotonic() > deadline:
            sys.exit("no echo")
        out.send(payload)
    while back.poll(200):
        back.recv()
    trip = Histogram()
    start = time.monotonic_ns() + TICK_NS
    for tick in range(WARM_TICKS + int(SECONDS * TICK_HZ)):
        realtime.sleep_until(start + tick * TICK_NS)
        out.send(payload)
        went = time.monotonic_ns()
        back.recv()
        if tick >= WARM_TICKS:
            trip.add((time.monotonic_ns() - went) * 1e-3)
    print(json.dumps(trip.summary()))


def _loop(_folder: str, set_up: str) -> None:
    _prepare(set_up)
    late, period = Histogram(), Histogram()
    start = time.monotonic_ns() + TICK_NS
    last = start
    for tick in range(WARM_TICKS + int(SECONDS * TICK_HZ)):
        due = start + tick * TICK_NS
        realtime.sleep_until(due)
        now = time.monotonic_ns()
        if tick >= WARM_TICKS:
            late.add((now - due) * 1e-3)
            period.add((now - last) * 1e-3)
        last = now
    print(json.dumps({"lateness": late.summary(), "period": period.summary()}))


if __name__ == "__main__":
    {"echo": _echo, "ping": _ping, "loop": _loop}[sys.argv[1]](*sys.argv[2:4])
