"""`vibrissa bench devices`: the same loop with a virtual rig and over each emulated wire.

Runs follow one another in one call: virtual, serial, CAN FD; the arm over RTDE in the latter two.
Of each: samples and messages lost, the time from a sample's arrival to the command that answers it,
and how many ticks later the drives obey, as the head itself reports it. Beside them how much faster
than the stream the parsers read. On fewer than four cores `sampler` and `whisk` share the process
of `rig` in all three: emulators take the place of hardware, and of its cores.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from vibrissa.messages.codec import decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes.config import Experiment, Rig, load_experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.results import OnProgress, RunError
from vibrissa.processes.supervisor import run_live
from vibrissa.processes.verify import verify
from vibrissa.rig.devices.can_bus import close_bus, open_bus
from vibrissa.rig.devices.can_layout import Assembler, pack_sample
from vibrissa.rig.devices.errors import DeviceUnavailable
from vibrissa.rig.devices.framing import FrameParser, frame
from vibrissa.rig.devices.protocol import RawSample, pack_from_head, unpack_from_head
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.machine import with_room
from vibrissa.tools.run import next_directory

MULTICAST: Final = "239.74.163.19"
"""A group of its own, so that a bench hears no other program's frames."""
STREAM_HZ: Final = 2000
QUICK_S: Final = 3.0


def rigs() -> dict[str, Rig]:
    """What is compared. CAN goes by multicast where this kernel has it, else by broadcast."""
    bus = f"can:udp_multicast:{MULTICAST}"
    try:
        close_bus(open_bus("bench", "udp_multicast", MULTICAST))
    except DeviceUnavailable:
        bus = "can:loopback:emulated"
    return {
        "virtual": Rig(),
        "serial": Rig(head="serial:emulated", arm="rtde:emulated", emulate=True),
        "can": Rig(head=bus, arm="rtde:emulated", emulate=True),
    }


def bench(out: Path, duration: float, on_progress: OnProgress, *, quick: bool = False) -> Bench:
    """Measure; the runs are kept in `out`. quick: three seconds of each."""
    experiment = load_experiment(duration=min(duration, QUICK_S) if quick else duration)
    experiment = with_room(experiment, [["rig", "sampler", "whisk"]])
    rows = []
    for name, rig in rigs().items():
        asked = experiment.model_copy(update={"rig": rig})
        rows.append(measured(name, asked, next_directory(name, out), on_progress))
    parsers = [parser_row(name) for name in ("serial", "can")]
    return Bench("devices", [*rows, *parsers], targets(rows, parsers))


def measured(
    name: str, experiment: Experiment, out: Path, on_progress: OnProgress
) -> dict[str, Any]:
    """One run: what was lost, and how long the loop took. Raises RunError if it has no samples."""
    summary = run_live(experiment, out, on_progress)
    lags = obeyed_after(out / "run.mcap")
    if not len(lags):
        raise RunError(f"the run over {name} was never obeyed: {summary['cause']}")
    device = summary["counters"].get("head-device", {})
    # From a sample's arrival at our first process to its command in that process or, where the
    # head is simulated in the run, to the arbiter.
    latency = summary["latency_us"].get("head-device") or summary["latency_us"]["sampler"]
    return {
        "rig": name,
        "head": experiment.rig.head,
        "together": ", ".join("+".join(names) for names in experiment.run.together),
        "cause": summary["cause"],
        "ticks": summary["ticks"],
        "samples_lost": device.get("lost", 0),
        "messages_lost": sum(counts["lost"] for counts in summary["messages"].values()),
        "latency_p50_us": latency["p50"],
        "latency_p99_us": latency["p99"],
        "obeyed_p50_ticks": float(np.median(lags)),
        "obeyed_p99_ticks": float(np.quantile(lags, 0.99)),
        "cpu_cores": summary["cpu_cores"],
        "verified": "yes" if verify(out / "run.mcap").identical else "no",
    }


def obeyed_after(log: Path) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Of each sample: how many ticks old the sample is that its command answers, int64[n]."""
    lags = []
    for record in LogReader(log):
        if record.topic == "rig.sample":
            body = decode(frame_of(record)).body
            if 0 <= body.answers < body.tick:
                lags.append(body.tick - body.answers)
    return np.array(lags, np.int64)


def parser_row(name: str) -> dict[str, Any]:
    """How many samples a second the parser of a wire reads, the best of five."""
    samples = [RawSample(k, 500 * k, k, 0, bytes(range(108))) for k in range(2000)]
    line = b"".join(frame(pack_from_head(s)) for s in samples)
    pieces = [line[k : k + 4096] for k in range(0, len(line), 4096)]  # as a port gives them
    frames = [item for s in samples for item in pack_sample(s)]

    def read_line() -> list[object]:
        parser = FrameParser()
        return [unpack_from_head(data) for piece in pieces for data in parser.feed(piece)]

    def read_bus() -> list[object]:
        assembler = Assembler()
        return [item for item in map(assembler.take, frames) if item is not None]

    best = math.inf
    for _ in range(5):
        begun = time.perf_counter()
        read = read_line() if name == "serial" else read_bus()
        best = min(best, time.perf_counter() - begun)
        if read != samples:
            raise RunError(f"the {name} parser read other samples than were sent")
    rate = len(samples) / best
    return {"parser": name, "samples_per_s": rate, "over_stream": rate / STREAM_HZ}


def targets(rows: list[dict[str, Any]], parsers: list[dict[str, Any]]) -> list[Target]:
    """What runs over devices were to reach."""
    found = []
    for row in rows[1:]:
        name = row["rig"]
        lost = row["samples_lost"]
        completed = float(row["cause"] == "completed")
        found += [
            Target(f"{name}: runs that complete", completed, "runs", "==", 1),
            Target(f"{name}: samples lost", lost, "samples", "==", 0),
            Target(f"{name}: messages lost", row["messages_lost"], "messages", "==", 0),
            Target(f"{name}: logs that verify", float(row["verified"] == "yes"), "runs", "==", 1),
        ]
    found += [
        Target(f"{row['parser']} parser over the stream", row["over_stream"], "ratio", ">=", 20.0)
        for row in parsers
    ]
    return found
