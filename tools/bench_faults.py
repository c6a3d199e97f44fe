"""`vibrissa bench faults`: what is lost when a process is killed or stopped in the middle of a run.

Each row is a live run of its own in which one process is struck at a given moment. Seconds lost are
logical time between the strike and the last record that can be read.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from vibrissa.messages.codec import decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.recover import recover, summarise
from vibrissa.processes.config import load_experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.results import OnProgress, Progress
from vibrissa.processes.supervisor import Supervisor
from vibrissa.processes.table import PROCESSES
from vibrissa.processes.verify import verify
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.run import next_directory

STRIKE_S: Final = 3.25
"""When a process is struck: in the middle of a protraction, when all whiskers are out."""
STOPPED_S: Final = 5.0
LAST_S: Final = 20.0


@dataclass
class Strike:
    """A signal to one process of a run when its moment has come, and perhaps one to go on."""

    process: str
    number: signal.Signals
    pause_s: float = 0.0
    """When to let it go on, s after the strike; 0 for never."""
    supervisor: Supervisor | None = None
    struck_s: float | None = None
    """Logical time of the strike, s."""
    resumed: bool = False

    def __call__(self, _progress: Progress) -> None:
        assert self.supervisor is not None
        if not self.supervisor.t0:
            return
        now = (time.monotonic_ns() - self.supervisor.t0) * 1e-9
        pid = self.supervisor.children[self.process].popen.pid
        if self.struck_s is None and now >= STRIKE_S:
            self.struck_s = now
            os.kill(pid, self.number)
        if self.struck_s and self.pause_s and not self.resumed:
            self.resumed = now >= self.struck_s + self.pause_s
            if self.resumed:
                os.kill(pid, signal.SIGCONT)


def bench(out: Path, duration: float, on_progress: OnProgress) -> Bench:
    """Strike every process in turn; a run that nothing ends lasts `duration`, at most LAST_S."""
    length = min(duration, LAST_S)
    strikes = [
        Strike("recorder", signal.SIGKILL),
        Strike("recorder", signal.SIGSTOP, pause_s=STOPPED_S),
        Strike("recorder", signal.SIGSTOP),
        *(Strike(name, signal.SIGKILL) for name in PROCESSES),
    ]
    rows = []
    for count, strike in enumerate(strikes):
        on_progress(Progress("faults", count * length, len(strikes) * length, strike.process))
        rows.append(outcome(strike, length, next_directory("fault", out)))
    return Bench("faults", rows, targets(rows))


def outcome(strike: Strike, length: float, out: Path) -> dict[str, Any]:
    """Run, strike, and look at what is left."""
    strike.supervisor = Supervisor(load_experiment(duration=length), out, strike)
    summary = strike.supervisor.run()
    assert strike.struck_s is not None
    log = out / "run.mcap"
    found = summarise(log)
    if not found.complete:
        log = log.with_name("recovered.mcap")
        recover(out / "run.mcap", log)
    verdict = verify(log)
    last_t = max(c.last_t or 0 for c in found.channels) * 1e-9
    completed = summary["cause"] == "completed"
    return {
        "fault": f"{strike.process}: {how(strike)}",
        "cause": summary["cause"],
        "log": "closed" if found.complete else "cut off",
        "verify": "identical" if verdict.identical else "diverged",
        "lost_s": max(strike.struck_s - last_t, 0.0),
        "lost_messages": sum(c.missing for c in found.channels)
        + (sum(m["lost"] for m in summary["messages"].values()) if completed else 0),
        "last_angle_deg": last_angle(log),
    }


def how(strike: Strike) -> str:
    """A strike in words."""
    if strike.number == signal.SIGKILL:
        return "killed"
    return f"stopped for {strike.pause_s:g} s" if strike.pause_s else "stopped for good"


def last_angle(log: Path) -> float:
    """Largest angle of any whisker in the last sample of a log, deg from the start angle."""
    last = None
    for record in LogReader(log):
        if record.topic == "rig.sample":
            last = record
    if last is None:
        return float("nan")
    return float(np.degrees(np.abs(decode(frame_of(last)).body.theta).max()))


def targets(rows: list[dict[str, Any]]) -> list[Target]:
    """The figures to reach; rows are in the order of `bench`."""
    killed, paused, stopped, *others = rows

    def share(of: list[dict[str, Any]], good: Callable[[dict[str, Any]], bool]) -> float:
        return 100.0 * sum(map(good, of)) / len(of)

    return [
        Target("recorder killed: data lost", killed["lost_s"], "s", "<=", 0.1),
        Target(
            "recorder killed: recovered log verifies",
            share([killed], lambda row: row["verify"] == "identical"),
            "%",
            "==",
            100,
        ),
        Target(
            f"recorder stopped for {STOPPED_S:g} s: messages lost",
            paused["lost_messages"],
            "messages",
            "==",
            0,
        ),
        Target(
            "recorder stopped for good: noticed, and the run ended for it",
            share([stopped], lambda row: "recorder" in row["cause"]),
            "%",
            "==",
            100,
        ),
        Target(
            "another process killed: log closed, cause named, verifies",
            share(
                others,
                lambda row: (
                    row["log"] == "closed"
                    and row["fault"].split(":")[0] in row["cause"]
                    and row["verify"] == "identical"
                ),
            ),
            "%",
            "==",
            100,
        ),
        Target(
            "another process than the rig killed: largest whisker angle at the end",
            max(row["last_angle_deg"] for row in others if not row["fault"].startswith("rig")),
            "deg",
            "<=",
            2.0,
        ),
    ]
