"""`vibrissa bench swap`: a controller is swapped for another a thousand times in one live run.

Ordinary processes that only compute keep every core busy meanwhile. First the run goes on without
swaps, then it swaps as fast as requests are answered, so both are measured in the same run under
the same load. Everything about ticks is read from the log, which is then re-run in both executors.
Beside it stands what a swap inside the loop's own process would cost: the lateness of a bare 2 kHz
loop, alone and while a thread of its process imports and compiles a controller.
"""

from __future__ import annotations

import bisect
import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from vibrissa.messages.codec import decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.types import TICK_HZ, TICK_NS
from vibrissa.processes import realtime
from vibrissa.processes.client import Client
from vibrissa.processes.config import Experiment, load_experiment, slew_limit
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.results import OnProgress, Progress, RunError
from vibrissa.processes.sampler import CONTROLLER
from vibrissa.processes.stats import Histogram
from vibrissa.processes.supervisor import Supervisor
from vibrissa.processes.verify import verify
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.floors import PRIORITY
from vibrissa.tools.machine import with_room
from vibrissa.tools.run import next_directory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SWAPS: Final = 1000
PAIR: Final = ("open_loop", "rcp")
TOGETHER: Final = [["rig", "sampler", "whisk"], ["arm", "slam"]]
"""Two cores have no room for a process per node beside a newcomer and other people's work: one
hosts the loop, another what is slow, and the newcomer has one of its own as always."""
QUIET_S: Final = 15.0
"""Ticks without swaps, before the first one."""
SETTLE_S: Final = 4.0
LONGEST_S: Final = 3600.0
AFTER_TICKS: Final = 20
"""Ticks after a switch in which a command that is missing is blamed on it."""
NEAR: Final = f"within {AFTER_TICKS} ticks of a switch"
AGAIN_S: Final = 0.05
"""From a refusal to the next request: a newcomer that is late needs time to catch up."""
MOST_REFUSALS: Final = 20
"""Refusals per swap wanted, after which the bench gives up."""
SPIN: Final = "while True: pass"
LOOP_S: Final = 10.0


def bench(out: Path, duration: float, on_progress: OnProgress, swaps: int = SWAPS) -> Bench:
    """Measure; the run is kept in `out`. `duration` is how long it goes on without swaps, s."""
    experiment = load_experiment(duration=LONGEST_S, controller=PAIR[0])
    experiment = with_room(experiment, TOGETHER)
    folder = next_directory("swap", out)
    supervisor = Supervisor(experiment, folder, lambda _progress: None)
    operator = Operator(supervisor, folder, min(duration, QUIET_S), swaps, on_progress)
    operator.start()
    with busy_cores():
        summary = supervisor.run()
    operator.join()
    if operator.error is not None:
        why = f"{operator.error}; it ended with: {summary['cause']}"
        raise RunError(f"the run could not be swapped in: {why}")
    on_progress(Progress("reading the log", 0.0, 0.0))
    found = read(folder / "run.mcap", operator.first_tick, experiment)
    verdicts = {how: verify(folder / "run.mcap", how, on_progress) for how in ("fused", "lockstep")}
    requests = effect_times(operator, found["switched"], supervisor.t0)
    lateness = [
        {"sampler lateness": part, **figures(found["lateness"][part])}
        for part in ("without swaps", "with swaps")
    ]
    loops = [{"bare loop": what, **_loop(what)} for what in ("alone", "beside a thread that loads")]
    rows = [
        {
            "swaps": len(found["switched"]),
            "refused": operator.refused,
            "ticks": found["ticks"],
            "fallbacks": found["fallbacks"],
            "cpu_cores": summary["cpu_cores"],
        },
        *(
            {
                "ticks": part,
                "count": found["count"][part],
                "unanswered": found["missed"][part],
                "per_thousand": 1000.0 * found["missed"][part] / max(found["count"][part], 1),
            }
            for part in found["count"]
        ),
        {
            "command step": "across a switch, rad",
            "largest": found["step"],
            "slew_limit": slew_limit(experiment),
        },
        {"time": "request to effect, ms", **figures(requests)},
        {"time": "request to answer, ms", **figures(np.array(operator.answered_ms))},
        *lateness,
        *loops,
        *({"verify": how, "identical": int(v.identical)} for how, v in verdicts.items()),
    ]
    return Bench("swap", rows, targets(rows, found, swaps, experiment), figure(found, loops))


