"""Odometry of the arm: average velocities between successive true poses, and noise on them.

The paper samples the arm's pose once a second and hands RatSLAM the average translational and
rotational velocity of each interval, with an error of N(0, 8.2) in mm and N(0, 0.103) in rad per
interval. Whether 8.2 and 0.103 are standard deviations or variances it does not say; both
readings are here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from vibrissa.numerics import cos, sin
from vibrissa.slam.angles import turn
from vibrissa.slam.interface import Odometry, SlamInputError

Pose = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """Gaussian error of one odometry step.

    `distance` (m) and `angle` (rad): standard deviations of the independent errors added to the
    step's displacement and turn. `timing`: standard deviation of a relative error of the interval,
    which scales displacement and turn together.
    """

    distance: float = 0.0
    angle: float = 0.0
    timing: float = 0.0

    def apply(self, odometry: Odometry, normals: tuple[float, float]) -> Odometry:
        """The noisy step; `normals` are two independent standard normal numbers."""
        along, around = normals
        scale = 1.0 + self.timing * along
        return Odometry(
            odometry.v * scale + self.distance * along / odometry.dt,
            odometry.w * scale + self.angle * around / odometry.dt,
            odometry.dt,
        )


NOISE_MODELS: Final[dict[str, OdometryNoise]] = {
    "none": OdometryNoise(),
    "paper-std": OdometryNoise(distance=8.2e-3, angle=0.103),
    "paper-variance": OdometryNoise(distance=math.sqrt(8.2) * 1e-3, angle=math.sqrt(0.103)),
    "jit": OdometryNoise(timing=0.2),
    "third": OdometryNoise(distance=2.7e-3, angle=0.034),
    "full": OdometryNoise(distance=8.2e-3, angle=0.103),
}
"""Noise per 1 s step by name; `full` is `paper-std` under the name that goes with `third`."""


def odometry_between(start: Pose, end: Pose, dt: float) -> Odometry:
    """Average velocities from one pose (x m, y m, yaw rad) to the next, dt seconds later.

    The speed is the straight distance over dt, negative when the displacement points against the
    mean heading of the interval, so that driving backwards is reverse and not a turn.
    Raises SlamInputError for a dt that is not positive and for poses that are not finite.
    """
    (x0, y0, yaw0), (x1, y1, yaw1) = start, end
    if not dt > 0.0:
        raise SlamInputError(f"odometry dt: expected a positive time in s, found {dt}")
    for name, pose in (("start", start), ("end", end)):
        if not all(math.isfinite(p) for p in pose):
            raise SlamInputError(f"odometry {name} pose: expected finite numbers, found {pose}")
    dx, dy = x1 - x0, y1 - y0
    turned = turn(yaw0, yaw1)
    heading = yaw0 + 0.5 * turned
    distance = math.sqrt(dx * dx + dy * dy)
    forward = dx * cos(heading) + dy * sin(heading)
    return Odometry((distance if forward >= 0.0 else -distance) / dt, turned / dt, dt)
