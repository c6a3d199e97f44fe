"""A log of a mapping run that needs no plant: laps of a ring of places, both ways round.

The odometry turns a tenth too little, so that only touch can tell that a lap is complete.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from vibrissa.messages.codec import CODECS
from vibrissa.messages.types import SlamMap, SlamPose, SlamView
from vibrissa.processes import provenance
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.framelog import FrameLog
from vibrissa.processes.slams import make_slam_config
from vibrissa.slam.interface import Odometry
from vibrissa.slam.ratslam import RatSlam

PLACES = 40
RADIUS = 0.5
SENSES = (1, 1, -1)


def ring_poses() -> np.ndarray:
    """float64[n, 3]: laps of a circle; the agent turns round between laps of different sense."""
    poses = []
    angle = 0.0
    for sense in SENSES:
        for _ in range(PLACES):
            poses.append((RADIUS * math.cos(angle), RADIUS * math.sin(angle), angle + sense * 1.57))
            angle += sense * 2.0 * math.pi / PLACES
    return np.array(poses)


def write_log(path: Path, experiment: Experiment | None = None, *, views: bool = True) -> Path:
    """Drive the experiment's RatSLAM along the ring and log what a slam process would say."""
    experiment = experiment or load_experiment(duration=len(SENSES) * PLACES)
    slam = RatSlam(make_slam_config(experiment))
    rng = np.random.default_rng(5)
    felt = rng.integers(0, 256, (2, PLACES, 3, 6)).astype(np.uint8)
    truth = ring_poses()
    meta = provenance.metadata(experiment.model_dump_json(), "simulate")
    log = FrameLog(path, f"simulate-{meta['config_hash'][:16]}", meta)
    seq = {"slam.view": 0, "slam.pose": 0, "slam.map": 0}

    def say(topic: str, cycle: int, body: object) -> None:
        log.write(CODECS[topic].encode("slam", 0, seq[topic], cycle * 10**9, body))
        seq[topic] += 1

    for cycle in range(1, len(truth)):
        (x0, y0, th0), (x1, y1, th1) = truth[cycle - 1], truth[cycle]
        turned = math.remainder(th1 - th0, 2.0 * math.pi) * (0.9 + 0.02 * rng.normal())
        odometry = Odometry(math.hypot(x1 - x0, y1 - y0), turned, 1.0)
        place = round(math.atan2(y1, x1) / (2.0 * math.pi) * PLACES) % PLACES
        sense = SENSES[cycle // PLACES]
        image = felt[0 if sense > 0 else 1, place]
        step = slam.step(image, odometry)
        error = step.match_error if math.isfinite(step.match_error) else -1.0
        new = int(step.new_template)
        pixels = image.reshape(-1)
        if views:
            say(
                "slam.view",
                cycle,
                SlamView(cycle, pixels, pixels, 255 - pixels, step.template, new, error),
            )
        say(
            "slam.pose",
            cycle,
            SlamPose(
                cycle,
                step.experience,
                step.action,
                np.array([step.x, step.y, step.heading]),
                np.array([odometry.v, odometry.w, odometry.dt]),
                np.array([x1, y1, 0.077, math.remainder(th1, 2.0 * math.pi)]),
            ),
        )
    found = slam.map()
    say("slam.map", len(truth) - 1, SlamMap(len(truth) - 1, found.poses, found.links))
    log.close("completed")
    return path
