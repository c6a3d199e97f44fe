"""`vibrissa bench live`: how late, how fast and how dear a live run is, beside bare floors.

In one call: floors, a live run of the default experiment, the same with `sampler` and `whisk` in
one process, floors again. Lateness (a due tick to the start of its step), work time (a step),
period (start to start) and latency (a sample going out to its command coming back) are kept apart.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vibrissa.messages.codec import decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.receipts import entries
from vibrissa.processes.results import OnProgress, RunError
from vibrissa.processes.supervisor import run_live
from vibrissa.tools import floors
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.run import next_directory

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

FIGURES: Final = ("p50", "p99", "p999", "max")
KINDS: Final = ("latency", "lateness", "work", "period")


def bench(out: Path, duration: float, on_progress: OnProgress) -> Bench:
    """Measure; the two runs are kept in `out`."""
    apart = load_experiment(duration=duration)
    together = apart.model_copy(
        update={"run": apart.run.model_copy(update={"together": [["sampler", "whisk"]]})}
    )
    found = floors.measure(on_progress)
    live = measured_run(apart, next_directory("live", out), on_progress)
    joined = measured_run(together, next_directory("together", out), on_progress)
    bare = floors.medians(found + floors.measure(on_progress))

    times = [{"run": "floor", "what": what, **figures} for what, figures in bare.items()]
    times += time_rows("live", live) + time_rows("together", joined)
    totals = [total_row("live", live), total_row("together", joined)]
    echo = bare[f"bare echo, {floors.SET_UPS[1]}, latency"]["p50"]
    return Bench("live", totals + times, targets(totals, live, joined, echo), figure(times))


def measured_run(experiment: Experiment, out: Path, on_progress: OnProgress) -> dict[str, Any]:
    """A live run's summary with `receipts_missing` added. Raises RunError if it ended early."""
    summary = run_live(experiment, out, on_progress)
    if summary["cause"] != "completed":
        raise RunError(f"the measured run ended early: {summary['cause']}")
    return {**summary, "receipts_missing": receipts_missing(out / "run.mcap")}


def receipts_missing(log: Path) -> int:
    """Steps without a receipt, up to and including each node's last input, the stop of the run."""
    steps: dict[str, list[int]] = {}
    stopped: set[str] = set()
    stop_seq = -1
    for record in LogReader(log):
        if record.topic == "run.event":
            stop_seq = max(stop_seq, record.seq)
    for record in LogReader(log):
        if record.topic == "node.receipt":
            for entry in entries(decode(frame_of(record))):
                steps.setdefault(record.source, []).append(entry.step)
                if entry.stream[0] == "run.event" and entry.seq == stop_seq:
                    stopped.add(record.source)
    return sum(max(s) + 1 - len(s) for s in steps.values()) + len(steps.keys() - stopped)


def time_rows(run: str, summary: dict[str, Any]) -> list[dict[str, Any]]:
    """Every time a run measured, a row per kind and node."""
    return [
        {"run": run, "what": f"{node}, {kind}", **{key: figures[key] for key in FIGURES}}
        for kind in KINDS
        for node, figures in summary[f"{kind}_us"].items()
        if figures
    ]


def total_row(run: str, summary: dict[str, Any]) -> dict[str, Any]:
    """What a run came to: ticks, losses, receipts, processor use.

    A tick is answered when the command for its sample is there before the next sample, and obeyed
    when the drives follow that command at the next sample already.
    """
    ticks, obeyed = summary["ticks"], summary["counters"]["sampler"]["obeyed"]
    return {
        "run": run,
        "ticks": ticks,
        "answered_percent": 100.0 * summary["ticks_answered"] / ticks if ticks else math.nan,
        "obeyed_percent": 100.0 * obeyed / ticks if ticks else math.nan,
        "messages": sum(counts["sent"] for counts in summary["messages"].values()),
        "lost": sum(counts["lost"] for counts in summary["messages"].values()),
        "receipts_missing": summary["receipts_missing"],
        "cpu_cores": summary["cpu_cores"],
    }


def targets(
    totals: list[dict[str, Any]], live: dict[str, Any], joined: dict[str, Any], echo: float
) -> list[Target]:
    """The figures a live run was to reach."""
    apart, together = totals
    p50 = latency_p50(live)
    return [
        Target("messages lost on recorded topics", apart["lost"], "messages", "==", 0),
        Target("steps without receipt", apart["receipts_missing"], "steps", "==", 0),
        Target("ticks answered within one period", apart["answered_percent"], "%", ">=", 99.5),
        Target(
            "latency p50 over that of a bare echo in the same set-up",
            p50 / echo,
            "ratio",
            "<=",
            2.0,
        ),
        Target("processor use", apart["cpu_cores"], "cores", "<=", 1.2),
        Target(
            "sampler and whisk in one process: ticks answered within the same tick",
            together["answered_percent"],
            "%",
            ">=",
            99.5,
        ),
        Target(
            "sampler and whisk in one process: latency p50", latency_p50(joined), "us", "<", 50.0
        ),
    ]


def latency_p50(summary: dict[str, Any]) -> float:
    """Median time from a sample to its command, us."""
    value: float = summary["latency_us"].get("sampler", {}).get("p50", math.nan)
    return value


def figure(times: list[dict[str, Any]]) -> Figure:
    """Latency, lateness, work and period at p50, p99, p99.9 and max, floors beside the runs.

    A colour per node and per floor, a line style per run.
    """
    from matplotlib.figure import Figure

    made = Figure(figsize=(12, 5), layout="constrained")
    axes = made.subplots(1, len(KINDS), sharey=True)
    styles = {"floor": "--", "live": "-", "together": ":"}
    colours: dict[str, str] = {}
    lines: dict[str, Line2D] = {}
    for ax, kind in zip(axes, KINDS, strict=True):
        for row in times:
            who, _, what = row["what"].rpartition(", ")
            if what != kind:
                continue
            colour = colours.setdefault(who, f"C{len(colours)}")
            label = who if row["run"] == "floor" else f"{who}, {row['run']}"
            values = [row[key] for key in FIGURES]
            (line,) = ax.plot(range(4), values, styles[row["run"]], marker=".", color=colour)
            lines.setdefault(label, line)
        ax.set_xticks(range(4), ["p50", "p99", "p99.9", "max"])
        ax.set_yscale("log")
        ax.set_title(kind)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("us")
    made.legend(list(lines.values()), list(lines), loc="outside lower center", ncols=5, fontsize=8)
    return made
