"""The SLAM experiment's runs: RatSLAM, the sequence SLAM and rows without touch over one data set.

Every row of a run sees the same whisks, images and noisy odometry. The Energy Metric is that of the
whisks' poses in the final map, as a ratio to that of the run's own dead reckoning.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import philox_normal, philox_uniform
from vibrissa.rig.maze import format_maze
from vibrissa.rig.maze_random import random_maze
from vibrissa.slam.interface import Odometry
from vibrissa.slam.metrics import energy_metric
from vibrissa.slam.odometer import OdometerNoise, calibrated
from vibrissa.slam.odometry import NOISE_MODELS
from vibrissa.slam.sequence import SequenceSlam
from vibrissa.slam.sequence_config import BATCH, SequenceConfig
from vibrissa.tools.experiment.cache import key_of, load, store
from vibrissa.tools.experiment.design import CONTACT_ANGLE, MAX_ANGLE, SEQUENCE
from vibrissa.tools.experiment.mapping import SHUFFLE_STREAM, MapCase, noisy, run_map
from vibrissa.tools.experiment.recording import Recording, RigCase
from vibrissa.tools.experiment.scores import RELATIONS, dead_reckoning, relation_pairs
from vibrissa.tools.experiment.tasks import recorded, rig_key

Floats = NDArray[np.float64]

CALIBRATION_STREAM: Final = 5000
CALIBRATION_STEPS: Final = 60
CALIBRATION_MOTION: Final = ((0.01, 0.0), (0.0, math.pi / 6.0))
"""Distance (m) and turn (rad) per step of the odometer's straight and turn."""
SMALL_TURN: Final = 0.3
"""Turn per step below which the path assumption takes it for none, rad."""
RIGHT: Final = 0.1
"""m between two whisks of a loop that is right."""
LAGS: Final = {"batch": BATCH, "lag 100": 100, "lag 30": 30, "lag 10": 10, "past only": 0}
NOISES: Final = ("jit", "third", "full")
MAZES: Final = {"A": (0.75, 0.6), "B": (0.4, 0.5)}
"""Probability of walls between ring and inner cells, and between inner cells."""
FIRST_SEED: Final = 700


@dataclass(frozen=True)
class SlamRow:
    """A row of the table: `kind` is sequence, ratslam or path; image and control as in MapCase."""

    name: str
    kind: str
    image: str = CONTACT_ANGLE
    lag: int = BATCH
    control: str = "none"


ROWS: Final = (
    *(SlamRow(f"sequence, {name}", "sequence", lag=lag) for name, lag in LAGS.items()),
    SlamRow("sequence, batch, max angle", "sequence", MAX_ANGLE),
    SlamRow("sequence, batch, blind", "sequence", control="blind"),
    SlamRow("sequence, batch, shuffled", "sequence", control="shuffled"),
    SlamRow("sequence, lag 100, shuffled", "sequence", lag=100, control="shuffled"),
    SlamRow("RatSLAM, contact angle", "ratslam"),
    SlamRow("RatSLAM, contact angle, blind", "ratslam", control="blind"),
    SlamRow("RatSLAM, contact angle, shuffled", "ratslam", control="shuffled"),
    SlamRow("no touch: turns below 0.3 rad are none", "path"),
)


@dataclass(frozen=True)
class SlamWork:
    """A data set (`group`: its cell of the table) under one odometry noise: all rows."""

    group: str
    rig: RigCase
    noise: str


def works(seeds: int, quick: bool) -> list[SlamWork]:
    """All data sets: plain, and variants of path, speed and control; mazes of their own."""
    variants: dict[str, dict[str, Any]] = {
        "plain": {},
        "open loop": {"controller": "open_loop"},
        "wander 4 mm": {"wander": 0.004},
        "20 mm per whisk": {"speed": 0.02},
    }
    found = []
    for group, change in variants.items():
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            for name, (ring, inner) in MAZES.items():
                maze = format_maze(random_maze(7, 5, 1000 * seed + ord(name), ring, inner))
                rig = RigCase(maze, seed, "rcp", "CCA" if quick else SEQUENCE)
                found += [SlamWork(group, replace(rig, **change), noise) for noise in NOISES]
        if quick:
            break
    return found


