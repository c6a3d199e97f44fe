"""What a whisker touches: geometry of box and shaft, and the beam's answer to it.

Contact happens in the whisking plane, the vertical plane through head axis and pivot, in
coordinates (u, z): u outward from the pivot, z up; phi is the straight shaft's angle from straight
down. Without friction a face or an edge pushes along its own normal. Where it stands oblique to the
whisking plane, the push turns the shaft in the plane of push and shaft, and the moment has a part
sideways: exactly so for the tip on a face, up to its second order for the shaft on an edge.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vibrissa.compilation import stay_apart
from vibrissa.numerics import atan2, compiled, cos, sin
from vibrissa.rig.beam import peg, tip
from vibrissa.rig.scene import X_MAX, X_MIN, Y_MAX, Y_MIN

NO_WALL = 9.0  # rad or m, beyond any
LEAST_ARM = 0.02  # of the length: a contact nearer than this counts as being there

FREE, ON_EDGE, ON_FACE, PAST = range(4)


@compiled
def slice_box(
    boxes: NDArray[np.float64], b: int, px: float, py: float, ux: float, uy: float
) -> tuple[float, float, bool, bool]:
    """Cut box b with the half plane from (px, py) along the unit vector (ux, uy).

    Returns near and far distance (m) of the cut, near > far where there is none, and for each
    whether it lies on a face that looks along x (else along y).
    """
    inverse = 1.0 / ux if abs(ux) > 1e-12 else 1e12
    one = (boxes[b, X_MIN] - px) * inverse
    two = (boxes[b, X_MAX] - px) * inverse
    x_near, x_far = min(one, two), max(one, two)
    inverse = 1.0 / uy if abs(uy) > 1e-12 else 1e12
    one = (boxes[b, Y_MIN] - py) * inverse
    two = (boxes[b, Y_MAX] - py) * inverse
    y_near, y_far = min(one, two), max(one, two)
    near, far = max(x_near, y_near), min(x_far, y_far)
    if far <= 0.0:
        return 1.0, -1.0, True, True
    return max(near, 0.0), far, x_near > y_near, x_far < y_far


@compiled
def wall_angles(chord: float, drop: float, near: float, far: float) -> tuple[float, float]:
    """Angles (inner, outer), rad, between which a wall section is in a straight whisker's way.

    chord: distance from base to tip, m; drop: height of the pivot above the wall's top, m; near,
    far: the section's extent in u, m. inner > outer: the whisker is too short to reach it.
    """
    if near * near + drop * drop >= chord * chord:
        return NO_WALL, -NO_WALL
    inner = -NO_WALL
    if near > 0.0:
        inner = atan2(near, math.sqrt(chord * chord - near * near))
    if far * far + drop * drop < chord * chord:
        return inner, atan2(far, drop)
    return inner, atan2(math.sqrt(chord * chord - drop * drop), drop)


@compiled
def wall_side(
    chord: float, drop: float, near: float, far: float, sin_psi: float, cos_psi: float
) -> int:
    """Where a straight whisker is seen from a wall section, by the angles of `wall_angles`.

    1 at or beyond the outer angle, -1 at or before the inner one, 0 between, 2 out of reach.
    """
    if near * near + drop * drop >= chord * chord:
        return 2
    out = far
    if far * far + drop * drop >= chord * chord:
        out = math.sqrt(chord * chord - drop * drop)
    if sin_psi * drop >= cos_psi * out:
        return 1
    if near > 0.0 and sin_psi * math.sqrt(chord * chord - near * near) <= cos_psi * near:
        return -1
    return 0


@compiled
def side_extent(
    boxes: NDArray[np.float64],
    b: int,
    px: float,
    py: float,
    ux: float,
    uy: float,
    start: float,
    stop: float,
) -> tuple[float, float, float, float]:
    """How far the shaft must lean to pass box b within start <= u <= stop on either side.

    Returns (left, u there, right, u there): the largest and smallest v / u of the box, v the offset
    towards (-uy, ux) and u in m; all zero where the box is beyond start and stop, or start >= stop.
    """
    stay_apart()
    left, left_u, right, right_u = -1e9, 0.0, 1e9, 0.0
    if start >= stop:
        return 0.0, 0.0, 0.0, 0.0
    for k in range(4):
        x0 = (boxes[b, X_MIN] if k in (0, 3) else boxes[b, X_MAX]) - px
        y0 = (boxes[b, Y_MIN] if k in (0, 1) else boxes[b, Y_MAX]) - py
        x1 = (boxes[b, X_MAX] if k in (0, 1) else boxes[b, X_MIN]) - px
        y1 = (boxes[b, Y_MAX] if k in (1, 2) else boxes[b, Y_MIN]) - py
        u0, v0 = x0 * ux + y0 * uy, y0 * ux - x0 * uy
        u1, v1 = x1 * ux + y1 * uy, y1 * ux - x1 * uy
        if u0 > u1:
            u0, v0, u1, v1 = u1, v1, u0, v0
        if u1 < start or u0 > stop:
            continue
        slope = (v1 - v0) / max(u1 - u0, 1e-12)
        if u0 < start:
            v0 += slope * (start - u0)
            u0 = start
        if u1 > stop:
            v1 += slope * (stop - u1)
            u1 = stop
        lean_0, lean_1 = v0 / max(u0, 1e-6), v1 / max(u1, 1e-6)
        if lean_0 > left:
            left, left_u = lean_0, u0
        if lean_1 > left:
            left, left_u = lean_1, u1
        if lean_0 < right:
            right, right_u = lean_0, u0
        if lean_1 < right:
            right, right_u = lean_1, u1
    if left < right:
        return 0.0, 0.0, 0.0, 0.0
    return left, left_u, right, right_u


@compiled
def clearance(
    boxes: NDArray[np.float64], b: int, px: float, py: float, ux: float, uy: float, length: float
) -> float:
    """A lower bound, m, of the distance seen from above between box b and a whisker's reach.

    The reach is the segment from (px, py) along the unit vector (ux, uy); the bound is the widest
    gap along x, y and across the segment, at most 0 if they overlap in all three.
    """
    qx, qy = px + length * ux, py + length * uy
    gap_x = max(boxes[b, X_MIN] - max(px, qx), min(px, qx) - boxes[b, X_MAX])
    gap_y = max(boxes[b, Y_MIN] - max(py, qy), min(py, qy) - boxes[b, Y_MAX])
    middle_x = 0.5 * (boxes[b, X_MIN] + boxes[b, X_MAX]) - px
    middle_y = 0.5 * (boxes[b, Y_MIN] + boxes[b, Y_MAX]) - py
    wide, deep = boxes[b, X_MAX] - boxes[b, X_MIN], boxes[b, Y_MAX] - boxes[b, Y_MIN]
    gap = abs(middle_y * ux - middle_x * uy) - 0.5 * (wide * abs(uy) + deep * abs(ux))
    widest: float = max(gap_x, gap_y, gap)
    return widest


@compiled
def oblique(along_x: bool, ux: float, uy: float) -> tuple[float, float]:
    """Cosine and sine of the angle between a face's outward normal and the whisking plane.

    along_x: whether the normal looks along x (else y); the sine is > 0 where the normal points to
    the left of the plane, seen from above.
    """
    if along_x:
        return abs(ux), -uy * math.copysign(1.0, ux)
    return abs(uy), ux * math.copysign(1.0, uy)


@compiled
def across_edge(
    distance: float, drop: float, sin_phi: float, cos_phi: float, slope: float
) -> tuple[float, float, float]:
    """A straight edge as a peg: (its distance from the pivot, tan(gamma / 2), foreshortening w).

    The edge is level, ``distance`` m from the pivot along its horizontal normal and ``drop`` below;
    slope: cosine of the angle between that normal and the whisking plane. Without friction it bends
    the shaft in the plane of the shaft and of the normal of both; the peg is where the edge pierces
    that plane, gamma > 0 for an edge outside. Across the edge the shaft looks w times as long.
    """
    x, z = sin_phi * slope, cos_phi
    square = max(x * x + z * z, 1e-18)
    w = math.sqrt(square)
    along, off = distance * x + drop * z, (distance * z - drop * x) * w
    hypotenuse = math.sqrt(along * along + off * off)
    return hypotenuse / square, off / max(hypotenuse + along, 1e-18), w


@compiled
def depths(
    chord: float,
    drop: float,
    near: float,
    far: float,
    near_x: bool,
    far_x: bool,
    ux: float,
    uy: float,
    sin_psi: float,
    cos_psi: float,
) -> tuple[float, float]:
    """How deep a straight whisker is in a wall, m: (from above, from inside), by the ways it came.

    From above: to the far upper edge, or to the top where that edge is out of reach; from inside:
    of the tip to the near face. Measured across edge or face, wherever the whisking plane cuts it.
    """
    inside = NO_WALL
    if near > 0.0:  # else the pivot is over the wall
        slope, _ = oblique(near_x, ux, uy)
        inside = (chord * sin_psi - near) * slope
    if far * far + drop * drop >= chord * chord:
        return chord * cos_psi - drop, inside
    slope, _ = oblique(far_x, ux, uy)
    x = sin_psi * slope
    w = max(math.sqrt(x * x + cos_psi * cos_psi), 1e-9)
    return slope * (far * cos_psi - drop * sin_psi) / w, inside


@compiled
def from_above(
    form: int,
    tables: NDArray[np.float64],
    table: int,
    taper: float,
    length: float,
    phi: float,
    sin_phi: float,
    cos_phi: float,
    drop: float,
    near: float,
    far: float,
    far_x: bool,
    ux: float,
    uy: float,
    on_face: bool,
) -> tuple[int, float, float, float]:
    """A whisker that comes down on a wall: (what, angle of the contact, moment y, moment x).

    drop: of the pivot above the top, near, far: extent of the wall in u, m; far_x: whether the far
    face looks along x; on_face: whether the tip was on the top before. The shaft rests on the far
    edge until its tip slips over it or nothing holds it there; then the tip rests on the top, until
    it is pulled back over the far edge or pushed on over the near one (PAST). Where edge and face
    could both hold it, it stays where it was. Moments in E I0 / m.
    """
    stay_apart()
    edge_angle, held, rests, edge = NO_WALL, False, False, False
    edge_y = edge_x = 0.0
    if far * far + drop * drop < length * length:
        if sin_phi * drop >= cos_phi * far:
            return FREE, phi, 0.0, 0.0
        edge = True
        slope, left = oblique(far_x, ux, uy)
        reach, half, w = across_edge(far * slope, drop, sin_phi, cos_phi, slope)
        arm = min(max(reach, LEAST_ARM * length), length)
        moment, arc, angle, rests = peg(form, tables, 1.0 - taper * arm, max(half, 0.0))
        edge_angle = atan2(far, drop)
        push = moment / (arm * w)
        edge_y, edge_x = push * slope, push * left * cos_phi
        held = rests and arc * arm <= length
        if held and not on_face and phi + angle < 0.5 * math.pi:
            return ON_EDGE, edge_angle, edge_y, edge_x
    height = drop / length
    moment, offset, arc = tip(form, tables, table, 1.0 - taper * length, height, phi)
    if offset * length >= far:
        if held:
            return ON_EDGE, edge_angle, edge_y, edge_x
        if edge and not rests:
            return PAST, phi, 0.0, 0.0
        offset = far / length
    elif (offset + 1.0 - arc) * length < near:
        return PAST, phi, 0.0, 0.0
    if moment <= 0.0:
        return FREE, phi, 0.0, 0.0
    return ON_FACE, max(atan2(offset, height), phi), moment / length, 0.0


@compiled
def from_inside(
    form: int,
    tables: NDArray[np.float64],
    table: int,
    taper: float,
    length: float,
    phi: float,
    sin_phi: float,
    cos_phi: float,
    drop: float,
    near: float,
    near_x: bool,
    ux: float,
    uy: float,
) -> tuple[int, float, float, float]:
    """A whisker that comes up behind a wall: (what, angle of the contact, moment y, moment x).

    Arguments as for `from_above`; near_x: whether the near face looks along x. The tip presses
    against the near face, or the shaft against the upper edge, or both: between, where either alone
    would let the other pass through the wall, they share in proportion to how far it would. It is
    free again (PAST) where neither holds it. Moments in E I0 / m.
    """
    stay_apart()
    if sin_phi * length <= near:
        return FREE, phi, 0.0, 0.0
    slope, left = oblique(near_x, ux, uy)
    distance = near * slope
    toward = sin_phi * slope
    side = math.sqrt(max(1.0 - toward * toward, 0.0))
    tip_angle, tip_y, tip_x, tip_holds, through_edge = phi, 0.0, 0.0, False, 0.0
    hangs = False  # the shaft lies along the face and on the edge, its tip behind the wall
    if side > 1e-9 and cos_phi > 0.0:
        turn = atan2(side, toward)
        moment, offset, arc = tip(
            form, tables, table, 1.0 - taper * length, distance / length, turn
        )
        depth = offset * length * cos_phi / side
        hangs = depth + (1.0 - arc) * length * cos_phi / side >= drop > depth
        if depth >= drop and offset > 0.0:
            tip_holds, tip_angle = True, min(atan2(near, depth), phi)
            tip_y = -moment / length * cos_phi * slope / side
            tip_x = -moment / length * left / side
            # Where the shaft crosses the edge's height, bent like a cylinder under a tip force.
            bent_x, bent_z = distance - length * toward, length * cos_phi - depth
            s = drop / cos_phi
            bow = 0.0
            for _ in range(3):
                share = min(s / length, 1.0)
                bow = 0.5 * share * share * (3.0 - share)
                s = (drop + bent_z * bow) / cos_phi
            through_edge = max(s * toward + bent_x * bow - distance, 0.0)
    edge_holds, edge_y, edge_x, edge_angle, through_face = False, 0.0, 0.0, phi, 0.0
    if (through_edge > 0.0 or not tip_holds) and near * near + drop * drop < length * length:
        reach, half, w = across_edge(distance, drop, sin_phi, cos_phi, slope)
        if half < 0.0 and reach < length:
            arm = max(reach, LEAST_ARM * length)
            moment, arc, angle, rests = peg(form, tables, 1.0 - taper * arm, -half)
            if rests and arc * arm <= length:
                edge_holds, edge_angle = True, atan2(near, drop)
                push = moment / (arm * w)
                edge_y, edge_x = -push * slope, -push * left * cos_phi
                dip = toward * cos(angle) - cos_phi / w * sin(angle)
                through_face = (length - arc * arm) * max(dip, 0.0)
    if tip_holds and not (edge_holds and through_edge > 0.0):
        return ON_FACE, tip_angle, tip_y, tip_x
    if not edge_holds or (through_face > 0.0 and not (tip_holds or hangs)):
        return PAST, phi, 0.0, 0.0
    if through_face == 0.0 or hangs:
        return ON_EDGE, edge_angle, edge_y, edge_x
    share = through_edge / (through_edge + through_face)
    return (
        ON_FACE,
        tip_angle + share * (edge_angle - tip_angle),
        tip_y + share * (edge_y - tip_y),
        tip_x + share * (edge_x - tip_x),
    )
