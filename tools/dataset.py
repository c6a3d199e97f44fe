"""From a log to arrays: what SLAM saw, what it was told it moved, where it really was.

Works on logs of live, simulated and re-run experiments alike, one row per whisk cycle that became
a view.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.messages.codec import decode
from vibrissa.messages.types import SlamMap
from vibrissa.processes.config import Experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.rebuild import experiment_of, open_log

IMAGES: Final = ("max_angle_gated", "max_angle_ungated", "contact_angle")
SHAPE: Final = (3, 6)
"""Rings and whiskers per ring."""

Floats = NDArray[np.float64]


class DatasetError(ValueError):
    """A log that holds no views, or no ground truth to judge them by."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """One row per whisk cycle.

    cycles int64[n]; times float64[n], s; images by kind (IMAGES) uint8[n, 3, 6]; odometry
    float64[n, 3], v (m/s), w (rad/s), dt (s); truth float64[n, 3] and estimate float64[n, 3],
    x, y (m), heading (rad), in the maze's and in the map's frame; experience, action int64[n] and
    template int64[n] as SLAM decided; map: the last one in the log, None when there is none.
    """

    experiment: Experiment
    cycles: NDArray[np.int64]
    times: Floats
    images: dict[str, NDArray[np.uint8]]
    odometry: Floats
    truth: Floats
    estimate: Floats
    experience: NDArray[np.int64]
    action: NDArray[np.int64]
    template: NDArray[np.int64]
    map: SlamMap | None

    def __len__(self) -> int:
        return len(self.cycles)


def load(log: Path) -> Dataset:
    """Read a log; a cut-off one up to where it ends.

    Raises UnusableLogError for what is no log, DatasetError for one without views or truth.
    """
    reader = open_log(log, allow_cut=True)
    views: dict[int, Any] = {}
    poses: dict[int, tuple[float, Any]] = {}
    last_map: SlamMap | None = None
    for record in reader.records(lambda damage: None):
        if record.source != "slam":
            continue
        message = decode(frame_of(record))
        match message.topic:
            case "slam.view":
                views[message.body.cycle] = message.body
            case "slam.pose":
                poses[message.body.cycle] = (message.t * 1e-9, message.body)
            case "slam.map":
                last_map = message.body
    if not views:
        raise DatasetError(f"{log}: expected slam.view messages, found none: nothing was seen")
    if not poses:
        raise DatasetError(f"{log}: expected slam.pose messages, found none: no ground truth")
    cycles = sorted(views.keys() & poses.keys())
    if not cycles:
        raise DatasetError(f"{log}: no whisk cycle has both a slam.view and a slam.pose")
    bodies = [poses[cycle][1] for cycle in cycles]
    return Dataset(
        experiment=experiment_of(reader),
        cycles=np.array(cycles, dtype=np.int64),
        times=np.array([poses[cycle][0] for cycle in cycles]),
        images={
            kind: np.array([getattr(views[c], kind) for c in cycles]).reshape(-1, *SHAPE)
            for kind in IMAGES
        },
        odometry=np.array([body.odometry for body in bodies]),
        truth=np.array([body.truth[[0, 1, 3]] for body in bodies]),
        estimate=np.array([body.estimate for body in bodies]),
        experience=np.array([body.experience for body in bodies], dtype=np.int64),
        action=np.array([body.action for body in bodies], dtype=np.int64),
        template=np.array([views[c].template for c in cycles], dtype=np.int64),
        map=last_map,
    )
