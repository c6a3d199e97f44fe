"""`vibrissa bench experiment`: how fast whole data sets are made, and where the time goes.

A data set is the rig carried along its circuits, the controller, the images and RatSLAM over them,
on one core. The floor is the plant alone: the same ticks, with the head held in the air and no
controller, images or SLAM. Peer is `vibrissa simulate`, which makes the same bytes message by
message.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from vibrissa.messages.types import TICK_HZ
from vibrissa.numerics import compiled
from vibrissa.processes.config import load_experiment
from vibrissa.processes.cycle import WhiskLoop
from vibrissa.processes.results import OnProgress, Progress
from vibrissa.processes.simulate import simulate
from vibrissa.rig.head import HeadModel, head_step
from vibrissa.rig.plant import fresh_memo, head_model, rest_state
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.experiment.design import CONTROLLERS, MAX_ANGLE, main_rig, scale
from vibrissa.tools.experiment.mapping import MapCase, run_map
from vibrissa.tools.experiment.paper import compile_all
from vibrissa.tools.experiment.recording import Recording, RigCase, duration, make_setup, record
from vibrissa.tools.run import next_directory

FLOOR_SECONDS: Final = 60
SIMULATED_SECONDS: Final = 10.0


def bench(out: Path, seconds: float, on_progress: OnProgress) -> Bench:
    """Time each part of a ten-circuit data set, one core, processor time.

    seconds: of logical time; a shorter one than the data set's 3,800 s drops circuits.
    """
    compile_all()
    whole = scale(1, False)
    circuits = max(1, min(whole.circuits, round(seconds / 375)))
    cases = [
        replace(main_rig(whole, whole.seeds[0], name), sequence=whole.sequence[:circuits])
        for name in CONTROLLERS
    ]
    growth = memory_growth(cases[1])
    rows, speeds = [], []
    for done, case in enumerate(cases):
        on_progress(Progress(case.controller, float(done), float(len(cases))))
        made = data_set(case)
        rows += made
        speeds.append(made[-1]["times_real_time"])
    floor = floor_row()
    peer = simulate_row(out)
    rows += [floor, peer]
    return Bench(
        "experiment",
        rows,
        [
            Target("data set on one core", min(speeds), "times real time", ">=", 300),
            Target("data set on one core, aim", min(speeds), "times real time", ">=", 1000),
            Target(
                "data set over simulate",
                min(speeds) / peer["times_real_time"],
                "times",
                ">=",
                10,
            ),
            Target("memory from a tenth to the whole", growth, "MB", "<=", 16),
        ],
    )


def data_set(case: RigCase) -> list[dict[str, Any]]:
    """Rows of one data set: closed loop, images on top, RatSLAM, and the sum."""
    logical = duration(case)
    loop_s = timed(lambda: sum(1 for _ in WhiskLoop(make_setup(case)[0]).cycles()))
    kept: list[Recording] = []
    record_s = timed(lambda: kept.append(record(case)))
    map_s = timed(lambda: run_map(kept[0], MapCase(MAX_ANGLE, case.seed)))
    parts = (
        ("plant, controller, arbiter", loop_s),
        ("these, images and odometry", record_s),
        ("RatSLAM", map_s),
        ("whole data set", record_s + map_s),
    )
    return [_row(f"{case.controller}: {name}", logical, taken) for name, taken in parts]


def floor_row() -> dict[str, Any]:
    """The plant alone, whiskers at rest in the air."""
    made, _ = make_setup(main_rig(scale(1, False), 0, "open_loop"))
    model = head_model(made.boxes, made.head)
    state, memo = rest_state(made.head).reshape(-1), fresh_memo().reshape(-1)
    pose = np.array([0.63, 0.45, 0.3, 0.0])
    command = np.zeros(18, dtype=np.float32)
    sample = np.zeros((3, 18), dtype=np.float32)
    _ticks(state, memo, model, pose, command, sample, 0, 1)
    ticks = FLOOR_SECONDS * TICK_HZ
    taken = timed(lambda: _ticks(state, memo, model, pose, command, sample, 1, ticks))
    return _row("floor: plant at rest in the air", FLOOR_SECONDS, taken)


@compiled
def _ticks(
    state: Any,
    memo: Any,
    model: HeadModel,
    pose: Any,
    command: Any,
    sample: Any,
    first: int,
    count: int,
) -> None:
    for tick in range(first, first + count):
        head_step(
            state, memo, model, True, 1, tick, pose, command, False, sample[0], sample[1], sample[2]
        )


def simulate_row(out: Path) -> dict[str, Any]:
    """The same closed loop by `vibrissa simulate`, with its log written."""
    compiles = load_experiment(duration=SIMULATED_SECONDS / 10)
    simulate(compiles, next_directory("simulate", out))
    experiment = load_experiment(duration=SIMULATED_SECONDS)
    taken = timed(lambda: simulate(experiment, next_directory("simulate", out)))
    return _row("peer: simulate", SIMULATED_SECONDS, taken)


def memory_growth(case: RigCase) -> float:
    """How much more memory the loop of the whole takes than that of its first tenth, MB."""
    short = replace(case, sequence=case.sequence[:1])
    peaks = []
    for which in (short, case):
        for _ in WhiskLoop(make_setup(which)[0]).cycles():
            pass
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return peaks[1] - peaks[0]


def timed(work: Callable[[], object]) -> float:
    """Processor time of this process, s: other work on the machine does not count."""
    start = time.process_time()
    work()
    return time.process_time() - start


def _row(what: str, logical: float, taken: float) -> dict[str, Any]:
    return {
        "what": what,
        "logical_s": logical,
        "cpu_s": taken,
        "ms_per_second": 1e3 * taken / logical,
        "times_real_time": logical / taken,
    }
