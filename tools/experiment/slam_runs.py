"""The SLAM experiment's runs: RatSLAM, the sequence SLAM and rows without touch over one data set.

Every row of a run sees the same whisks, images and noisy odometry. The Energy Metric is that of the
whisks' poses in the final map, as a ratio to that of the run's own dead reckoning.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import philox_normal, philox_uniform
from vibrissa.processes.slams import head_shape
from vibrissa.rig.maze import format_maze
from vibrissa.rig.maze_random import random_maze
from vibrissa.slam.config import PRESETS
from vibrissa.slam.interface import Odometry
from vibrissa.slam.metrics import energy_metric
from vibrissa.slam.odometer import OdometerNoise, calibrated
from vibrissa.slam.odometry import NOISE_MODELS
from vibrissa.slam.pose_cells import PoseCellError
from vibrissa.slam.ratslam import RatSlam
from vibrissa.slam.sequence import SequenceSlam
from vibrissa.slam.sequence_config import BATCH, SequenceConfig
from vibrissa.tools.experiment.cache import key_of, load, store
from vibrissa.tools.experiment.design import CONTACT_ANGLE, MAX_ANGLE, SEQUENCE
from vibrissa.tools.experiment.mapping import SHUFFLE_STREAM, MapCase, kept_whisks, noisy
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
MEMORY: Final = SequenceConfig().memory
LAGS: Final = {"batch": BATCH, "lag 100": 100, "lag 30": 30, "lag 10": 10, "past only": 0}
NOISES: Final = ("jit", "third", "full")
MAZES: Final = {"A": (0.75, 0.6), "B": (0.4, 0.5)}
"""Probability of walls between ring and inner cells, and between inner cells."""
FIRST_SEED: Final = 900


@dataclass(frozen=True)
class SlamRow:
    """A row of the table: `kind` is sequence, ratslam or path; image and control as in MapCase;
    lag, compass and memory as in SequenceConfig."""

    name: str
    kind: str
    image: str = CONTACT_ANGLE
    lag: int = BATCH
    control: str = "none"
    compass: bool = False
    memory: int = MEMORY


COMPASS: Final = (
    SlamRow("sequence + compass, batch", "sequence", compass=True),
    SlamRow("sequence + compass, lag 100", "sequence", lag=100, compass=True),
    SlamRow("sequence + compass, batch, blind", "sequence", control="blind", compass=True),
    SlamRow("sequence + compass, batch, shuffled", "sequence", control="shuffled", compass=True),
)
"""The sequence SLAM with the wall-line compass, which has controls of its own."""
WITH_COMPASS: Final = ("plain", "yaw 4 deg, wander 4 mm")
ROWS: Final = (
    *(SlamRow(f"sequence, {name}", "sequence", lag=lag) for name, lag in LAGS.items()),
    SlamRow("sequence, batch, max angle", "sequence", MAX_ANGLE),
    SlamRow("sequence, batch, blind", "sequence", control="blind"),
    SlamRow("sequence, batch, shuffled", "sequence", control="shuffled"),
    SlamRow("sequence, lag 100, shuffled", "sequence", lag=100, control="shuffled"),
    *COMPASS,
    SlamRow("RatSLAM, contact angle", "ratslam"),
    SlamRow("RatSLAM, contact angle, blind", "ratslam", control="blind"),
    SlamRow("RatSLAM, contact angle, shuffled", "ratslam", control="shuffled"),
    SlamRow("no touch: turns below 0.3 rad are none", "path"),
)


FEWER: Final = (
    "sequence, batch",
    "sequence, lag 100",
    "sequence, past only",
    "sequence, batch, max angle",
    "sequence, lag 100, shuffled",
    "RatSLAM, contact angle",
    "no touch: turns below 0.3 rad are none",
)
"""Rows of the groups besides `plain`."""
KIDNAPS: Final = ((4, 0.9, 1.2), (8, 0.4, 0.6))
"""Circuit, m from its start, m: stretches over which the head is carried unawares."""


@dataclass(frozen=True)
class Variant:
    """A cell of the table: what is changed of the rig."""

    rig: tuple[tuple[str, Any], ...] = ()
    cells: tuple[int, int] = (7, 5)
    kidnapped: bool = False


VARIANTS: Final[dict[str, Variant]] = {
    "plain": Variant(),
    "open loop": Variant((("controller", "open_loop"),)),
    "yaw 4 deg, wander 4 mm": Variant((("yaw", math.radians(4.0)), ("wander", 0.004))),
    "kidnapped twice": Variant(kidnapped=True),
    "reversed after every circuit": Variant((("sequence", "CACACACACA"),)),
    "9 x 7 cells": Variant(cells=(9, 7)),
    "20 mm per whisk": Variant((("speed", 0.02),)),
}


@dataclass(frozen=True)
class SlamWork:
    """A data set (`group`: its cell of the table) under one odometry noise: all rows."""

    group: str
    rig: RigCase
    noise: str

    @property
    def rows(self) -> tuple[SlamRow, ...]:
        extra = COMPASS if self.group in WITH_COMPASS else ()
        chosen = (row for row in ROWS if row.name in FEWER or row in extra)
        return ROWS if self.group == "plain" else tuple(chosen)


def works(seeds: int, quick: bool, groups: Sequence[str] = ()) -> list[SlamWork]:
    """All data sets: plain, and variants of path, maze, speed and control, or some of these; every
    data set has a maze of its own. quick: plain alone, with a fast head and fewer circuits."""
    found = []
    for group, variant in VARIANTS.items():
        if group not in (("plain",) if quick else groups or VARIANTS):
            continue
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            for name, (ring, inner) in MAZES.items():
                drawn = random_maze(*variant.cells, 1000 * seed + ord(name), ring, inner)
                rig = RigCase(format_maze(drawn), seed, "rcp", SEQUENCE)
                rig = replace(rig, **dict(variant.rig))
                if quick:
                    rig = replace(rig, sequence="CCA", speed=0.04)
                found += [SlamWork(group, rig, noise) for noise in NOISES]
    return found


def row_key(work: SlamWork, row: SlamRow) -> str:
    """Under which a row of a data set is kept."""
    return key_of("slam", {**asdict(work), "row": asdict(row)}, __file__, rig_key(work.rig))


def run_work(folder: Path, work: SlamWork) -> list[dict[str, Any]]:
    """All rows of a data set under a noise, each from the cache or else made now."""
    labels = {"group": work.group, "noise": work.noise, "seed": work.rig.seed}
    labels |= {"maze": key_of("maze", {"maze": work.rig.maze}, __file__)[:12]}
    recording: Recording | None = None
    found = []
    for row in work.rows:
        key = row_key(work, row)
        stored = load(folder, key)
        if stored is None:
            if recording is None:
                recording, motion = driven(folder, work)
            made = run_row(recording, motion, row, work.noise, work.rig.seed)
            stored = {"row": np.array(json.dumps(made))}
            store(folder, key, stored)
        found.append(labels | json.loads(str(stored["row"])))
    return found


def is_done(folder: Path, work: SlamWork) -> bool:
    """Whether all rows of a data set are in the cache."""
    return all(load(folder, row_key(work, row)) is not None for row in work.rows)


def driven(folder: Path, work: SlamWork) -> tuple[Recording, Floats]:
    """The whisks of a data set and its noisy odometry float64[n, 3], as `run_row` takes it."""
    recording = recorded(folder, work.rig)
    motion = noisy(recording, work.noise, work.rig.seed)
    if not VARIANTS[work.group].kidnapped:
        return recording, motion
    kept = kept_whisks(recording, KIDNAPS)
    return recording.chosen(kept), motion[kept]


def run_row(
    recording: Recording, motion: Floats, row: SlamRow, noise: str, seed: int
) -> dict[str, Any]:
    """Energies of a row over those of dead reckoning, how many loops there are and how many are
    right; None for what there is not. `ended`: why a SLAM gave up before the end, which it may.

    motion float64[n, 3]: the noisy odometry v (m/s), w (rad/s), dt (s).
    """
    try:
        return _run_row(recording, motion, row, noise, seed) | {"ended": ""}
    except PoseCellError as error:
        none = dict.fromkeys(("right", *RELATIONS))
        return {"row": row.name, "loops": 0, "ended": str(error), **none}


def _run_row(
    recording: Recording, motion: Floats, row: SlamRow, noise: str, seed: int
) -> dict[str, Any]:
    reckoned = dead_reckoning(motion)
    links = np.zeros((0, 2), dtype=np.int64)
    if row.kind == "sequence":
        poses, links = sequence_map(recording, motion, row, odometer(noise, seed), seed)
    elif row.kind == "ratslam":
        poses = _ratslam(recording, motion, row, seed)
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


def sequence_map(
    recording: Recording, motion: Floats, row: SlamRow, noise: OdometerNoise, seed: int
) -> tuple[Floats, NDArray[np.int64]]:
    """The whisks' poses float64[n, 3] in the final map, and its loops int64[m, 2]."""
    config = SequenceConfig(
        lag=row.lag,
        compass=row.compass,
        memory=row.memory,
        odometer=noise,
    )
    slam = SequenceSlam(config, head_shape())
    for image, (v, w, dt) in zip(_images(recording, row, seed), motion.tolist(), strict=True):
        slam.step(image, Odometry(v, w, dt))
    found = slam.map()
    return found.poses, found.links[len(recording) - 1 :].astype(np.int64)


def _ratslam(recording: Recording, motion: Floats, row: SlamRow, seed: int) -> Floats:
    case = MapCase(row.image, seed)
    config = replace(
        PRESETS["whisker"], vt_match_threshold=case.threshold, pc_vt_inject_energy=case.inject
    )
    slam = RatSlam(config)
    at = [
        slam.step(image, Odometry(v, w, dt)).experience
        for image, (v, w, dt) in zip(_images(recording, row, seed), motion.tolist(), strict=True)
    ]
    return slam.map().poses[at]


def _images(recording: Recording, row: SlamRow, seed: int) -> NDArray[np.uint8]:
    images = np.ascontiguousarray(recording.image(row.image))
    if row.control == "blind":
        return np.zeros_like(images)
    if row.control == "shuffled":
        draws = [philox_uniform(seed, SHUFFLE_STREAM, k) for k in range(len(images))]
        return images[np.argsort(np.array(draws), kind="stable")]
    return images
