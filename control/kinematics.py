"""Forward kinematics of the whisker head: where the tip of a straight whisker is.

Whisker `i = ring * 6 + k`: ring 0 front, 1 mid, 2 rear; `k` counts counterclockwise seen from
above. A whisker swings in the vertical plane through the head axis and its pivot. `phi` is its
angle from straight down, positive outward; protraction moves the tip inward and down:
`phi = phi_start - theta`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import atan2, compiled, cos, sin

WHISKERS = 18
RINGS = ("front", "mid", "rear")
PER_RING = 6
NOSE_HEIGHT = 0.077  # m, working height of the nose plane above the maze floor

Float64s = NDArray[np.float64]
Float32s = NDArray[np.float32]


class GeometryError(ValueError):
    """A head geometry that no head can have."""


def ring_of(whisker: int) -> int:
    """Ring (0 front, 1 mid, 2 rear) of a whisker index 0..17."""
    return whisker // PER_RING


def whisker_name(whisker: int) -> str:
    """How messages call a whisker, e.g. `whisker 7 (mid ring)`."""
    return f"whisker {whisker} ({RINGS[ring_of(whisker)]} ring)"


def per_whisker(values: ArrayLike, name: str, error: type[ValueError] = ValueError) -> Float64s:
    """A read-only float64[18] copy of `values`, all finite; a scalar counts for every whisker.

    Raises `error` when the shape is neither () nor (18,) or a value is not finite.
    """
    array = np.array(values, dtype=np.float64)
    if array.ndim == 0:
        array = np.full(WHISKERS, array, dtype=np.float64)
    if array.shape != (WHISKERS,):
        raise error(f"{name}: expected {WHISKERS} values, found shape {array.shape}")
    for i in range(WHISKERS):
        if not math.isfinite(array[i]):
            raise error(f"{name}: {whisker_name(i)} is {array[i]}, expected a finite number")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class HeadGeometry:
    """Eighteen whiskers on a head; every field is a read-only float64[18].

    length        m, straight length of the whisker
    pivot_radius  m, distance of the pivot from the head axis
    pivot_height  m, height of the pivot above the nose plane
    azimuth       rad, direction of the whisker from the head's forward direction, counterclockwise
    phi_start     rad, angle from straight down at theta = 0, in (0, pi/2]
    swing         rad, full protraction travel; theta lies in [0, swing], and swing <= phi_start

    Raises GeometryError.
    """

    length: Float64s
    pivot_radius: Float64s
    pivot_height: Float64s
    azimuth: Float64s
    phi_start: Float64s
    swing: Float64s

    def __post_init__(self) -> None:
        for field in fields(self):
            values = per_whisker(getattr(self, field.name), field.name, GeometryError)
            object.__setattr__(self, field.name, values)
        for i in range(WHISKERS):
            for name in ("length", "swing"):
                value = getattr(self, name)[i]
                if value <= 0.0:
                    raise GeometryError(f"{name}: {whisker_name(i)} is {value}, expected > 0")
            for name in ("pivot_radius", "pivot_height"):
                value = getattr(self, name)[i]
                if value < 0.0:
                    raise GeometryError(f"{name}: {whisker_name(i)} is {value}, expected >= 0")
            phi, swing = self.phi_start[i], self.swing[i]
            if not 0.0 < phi <= math.pi / 2:
                raise GeometryError(f"phi_start: {whisker_name(i)} is {phi}, expected in (0, pi/2]")
            if swing > phi:
                raise GeometryError(
                    f"swing: {whisker_name(i)} is {swing}, more than its phi_start {phi}"
                )


def paper_head() -> HeadGeometry:
    """The head of Salman and Pearson: three rings of six whiskers, 50, 110 and 160 mm long.

    Pivots lie on disks of radius 20, 40, 60 mm, 10, 30, 50 mm behind the nose plane (the Shrewbot
    column). With the nose plane 77 mm above the floor the whiskers start with their tips 55 mm
    high, 5 mm above the walls, and protract until the tips are 6 mm high; the front ring, too short
    for that, protracts until it points straight down.
    """
    ring = np.arange(WHISKERS) // PER_RING
    length = np.array([0.050, 0.110, 0.160])
    pivot_height = np.array([0.010, 0.030, 0.050])
    pivot = NOSE_HEIGHT + pivot_height
    phi_start = [_arccos((pivot[r] - 0.055) / length[r]) for r in range(3)]
    phi_full = [0.0] + [_arccos((pivot[r] - 0.006) / length[r]) for r in (1, 2)]
    swing = np.array(phi_start) - np.array(phi_full)
    return HeadGeometry(
        length=length[ring],
        pivot_radius=np.array([0.020, 0.040, 0.060])[ring],
        pivot_height=pivot_height[ring],
        azimuth=np.array([math.radians(30 + 60 * (i % PER_RING)) for i in range(WHISKERS)]),
        phi_start=np.array(phi_start)[ring],
        swing=swing[ring],
    )


def _arccos(x: float) -> float:
    return atan2(math.sqrt(1.0 - x * x), x)


@compiled
def tip_height_kernel(length: float, pivot_z: float, phi: float) -> float:
    """Height of a straight whisker's tip, m: pivot_z - length cos(phi)."""
    return pivot_z - length * cos(phi)


@compiled
def _tip_heights(
    length: Float64s,
    pivot_height: Float64s,
    phi_start: Float64s,
    theta: Float64s,
    nose_height: float,
    out: Float64s,
) -> None:
    for i in range(out.shape[0]):
        pivot_z = nose_height + pivot_height[i]
        out[i] = tip_height_kernel(length[i], pivot_z, phi_start[i] - theta[i])


@compiled
def _tip_positions(
    length: Float64s,
    pivot_radius: Float64s,
    pivot_height: Float64s,
    azimuth: Float64s,
    phi_start: Float64s,
    theta: Float64s,
    x: float,
    y: float,
    z: float,
    yaw: float,
    out: Float64s,
) -> None:
    for i in range(out.shape[0]):
        phi = phi_start[i] - theta[i]
        reach = pivot_radius[i] + length[i] * sin(phi)
        bearing = yaw + azimuth[i]
        out[i, 0] = x + reach * cos(bearing)
        out[i, 1] = y + reach * sin(bearing)
        out[i, 2] = tip_height_kernel(length[i], z + pivot_height[i], phi)


def tip_height(geometry: HeadGeometry, theta: ArrayLike, nose_height: float) -> Float64s:
    """Height of every tip above the floor, float64[18], m, of straight whiskers.

    theta: rad, [18] (or one number for all); nose_height: m, nose plane above the floor.
    """
    out = np.empty(WHISKERS, dtype=np.float64)
    angles = per_whisker(theta, "theta")
    g = geometry
    _tip_heights(g.length, g.pivot_height, g.phi_start, angles, float(nose_height), out)
    return out


def tip_position(
    geometry: HeadGeometry, pose: tuple[float, float, float, float], theta: ArrayLike
) -> Float64s:
    """Position of every tip in the world frame, float64[18, 3], m, of straight whiskers.

    pose: (x, y, z, yaw), z the height of the nose plane, yaw counterclockwise from +x to the head's
    forward direction; theta: rad, [18] (or one number for all).
    """
    out = np.empty((WHISKERS, 3), dtype=np.float64)
    angles = per_whisker(theta, "theta")
    x, y, z, yaw = (float(value) for value in pose)
    g = geometry
    _tip_positions(
        g.length, g.pivot_radius, g.pivot_height, g.azimuth, g.phi_start, angles, x, y, z, yaw, out
    )
    return out
