"""Replay: a log again with a node replaced (what-if), or re-published at its own pace to look at.

What-if keeps what the hardware and the untouched nodes said, and re-runs the replaced node and
every node that hears it, directly or through others. Recorded sensors do not react to what a new
node does, so only this is promised: the same log and the same replacement give the same bytes.
"""

from __future__ import annotations

import heapq
import json
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import zmq

from vibrissa.messages.log_format import LogError, Record
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.transport import ZmqPort
from vibrissa.processes import provenance
from vibrissa.processes.framelog import FrameLog, frame_of
from vibrissa.processes.group import Group
from vibrissa.processes.node import counters
from vibrissa.processes.rebuild import (
    Replacements,
    check_replacements,
    experiment_of,
    make_stepper,
    open_log,
)
from vibrissa.processes.results import OnProgress, Progress, UnusableLogError, silent
from vibrissa.processes.simulate import Recording, make_directory
from vibrissa.processes.table import PROCESSES, listeners

LOOK_AHEAD_NS: Final = 1_000_000_000
"""Records of different processes are at most this far out of order in a log."""
NEVER_FED: Final = ("node.receipt", "node.telemetry")


def affected(replaced: Replacements) -> list[str]:
    """The replaced nodes and every node their messages reach, in table order; devices never are."""
    reached = set(replaced)
    while True:
        topics = {t for n in reached for t in PROCESSES[n].says}
        more = reached | {n for t in topics for n in listeners(t) if not PROCESSES[n].source}
        if more == reached:
            return [n for n in PROCESSES if n in reached]
        reached = more


def what_if(
    log: Path, replacements: Replacements, out: Path, on_progress: OnProgress = silent
) -> dict[str, Any]:
    """Re-run a log with nodes replaced; write out/run.mcap and out/summary.json.

    Raises UnusableLogError for a log or a replacement that can't be used, RunError when the
    directory exists.
    """
    if not replacements:
        raise UnusableLogError("a what-if run needs at least one --replace NODE=module:Class")
    check_replacements(replacements)
    reader = open_log(log)
    experiment = experiment_of(reader)
    if "rig" in replacements and not experiment.rig.virtual:
        raise UnusableLogError(f"{log}: rig was no node in this run, it can't be replaced")
    rerun = affected(replacements)
    steppers = {n: make_stepper(n, experiment, replacements) for n in rerun}
    make_directory(out)
    named = ", ".join(f"{n}={target}" for n, target in replacements.items())
    meta = provenance.metadata(experiment.model_dump_json(), "what-if")
    meta |= {"replacements": named, "nodes": ",".join(rerun), "of": reader.run_id}
    run_id = f"what-if-{provenance.config_hash(reader.run_id + named)[:16]}"
    new = FrameLog(out / "run.mcap", run_id, meta)
    recording = Recording(new, steppers)
    group = Group([(steppers[n], PROCESSES[n].hears) for n in rerun], recording.stepped)
    began = time.monotonic()
    try:
        for record in in_time_order(reader):
            if record.source in steppers or record.topic in NEVER_FED:
                continue
            frame = frame_of(record)
            new.write(frame)
            group.feed(frame)
            if record.topic == "arm.state":
                on_progress(Progress("re-running", record.t * 1e-9, experiment.run.duration))
        recording.finish("completed")
    except LogError as error:
        raise UnusableLogError(str(error)) from None
    summary = {
        "ok": True,
        "cause": "completed",
        "mode": "what-if",
        "replaced": dict(replacements),
        "rerun": rerun,
        "steps": recording.steps,
        "messages": dict(sorted(new.received.items())),
        "counters": {n: counters(s) for n, s in steppers.items()},
        "realtime_factor": round(recording.t * 1e-9 / max(time.monotonic() - began, 1e-9), 2),
        "log": str((out / "run.mcap").absolute()),
        "run_id": run_id,
    }
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    return summary


def in_time_order(reader: LogReader) -> Iterator[Record]:
    """The records of a log by logical time; equal times keep their order in the file."""
    heap: list[tuple[int, int, Record]] = []
    newest = 0
    for count, record in enumerate(reader):
        heapq.heappush(heap, (record.t, count, record))
        newest = max(newest, record.t)
        while heap[0][0] < newest - LOOK_AHEAD_NS:
            yield heapq.heappop(heap)[2]
    while heap:
        yield heapq.heappop(heap)[2]


def play(log: Path, on_progress: OnProgress = silent, endpoint: str = "") -> dict[str, Any]:
    """Re-publish a log at its own pace, for looking; nothing about it is deterministic.

    Everything is published at one endpoint (ipc in a private directory unless given), named in the
    progress notes. Raises UnusableLogError, TransportError.
    """
    reader = open_log(log, allow_cut=True)
    folder = Path(tempfile.mkdtemp(prefix="vibrissa-"))
    endpoint = endpoint or f"ipc://{folder}/replay"
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    published = 0
    port = None
    try:
        port = ZmqPort(context, endpoint, linger_ms=200)
        began: float | None = None
        t = 0
        for record in in_time_order(reader):
            began = began if began is not None else time.monotonic() - record.t * 1e-9
            left = began + record.t * 1e-9 - time.monotonic()
            if left > 0:
                port.flush()
                time.sleep(left)
                port.subscribers()  # whoever has come to look since
            port.publish(frame_of(record))
            published += 1
            t = max(t, record.t)
            if published % 1000 == 0:
                on_progress(Progress("playing", t * 1e-9, 0.0, endpoint))
    except LogError as error:
        raise UnusableLogError(str(error)) from None
    finally:
        if port is not None:
            port.close()
        context.destroy(linger=0)
        shutil.rmtree(folder, ignore_errors=True)
    return {"ok": True, "published": published, "duration_s": t * 1e-9, "endpoint": endpoint}
