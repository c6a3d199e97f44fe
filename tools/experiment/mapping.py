"""One SLAM run over a recorded data set, under a named odometry noise, perhaps with a control.

Controls: `blind` (all images zero) and `shuffled` (every image at another whisk of the data set).
Odometry noise is indexed by the number of the whisk cycle, from a stream of the data set's seed, so
runs over other images, and over parts of the data set, meet the same noise.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import philox_normal, philox_uniform
from vibrissa.processes.slam import NOISE_STREAM
from vibrissa.slam.config import PRESETS
from vibrissa.slam.interface import Odometry
from vibrissa.slam.odometry import NOISE_MODELS
from vibrissa.slam.ratslam import RatSlam
from vibrissa.tools.experiment.recording import Recording
from vibrissa.tools.experiment.scores import Trace, dead_reckoning

SHUFFLE_STREAM: Final = 3000

Control = Literal["none", "blind", "shuffled"]


@dataclass(frozen=True)
class MapCase:
    """Everything a SLAM run depends on besides its recording.

    image: one of IMAGES; noise: a name of NOISE_MODELS; threshold, inject: vt_match_threshold and
    pc_vt_inject_energy over the preset `whisker`. circuits: how many of the data set's, 0 for all;
    skips: (circuit, distance m from its start, length m) of stretches that are cut out, as if the
    agent had been carried over them; the cut does not enter the odometry.
    """

    image: str
    seed: int
    noise: str = "jit"
    control: Control = "none"
    threshold: float = 0.002
    inject: float = 0.02
    circuits: int = 0
    skips: tuple[tuple[int, float, float], ...] = ()

    def key(self) -> dict[str, Any]:
        """The case as plain values."""
        return asdict(self)


def run_map(recording: Recording, case: MapCase) -> Trace:
    """RatSLAM over the recording, whisk by whisk."""
    if case.circuits:
        recording = recording.chosen(recording.circuit < case.circuits)
    images = _images(recording, case)
    motion = noisy(recording, case.noise, case.seed)
    if case.skips:
        kept = kept_whisks(recording, case.skips)
        recording, images, motion = recording.chosen(kept), images[kept], motion[kept]
    config = replace(
        PRESETS["whisker"], vt_match_threshold=case.threshold, pc_vt_inject_energy=case.inject
    )
    slam = RatSlam(config)
    experience = np.empty(len(recording), dtype=np.int64)
    templates = 0
    for k, (v, w, dt) in enumerate(motion.tolist()):
        step = slam.step(images[k], Odometry(v, w, dt))
        experience[k] = step.experience
        templates = step.templates
    return Trace(
        experience=experience,
        reckoned=dead_reckoning(motion),
        truth=recording.truth,
        circuit=recording.circuit,
        map_poses=slam.map().poses,
        templates=templates,
    )


def noisy(recording: Recording, noise: str, seed: int) -> NDArray[np.float64]:
    """The odometry v, w, dt of every whisk with the noise of that name, float64[n, 3]."""
    model = NOISE_MODELS[noise]
    motion = recording.motion.copy()
    for k, cycle in enumerate(recording.cycle.tolist()):
        normals = (
            philox_normal(seed, NOISE_STREAM, 2 * cycle),
            philox_normal(seed, NOISE_STREAM, 2 * cycle + 1),
        )
        changed = model.apply(Odometry(*recording.motion[k].tolist()), normals)
        motion[k] = changed.v, changed.w, changed.dt
    return motion


def _images(recording: Recording, case: MapCase) -> NDArray[np.uint8]:
    images = recording.image(case.image)
    if case.control == "blind":
        return np.zeros_like(images)
    if case.control == "shuffled":
        n = len(images)
        draws = [philox_uniform(case.seed, SHUFFLE_STREAM, k) for k in range(n)]
        return images[np.argsort(np.array(draws), kind="stable")]
    return images


def kept_whisks(
    recording: Recording, skips: tuple[tuple[int, float, float], ...]
) -> NDArray[np.bool_]:
    """The whisks that are left when every skip is cut out."""
    distance = recording.motion[:, 0] * recording.motion[:, 2]
    kept = np.ones(len(recording), dtype=np.bool_)
    for circuit, start, length in skips:
        rows = recording.circuit == circuit
        gone = np.cumsum(np.where(rows, distance, 0.0))
        kept &= ~(rows & (gone >= start) & (gone < start + length))
    return kept
