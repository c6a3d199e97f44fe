"""`vibrissa bench touch`: does touch alone beat its own odometry, on a small sample.

Few runs of `vibrissa experiment slam`: batch and lag 100, blind and shuffled beside them. Floor is
the run's own dead reckoning, ratio 1. Then what it costs: by length of run, memory and lag, and the
graph's solver beside SciPy's.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from vibrissa.processes.results import OnProgress, Progress
from vibrissa.slam.interface import Odometry
from vibrissa.slam.sequence import SequenceSlam
from vibrissa.slam.sequence_config import SequenceConfig
from vibrissa.tools.bench import Bench, Target
from vibrissa.tools.bench_touch_cost import by_length, by_setting, by_solver, settings
from vibrissa.tools.experiment.design import CONTACT_ANGLE
from vibrissa.tools.experiment.mapping import noisy
from vibrissa.tools.experiment.recording import Recording
from vibrissa.tools.experiment.scores import RELATIONS
from vibrissa.tools.experiment.slam_report import tabulate
from vibrissa.tools.experiment.slam_runs import ROWS, odometer, run_row, works
from vibrissa.tools.experiment.tasks import recorded

SEEDS: Final = 2
COSTED: Final = "third"
"""Odometry noise under which costs are measured."""
TOUCH: Final = ("sequence, batch", "sequence, lag 100")
CONTROLS: Final = (
    "sequence, batch, blind",
    "sequence, batch, shuffled",
    "sequence, lag 100, shuffled",
)


def bench(out: Path, seconds: float, on_progress: OnProgress, *, quick: bool = False) -> Bench:
    """Two seeds in two mazes each under three odometry noises; `seconds` is not looked at.

    quick: one short data set without costs by size, to see that it works.
    """
    wanted = works(SEEDS, quick, ["plain"])
    wanted = wanted[:1] if quick else wanted
    rows = [row for row in ROWS if row.name in (*TOUCH, *CONTROLS)]
    runs: list[dict[str, Any]] = []
    costs: list[dict[str, Any]] = []
    aims: list[Target] = []
    with tempfile.TemporaryDirectory() as cache:
        for done, work in enumerate(wanted):
            on_progress(Progress(work.noise, float(done), float(len(wanted))))
            recording = recorded(Path(cache), work.rig)
            motion = noisy(recording, work.noise, work.rig.seed)
            labels = {"group": work.group, "noise": work.noise, "seed": work.rig.seed}
            runs += [
                labels | run_row(recording, motion, row, work.noise, work.rig.seed) for row in rows
            ]
        cost = milliseconds(recording, work.noise, work.rig.seed)
        if not quick:
            on_progress(Progress("costs", 0.0, 0.0))
            costs, aims = measured(
                [(recorded(Path(cache), w.rig), w.rig.seed) for w in wanted if w.noise == COSTED]
            )
    table = tabulate(runs)
    targets = []
    for name in TOUCH:
        cells = [cell for cell in table if cell["row"] == name]
        won = min(cell[r]["wins"] / cell["n"] for cell in cells for r in RELATIONS)
        targets.append(Target(f"{name}: least share of runs won", won, "share", ">=", 0.95))
    loops = sum(cell["loops"] for cell in table if cell["row"] in CONTROLS)
    targets.append(Target("loops blind or shuffled", loops, "loops per run", "==", 0))
    targets.append(Target("lag 100, processor time per whisk", cost, "ms", "<=", 5))
    flat = [
        {k: v for k, v in cell.items() if not isinstance(v, dict)}
        | {f"{r} {part}": cell[r][part] for r in RELATIONS for part in ("ratio", "worst", "wins")}
        for cell in table
    ]
    return Bench("touch", [*flat, *costs], targets + aims)


def measured(
    recordings: Sequence[tuple[Recording, int]],
) -> tuple[list[dict[str, Any]], list[Target]]:
    """The tables of costs over recordings (with their seeds), and what they should be."""
    recording, seed = recordings[0]
    lengths = by_length(recording, COSTED, seed)
    solvers = by_solver(recording, COSTED, seed)
    longest = lengths[-1]
    aims = [
        Target(f"{longest['whisks']} whisks, p99 of a whisk", longest["p99, ms"], "ms", "<=", 50),
        Target("solver against SciPy's, poses apart", solvers[1]["apart"], "m, rad", "<=", 1e-9),
        Target("SciPy's solver over the compiled one", solvers[1]["ratio"], "x", ">=", 1),
    ]
    return [*lengths, *solvers, *by_setting(recordings, COSTED, settings())], aims


def milliseconds(recording: Recording, noise: str, seed: int) -> float:
    """Mean processor time of a step of the sequence SLAM, lag 100, ms."""
    slam = SequenceSlam(SequenceConfig(lag=100, odometer=odometer(noise, seed)))
    steps = [Odometry(*motion) for motion in recording.motion.tolist()]
    images = np.ascontiguousarray(recording.image(CONTACT_ANGLE))
    begun = time.process_time()
    for image, step in zip(images, steps, strict=True):
        slam.step(image, step)
    return 1e3 * (time.process_time() - begun) / len(steps)