class Operator(threading.Thread):
    """Swaps two controllers back and forth in a live run, then ends it.

    A refusal (the newcomer is late on a busy machine, its whiskers are elsewhere) is counted and
    asked again; the run itself goes on whatever is refused.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        out: Path,
        quiet_s: float,
        swaps: int,
        on_progress: OnProgress,
    ) -> None:
        super().__init__()
        self._supervisor = supervisor
        self._out = out
        self._quiet_s = quiet_s
        self._swaps = swaps
        self._on_progress = on_progress
        self.asked_ns: list[int] = []
        self.answered_ms: list[float] = []
        self.refused = 0
        self.first_tick = 0
        self.error: Exception | None = None

    def run(self) -> None:
        try:
            self._operate()
        except Exception as error:
            self.error = error
        self._supervisor.interrupt()

    def _operate(self) -> None:
        client = self._connect()
        with client:
            client.load(PAIR[1])
            self._wait(SETTLE_S + 0.5 * self._quiet_s)
            while not self._swap(client, PAIR[1]):  # each has the drives for half the time
                pass
            self._wait(0.5 * self._quiet_s)
            while not self._swap(client, PAIR[0]):
                pass
            self.asked_ns.clear()
            self.answered_ms.clear()
            self.first_tick = self._supervisor.tick
            while len(self.asked_ns) < self._swaps:
                self._swap(client, PAIR[(len(self.asked_ns) + 1) % 2])
            self._wait(1.0)

    def _connect(self) -> Client:
        while True:
            try:
                return Client(self._out)
            except RunError:
                if self._supervisor.cause:
                    raise
                time.sleep(0.2)

    def _swap(self, client: Client, name: str) -> bool:
        asked = time.monotonic_ns()
        try:
            client.swap(name)
        except RunError as refusal:
            if not str(refusal).startswith("swap to"):
                raise
            self.refused += 1
            if self.refused > MOST_REFUSALS * self._swaps:
                raise
            time.sleep(AGAIN_S)
            return False
        self.asked_ns.append(asked)
        self.answered_ms.append((time.monotonic_ns() - asked) * 1e-6)
        self._on_progress(Progress("swapping", len(self.asked_ns), self._swaps))
        return True

    def _wait(self, seconds: float) -> None:
        until = self._supervisor.tick + seconds * TICK_HZ
        while self._supervisor.tick < until and not self._supervisor.cause:
            time.sleep(0.05)


@contextlib.contextmanager
def busy_cores() -> Iterator[None]:
    """A process that only computes, at a low ordinary priority, for every core."""
    command = ["nice", "-n", "10", sys.executable, "-c", SPIN]
    spinners = [subprocess.Popen(command) for _ in os.sched_getaffinity(0)]
    try:
        yield
    finally:
        for spinner in spinners:
            spinner.kill()
            spinner.wait()


def read(log: Path, first_tick: int, experiment: Experiment) -> dict[str, Any]:
    """What the log says of every tick: who answered it, how late its sample was, what moved.

    Ticks from the end of calibration on are counted, up to the operator's end. A tick that is not
    answered near a switch is held against the share that its owner leaves unanswered anyway.
    """
    commands: dict[int, tuple[str, np.ndarray[Any, Any]]] = {}
    twice = fallbacks = 0
    switched: list[int] = []
    owners = [(0, CONTROLLER.name)]
    telemetry: list[tuple[int, float, float]] = []
    start, end = None, None
    for record in LogReader(log):
        if record.topic == "head.command":
            body = decode(frame_of(record)).body
            twice += body.tick in commands
            commands[body.tick] = (body.controller, body.command)
        elif record.topic == "node.event":
            event = decode(frame_of(record)).body
            if event.kind == "switched":
                switched.append(event.tick)
                owners.append((event.tick, event.cause.partition("#")[0]))
            fallbacks += event.kind == "fallback" and event.tick > first_tick
        elif record.topic == "run.event":
            event = decode(frame_of(record)).body
            if event.kind == "retract":
                end = event.tick
        elif record.topic == "run.calibration" and start is None:
            start = record.t // TICK_NS
        elif record.topic == "node.telemetry" and record.source == "sampler":
            figures_ = decode(frame_of(record)).body.lateness_us
            telemetry.append((record.t // TICK_NS, float(figures_[0]), float(figures_[1])))
    start, end = start or 0, end or max(commands)
    start += int(SETTLE_S * TICK_HZ)  # the newcomer was loaded meanwhile
    after = sorted({t for s in switched for t in range(s, min(s + AFTER_TICKS, end))})
    near = set(after)
    since = [tick for tick, _ in owners]

    def owner(tick: int) -> str:
        return owners[bisect.bisect_right(since, tick) - 1][1]

    parts: dict[str, Sequence[int]] = {
        f"without swaps, {name}": [
            t for t in range(start, first_tick) if owner(t) == name and t not in near
        ]
        for name in sorted({name for _, name in owners})
    }
    parts |= {"with swaps": range(first_tick, end), NEAR: [t for t in after if t >= first_tick]}
    missed = {part: sum(t not in commands for t in ticks) for part, ticks in parts.items()}
    rates = {part: missed[part] / max(len(ticks), 1) for part, ticks in parts.items()}
    usual = [rates[f"without swaps, {owner(t)}"] for t in parts[NEAR]]
    lateness = {
        "without swaps": np.array([m for t, m, _ in telemetry if start <= t < first_tick]),
        "with swaps": np.array([m for t, m, _ in telemetry if first_tick <= t < end]),
    }
    return {
        "ticks": end - start,
        "twice": twice,
        "fallbacks": fallbacks,
        "switched": [s for s in switched if s >= first_tick],
        "count": {part: len(ticks) for part, ticks in parts.items()},
        "missed": missed,
        "because_of_swaps": rates[NEAR] - sum(usual) / max(len(usual), 1),
        "step": largest_step(commands, switched),
        "lateness": lateness,
    }


def largest_step(commands: dict[int, Any], switched: list[int]) -> float:
    """Largest change of any drive's command from one tick to the next around a switch, rad."""
    largest = 0.0
    for tick in switched:
        for later in range(tick, tick + AFTER_TICKS):
            if later in commands and later - 1 in commands:
                step = np.abs(commands[later][1].astype(float) - commands[later - 1][1]).max()
                largest = max(largest, float(step))
    return largest


