"""Kinematics of the UR10 (CB3), and where it stands beside the maze.

Denavit-Hartenberg table as published by the manufacturer (a, d in m, alpha in rad), rows base to
wrist 3:  (0, .1273, pi/2) (-.612, 0, 0) (-.5723, 0, 0) (0, .163941, pi/2) (0, .1157, -pi/2)
(0, .0922, 0). Every real arm differs from it by up to millimetres: good for judging a pose, not for
measuring one. Poses of the controller are (x, y, z, rotation vector).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

Joints = tuple[float, float, float, float, float, float]
Matrix = tuple[tuple[float, float, float, float], ...]
"""Three rows of a rigid transformation, row-major."""
Pose = tuple[float, float, float, float]

JOINTS: Final = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")
A2, A3 = -0.612, -0.5723
D1, D4, D5, D6 = 0.1273, 0.163941, 0.1157, 0.0922
_ROWS: Final = (
    (0.0, D1, 0.0, 1.0),  # a, d, cos alpha, sin alpha
    (A2, 0.0, 1.0, 0.0),
    (A3, 0.0, 1.0, 0.0),
    (0.0, D4, 0.0, 1.0),
    (0.0, D5, 0.0, -1.0),
    (0.0, D6, 1.0, 0.0),
)
TOLERANCE: Final = 1e-6
"""m and rad by which a pose may be missed where the arm is stretched out or its wrist aligned."""
IDENTITY: Final[Matrix] = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


def multiply(p: Matrix, q: Matrix) -> Matrix:
    """p q of two rigid transformations, written out: each set-point takes many of them."""
    (pxx, pxy, pxz, px), (pyx, pyy, pyz, py), (pzx, pzy, pzz, pz) = p
    (qxx, qxy, qxz, qx), (qyx, qyy, qyz, qy), (qzx, qzy, qzz, qz) = q
    return (
        (
            pxx * qxx + pxy * qyx + pxz * qzx,
            pxx * qxy + pxy * qyy + pxz * qzy,
            pxx * qxz + pxy * qyz + pxz * qzz,
            pxx * qx + pxy * qy + pxz * qz + px,
        ),
        (
            pyx * qxx + pyy * qyx + pyz * qzx,
            pyx * qxy + pyy * qyy + pyz * qzy,
            pyx * qxz + pyy * qyz + pyz * qzz,
            pyx * qx + pyy * qy + pyz * qz + py,
        ),
        (
            pzx * qxx + pzy * qyx + pzz * qzx,
            pzx * qxy + pzy * qyy + pzz * qzy,
            pzx * qxz + pzy * qyz + pzz * qzz,
            pzx * qx + pzy * qy + pzz * qz + pz,
        ),
    )


def inverse(p: Matrix) -> Matrix:
    """The opposite of a rigid transformation."""
    (xx, xy, xz, x), (yx, yy, yz, y), (zx, zy, zz, z) = p
    return (
        (xx, yx, zx, -(xx * x + yx * y + zx * z)),
        (xy, yy, zy, -(xy * x + yy * y + zy * z)),
        (xz, yz, zz, -(xz * x + yz * y + zz * z)),
    )


def forward(q: Joints) -> Matrix:
    """The flange in the base frame for joint angles q, rad."""
    t = IDENTITY
    for angle, (a, d, ca, sa) in zip(q, _ROWS, strict=True):
        c, s = math.cos(angle), math.sin(angle)
        t = multiply(t, ((c, -s * ca, s * sa, a * c), (s, c * ca, -c * sa, a * s), (0, sa, ca, d)))
    return t


def solutions(flange: Matrix, wrist_3: float = 0.0) -> list[Joints]:
    """Every joint vector (up to 8, angles in +-pi) that brings the flange there; none out of reach.

    Closed form of the arm with three parallel axes (shoulder, elbow, wrist 1). Where wrist 3 is
    parallel to them too it may be chosen: `wrist_3`, rad.
    """
    return [q for branch in _branches(flange, wrist_3) for q in _plane(flange, *branch)]


def _branches(flange: Matrix, wrist_3: float) -> Iterator[tuple[float, float, float]]:
    """Base, wrist 2 and wrist 3 (rad) of the solutions, two of which share each."""
    (nx, ox, ax, px), (ny, oy, ay, py), _ = flange
    wx, wy = px - D6 * ax, py - D6 * ay
    radius = math.hypot(wx, wy)
    if radius < D4:
        return
    bearing, offset = math.atan2(wy, wx), math.acos(min(D4 / radius, 1.0))
    for q1 in (bearing + offset + math.pi / 2, bearing - offset + math.pi / 2):
        s1, c1 = math.sin(q1), math.cos(q1)
        cosine = (px * s1 - py * c1 - D4) / D6
        if abs(cosine) > 1.0 + TOLERANCE:
            continue
        bend = math.acos(max(-1.0, min(1.0, cosine)))
        for q5 in (bend, -bend):
            s5 = math.sin(q5)
            if abs(s5) < TOLERANCE:
                q6 = wrist_3
            else:
                q6 = math.atan2((-ox * s1 + oy * c1) / s5, (nx * s1 - ny * c1) / s5)
            yield q1, q5, q6


def _plane(flange: Matrix, q1: float, q5: float, q6: float) -> list[Joints]:
    """Shoulder, elbow and wrist 1 of a planar arm, given the other three."""
    t = multiply(inverse(_link(0, q1)), flange)
    t = multiply(t, inverse(multiply(_link(4, q5), _link(5, q6))))
    x, y = t[0][3], t[1][3]
    # t is the turn by q2 + q3 + q4 about the parallel axes; d4 lies along them.
    reach = math.hypot(x, y)
    cosine = (reach * reach - A2 * A2 - A3 * A3) / (2.0 * A2 * A3)
    if abs(cosine) > 1.0 + TOLERANCE:
        return []
    elbow = math.acos(max(-1.0, min(1.0, cosine)))
    total = math.atan2(t[1][0], t[0][0])
    found = []
    for q3 in (elbow, -elbow):
        q2 = math.atan2(y, x) - math.atan2(A3 * math.sin(q3), A2 + A3 * math.cos(q3))
        q4 = total - q2 - q3
        wrapped = [math.remainder(a, 2 * math.pi) for a in (q1, q2, q3, q4, q5, q6)]
        a, b, c, d, e, f = wrapped
        found.append((a, b, c, d, e, f))
    return found


def _link(row: int, angle: float) -> Matrix:
    a, d, ca, sa = _ROWS[row]
    c, s = math.cos(angle), math.sin(angle)
    return ((c, -s * ca, s * sa, a * c), (s, c * ca, -c * sa, a * s), (0.0, sa, ca, d))


def nearest(flange: Matrix, q: Joints) -> Joints | None:
    """The solution nearest to q, its angles continued from q; None out of reach."""
    best: Joints | None = None
    smallest = math.inf
    for q1, q5, q6 in _branches(flange, q[5]):
        known = (q1 - q[0], q5 - q[4], q6 - q[5])
        if max(abs(math.remainder(d, 2 * math.pi)) for d in known) > smallest:
            continue  # the other three joints can't make up for that
        for candidate in _plane(flange, q1, q5, q6):
            moved = [math.remainder(c - b, 2 * math.pi) for c, b in zip(candidate, q, strict=True)]
            largest = max(map(abs, moved))
            if largest < smallest:
                a, b, c, d, e, f = (x + m for x, m in zip(q, moved, strict=True))
                best, smallest = (a, b, c, d, e, f), largest
    return best


def from_vector(pose: tuple[float, ...]) -> Matrix:
    """The transformation of (x, y, z, rotation vector)."""
    x, y, z, rx, ry, rz = pose
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    if angle < 1e-12:
        return ((1.0, -rz, ry, x), (rz, 1.0, -rx, y), (-ry, rx, 1.0, z))
    ux, uy, uz = rx / angle, ry / angle, rz / angle
    c, s = math.cos(angle), math.sin(angle)
    v = 1.0 - c
    return (
        (c + ux * ux * v, ux * uy * v - uz * s, ux * uz * v + uy * s, x),
        (uy * ux * v + uz * s, c + uy * uy * v, uy * uz * v - ux * s, y),
        (uz * ux * v - uy * s, uz * uy * v + ux * s, c + uz * uz * v, z),
    )


def to_vector(t: Matrix) -> tuple[float, float, float, float, float, float]:
    """(x, y, z, rotation vector) of a transformation; the angle is at most pi.

    By way of the quaternion's largest part, which stays exact where the angle is near pi.
    """
    (a, b, c, x), (d, e, f, y), (g, h, i, z) = t
    squares = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    parts = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], d + b, c + g),
        (c - g, d + b, squares[2], h + f),
        (d - b, c + g, h + f, squares[3]),
    )
    w, u, v, n = parts[max(range(4), key=lambda k: squares[k])]
    if w < 0:
        w, u, v, n = -w, -u, -v, -n
    length = math.sqrt(u * u + v * v + n * n)
    if length < 1e-15:
        return x, y, z, 0.0, 0.0, 0.0
    share = 2.0 * math.atan2(length, w) / length
    return x, y, z, u * share, v * share, n * share


@dataclass(frozen=True)
class Mount:
    """Where the arm stands and how it holds the head.

    x, y, z, yaw  m and rad: its base in the maze frame. The default is the middle of the long
                  edge of the 1.35 x 1 m board, 0.2 m away from it, where the whole maze is in reach
    tool          m from the flange along its axis to the nose plane; the axis points down
    """

    x: float = 0.63
    y: float = -0.25
    z: float = 0.0
    yaw: float = 0.0
    tool: float = 0.21

    def base(self) -> Matrix:
        """The base in the maze frame."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return ((c, -s, 0.0, self.x), (s, c, 0.0, self.y), (0.0, 0.0, 1.0, self.z))

    def tcp(self, pose: Pose) -> tuple[float, float, float, float, float, float]:
        """The controller's pose of the nose, its tool axis down and its x forward."""
        return to_vector(multiply(inverse(self.base()), _upside_down(pose, 0.0)))

    def flange(self, pose: Pose) -> Matrix:
        """The flange in the base frame for a head pose."""
        return multiply(inverse(self.base()), _upside_down(pose, self.tool))

    def head(self, tcp: tuple[float, ...]) -> tuple[Pose, float]:
        """The head pose of a controller's pose, and how far (rad) its axis is off vertical."""
        t = multiply(self.base(), from_vector(tcp))
        tilt = math.acos(max(-1.0, min(1.0, -t[2][2])))
        return (t[0][3], t[1][3], t[2][3], math.atan2(t[1][0], t[0][0])), tilt


def _upside_down(pose: Pose, above: float) -> Matrix:
    x, y, z, yaw = pose
    c, s = math.cos(yaw), math.sin(yaw)
    return ((c, s, 0.0, x), (s, -c, 0.0, y), (0.0, 0.0, -1.0, z + above))
