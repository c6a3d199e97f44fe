"""What any SLAM makes of a run: views, poses, maps and scores, one step per whisk cycle.

The front end (`processes.slam`) and SLAMs in shadow (`processes.slam_shadow`) share it, so that
every SLAM behind the interface is told and judged in the same way.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.kinematics import PER_RING, RINGS
from vibrissa.messages.types import Metrics, SlamMap, SlamPose, SlamView
from vibrissa.numerics import cos, sin
from vibrissa.processes.node import Output
from vibrissa.slam.angles import wrap_pi
from vibrissa.slam.interface import Odometry, Slam, SlamStep
from vibrissa.slam.metrics import energy_metric, experience_metric, first_circuit, fixed_interval

Image = NDArray[np.uint8]
Truth = NDArray[np.float64]

IMAGES: Final = ("max_angle_gated", "max_angle_ungated", "contact_angle")
SHAPE: Final = (len(RINGS), PER_RING)
REPORT_CYCLES = 10


class Sight(NamedTuple):
    """What a SLAM is given for a whisk cycle.

    images: kind -> uint8[18]; odometry: v m/s, w rad/s, dt s; truth float64[4]: x, y, z m, yaw rad.
    """

    cycle: int
    images: dict[str, Image]
    odometry: Odometry
    truth: Truth


class Mapping:
    """A SLAM at work on the images of one kind."""

    def __init__(self, slam: Slam, kind: str) -> None:
        self._slam = slam
        self._kind = kind
        self._cycle = 0
        self._reported = 0
        self._log = TrajectoryLog()

    @property
    def views(self) -> int:
        """Cycles seen."""
        return len(self._log.experiences)

    def learn(self, cycle: int, image: Image, odometry: Odometry, truth: Truth) -> SlamStep:
        """Step the SLAM with an image uint8[18]; see `Sight`."""
        result = self._slam.step(image.reshape(SHAPE), odometry)
        self._cycle = cycle
        x, y, _, yaw = truth.tolist()
        self._log.add(result, odometry, (x, y, yaw))
        return result

    def see(self, sight: Sight) -> list[Output]:
        """Step the SLAM; its view and pose, and now and then its map and metrics."""
        cycle, images, odometry, truth = sight
        result = self.learn(cycle, images[self._kind], odometry, truth)
        error = result.match_error if math.isfinite(result.match_error) else -1.0
        view = SlamView(
            cycle=cycle,
            **images,
            template=result.template,
            new=int(result.new_template),
            error=error,
        )
        pose = SlamPose(
            cycle=cycle,
            experience=result.experience,
            action=result.action,
            estimate=np.array([result.x, result.y, result.heading]),
            odometry=np.array([odometry.v, odometry.w, odometry.dt]),
            truth=truth.copy(),
        )
        outputs: list[Output] = [("slam.view", view), ("slam.pose", pose)]
        if self.views - self._reported >= max(REPORT_CYCLES, self.views // 10):
            outputs += self.report()
        return outputs

    def report(self) -> list[Output]:
        """Map and metrics: at ever longer intervals, so that their cost stays in proportion."""
        if self._reported == self.views:
            return []
        self._reported = self.views
        found = self._slam.map()
        return [
            ("slam.map", SlamMap(self._cycle, found.poses, found.links.astype(np.int32))),
            ("eval.metrics", self._log.metrics(self._cycle)),
        ]


class TrajectoryLog:
    """True, estimated and dead-reckoned trajectories, one pose per cycle, and their metrics."""

    def __init__(self) -> None:
        self.experiences: list[int] = []
        self.templates = 0
        self._known = 0
        self._truth: list[tuple[float, float, float]] = []
        self._estimate: list[tuple[float, float, float]] = []
        self._reckoned: list[tuple[float, float, float]] = []

    def add(self, result: SlamStep, odometry: Odometry, truth: tuple[float, float, float]) -> None:
        x, y, heading = self._reckoned[-1] if self._reckoned else (0.0, 0.0, 0.0)
        heading = wrap_pi(heading + odometry.w * odometry.dt)
        distance = odometry.v * odometry.dt
        self._reckoned.append((x + distance * cos(heading), y + distance * sin(heading), heading))
        self._estimate.append((result.x, result.y, result.heading))
        self._truth.append(truth)
        self.experiences.append(result.experience)
        self.templates = result.templates
        self._known = result.experiences

    def metrics(self, cycle: int) -> Metrics:
        """Scores so far, over consecutive relations, beside those of the raw odometry."""
        base = first_circuit(self._truth)
        score = experience_metric(self.experiences, self._truth, base)
        pairs = fixed_interval(len(self._truth))
        estimated = reckoned = None
        if len(pairs):
            estimated = energy_metric(self._estimate, self._truth, pairs)
            reckoned = energy_metric(self._reckoned, self._truth, pairs)
        return Metrics(
            cycle=cycle,
            arr=-1.0 if score.arr is None else score.arr,
            arcr=-1.0 if score.arcr is None else score.arcr,
            em_translation=estimated.translation if estimated else -1.0,
            em_rotation=estimated.rotation if estimated else -1.0,
            odometry_translation=reckoned.translation if reckoned else -1.0,
            odometry_rotation=reckoned.rotation if reckoned else -1.0,
            experiences=self._known,
            templates=self.templates,
        )