def run_work(folder: Path, work: SlamWork) -> list[dict[str, Any]]:
    """All rows of a data set under a noise, from the cache or else made now."""
    key = key_of("slam", {**asdict(work), "rows": [asdict(row) for row in ROWS]}, __file__)
    stored = load(folder, f"{key}-{rig_key(work.rig)}")
    if stored is None:
        recording = recorded(folder, work.rig)
        rows = [
            {"group": work.group, "noise": work.noise, "seed": work.rig.seed}
            | run_row(recording, row, work.noise, work.rig.seed)
            for row in ROWS
        ]
        store(folder, f"{key}-{rig_key(work.rig)}", {"rows": np.array(json.dumps(rows))})
        return rows
    found: list[dict[str, Any]] = json.loads(str(stored["rows"]))
    return found


def run_row(recording: Recording, row: SlamRow, noise: str, seed: int) -> dict[str, Any]:
    """Energies of a row and of dead reckoning, how many loops there are and how many are right."""
    motion = noisy(recording, noise, seed)
    reckoned = dead_reckoning(motion)
    links = np.zeros((0, 2), dtype=np.int64)
    if row.kind == "sequence":
        poses, links = _sequence(recording, row, motion, odometer(noise, seed), seed)
    elif row.kind == "ratslam":
        trace = run_map(recording, MapCase(row.image, seed, noise, row.control))  # type: ignore[arg-type]
        poses = trace.map_poses[trace.experience]
    else:
        straightened = motion.copy()
        straightened[np.abs(motion[:, 1] * motion[:, 2]) < SMALL_TURN, 1] = 0.0
        poses = dead_reckoning(straightened)
    found: dict[str, Any] = {"row": row.name, "loops": len(links), "right": None}
    if len(links):
        apart = recording.truth[links[:, 0], :2] - recording.truth[links[:, 1], :2]
        found["right"] = float((np.hypot(*apart.T) < RIGHT).mean())
    for relations in RELATIONS:
        pairs = relation_pairs(relations, len(recording))
        energy = energy_metric(poses, recording.truth, pairs).total
        found[relations] = energy / energy_metric(reckoned, recording.truth, pairs).total
    return found


def odometer(noise: str, seed: int) -> OdometerNoise:
    """The odometer calibrated on a straight and a turn of its own."""
    model = NOISE_MODELS[noise]
    segments = []
    for k, motion in enumerate(CALIBRATION_MOTION):
        steps = []
        for step in range(CALIBRATION_STEPS):
            stream = CALIBRATION_STREAM + k
            normals = (
                philox_normal(seed, stream, 2 * step),
                philox_normal(seed, stream, 2 * step + 1),
            )
            felt = model.apply(Odometry(*motion, 1.0), normals)
            steps.append((felt.v * felt.dt, felt.w * felt.dt))
        segments.append(steps)
    return calibrated(*segments)


def _sequence(
    recording: Recording, row: SlamRow, motion: Floats, noise: OdometerNoise, seed: int
) -> tuple[Floats, NDArray[np.int64]]:
    images = recording.image(row.image)
    if row.control == "blind":
        images = np.zeros_like(images)
    elif row.control == "shuffled":
        draws = [philox_uniform(seed, SHUFFLE_STREAM, k) for k in range(len(images))]
        images = images[np.argsort(np.array(draws), kind="stable")]
    slam = SequenceSlam(SequenceConfig(lag=row.lag, odometer=noise))
    for image, (v, w, dt) in zip(images, motion.tolist(), strict=True):
        slam.step(image, Odometry(v, w, dt))
    found = slam.map()
    return found.poses, found.links[len(recording) - 1 :].astype(np.int64)