def effect_times(operator: Operator, switched: list[int], t0: int) -> np.ndarray[Any, Any]:
    """ms from each accepted request to the tick from which on its controller answered."""
    ticks = np.array(switched[: len(operator.asked_ns)], np.int64)
    asked = np.array(operator.asked_ns[: len(ticks)], np.int64)
    found: np.ndarray[Any, Any] = (t0 + ticks * TICK_NS - asked) * 1e-6
    return found


def figures(values: np.ndarray[Any, Any]) -> dict[str, float]:
    """p50, p99 and max of some values, NaN of none."""
    if not len(values):
        return dict.fromkeys(("p50", "p99", "max"), float("nan"))
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(values.max())}


def targets(
    rows: list[dict[str, Any]], found: dict[str, Any], swaps: int, experiment: Experiment
) -> list[Target]:
    """The figures to reach."""
    identical = [row["identical"] for row in rows if "verify" in row]
    limit = slew_limit(experiment)
    return [
        Target("swaps made", len(found["switched"]), "swaps", ">=", swaps),
        Target("ticks with two commands", found["twice"], "ticks", "==", 0),
        Target("fallbacks while swapping", found["fallbacks"], "fallbacks", "==", 0),
        Target(
            "unanswered ticks within 20 of a switch, beyond their owners' share without swaps",
            1000.0 * max(found["because_of_swaps"], 0.0),
            "per thousand",
            "<=",
            1.0,
        ),
        Target(
            "largest command step across a switch, over the slew limit",
            found["step"] / limit,
            "ratio",
            "<=",
            1.0 + 1e-5,
        ),
        Target("log re-runs identical, fused and lockstep", sum(identical), "of 2", "==", 2),
    ]


def figure(found: dict[str, Any], loops: list[dict[str, Any]]) -> Figure:
    """Mean lateness per second of the sampler without and with swaps; the bare loops' lateness."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(9, 4), layout="constrained")
    left, right = made.subplots(1, 2)
    for part, values in found["lateness"].items():
        if len(values):
            left.plot(np.sort(values), np.linspace(0, 1, len(values)), label=part)
    left.set_xlabel("lateness of the sampler, mean of a second, us")
    left.set_ylabel("share of seconds")
    left.legend()
    names = [row["bare loop"] for row in loops]
    for key in ("p50", "p99", "max"):
        right.plot(names, [row[key] for row in loops], "o-", label=key)
    right.set_yscale("log")
    right.set_ylabel("lateness of a bare 2 kHz loop, us")
    right.legend()
    return made


def _loop(what: str) -> dict[str, float]:
    """Lateness of a bare 2 kHz loop in a process of its own, us."""
    command = [sys.executable, "-m", "vibrissa.tools.bench_swap", what]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    if done.returncode:
        raise RunError(f"the bare loop could not be measured: {done.stderr.strip()[-200:]}")
    found: dict[str, float] = json.loads(done.stdout)
    return found


def _load_again_and_again(done: threading.Event) -> None:
    """What loading a controller does, over and over: import its modules and compile its law."""
    import importlib

    import numba

    from vibrissa.control import rcp

    while not done.is_set():
        importlib.reload(rcp)
        numba.njit(lambda values: (values * values).sum())(np.ones(18))


def _bare_loop(what: str) -> None:
    done = threading.Event()
    loader = threading.Thread(target=_load_again_and_again, args=(done,))
    if what != "alone":
        loader.start()
    realtime.prepare(PRIORITY, "reflex")
    late = Histogram()
    start = time.monotonic_ns() + TICK_NS
    missed = 0
    for tick in range(int(LOOP_S * TICK_HZ)):
        due = start + tick * TICK_NS
        realtime.sleep_until(due)
        lateness = time.monotonic_ns() - due
        late.add(lateness * 1e-3)
        missed += lateness > TICK_NS
    done.set()
    summary = {key: late.summary()[key] for key in ("p50", "p99", "max")}
    print(json.dumps(summary | {"missed_per_thousand": 1000.0 * missed / (LOOP_S * TICK_HZ)}))


if __name__ == "__main__":
    _bare_loop(sys.argv[1])
