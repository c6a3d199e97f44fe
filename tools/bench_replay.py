"""`vibrissa bench replay`: how fast a recorded run is re-run and compared, beside a bare floor.

The floor is the least a comparison can do: read the same log, decode every message, encode it
again, compare the bytes; no node steps.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Final

from vibrissa.messages.codec import decode, encode
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes.config import load_experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.results import Executor, OnProgress, RunError, Verdict
from vibrissa.processes.supervisor import run_live
from vibrissa.processes.verify import verify
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.run import next_directory

EXECUTORS: Final[tuple[Executor, ...]] = ("fused", "lockstep")


def bench(out: Path, duration: float, on_progress: OnProgress) -> Bench:
    """Record a live run into `out`, re-run it with both executors, and run the floor over it."""
    folder = next_directory("live", out)
    summary = run_live(load_experiment(duration=duration), folder, on_progress)
    if summary["cause"] != "completed":
        raise RunError(f"the run to re-run ended early: {summary['cause']}")
    log = folder / "run.mcap"
    verdicts = [verify(log, executor, on_progress) for executor in EXECUTORS]
    floor = floor_row(log, verdicts[0].duration_s)
    rows = [floor, *(row(verdict, floor["times_real_time"]) for verdict in verdicts)]
    fused, lockstep = verdicts
    return Bench(
        "replay",
        rows,
        [
            Target("fused: identical", float(fused.identical), "1 = yes", "==", 1),
            Target("fused: speed", fused.realtime_factor, "times real time", ">=", 5),
            Target("lockstep: identical", float(lockstep.identical), "1 = yes", "==", 1),
            Target("lockstep: speed", lockstep.realtime_factor, "times real time", ">=", 3),
            Target("lockstep: speed, aim", lockstep.realtime_factor, "times real time", ">=", 10),
        ],
    )


def row(verdict: Verdict, floor: float) -> dict[str, Any]:
    """One re-run."""
    return {
        "what": f"verify, {verdict.executor}",
        "messages": verdict.compared_messages,
        "megabytes": verdict.compared_bytes / 1e6,
        "logical_s": verdict.duration_s,
        "times_real_time": verdict.realtime_factor,
        "share_of_floor": verdict.realtime_factor / floor,
    }


def floor_row(log: Path, duration_s: float) -> dict[str, Any]:
    """Decode, encode and compare every message of a log, and do nothing else."""
    messages = size = 0
    start = time.perf_counter()
    for record in LogReader(log):
        frame = frame_of(record)
        if encode(decode(frame)) != frame:
            raise RunError(f"{log}: {record.topic} of {record.source} #{record.seq} changes")
        messages += 1
        size += len(frame)
    factor = duration_s / (time.perf_counter() - start)
    return {
        "what": "floor: decode, encode, compare",
        "messages": messages,
        "megabytes": size / 1e6,
        "logical_s": duration_s,
        "times_real_time": factor,
        "share_of_floor": 1.0,
    }
