"""The contact of one whisker with everything around it, a tick at a time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vibrissa.compilation import inlined
from vibrissa.numerics import atan2, compiled, cos, sin
from vibrissa.rig.beam import peg, tip
from vibrissa.rig.contact import (
    FREE,
    LEAST_ARM,
    ON_FACE,
    PAST,
    clearance,
    depths,
    from_above,
    from_inside,
    side_extent,
    slice_box,
    wall_angles,
    wall_side,
)
from vibrissa.rig.rows import (
    ABOVE,
    BEND,
    DRAG,
    FACE,
    FORM,
    FRICTION,
    FROM_PHI,
    FROM_X,
    FROM_Y,
    FROM_YAW,
    FROM_Z,
    GAMMA,
    HELD_X,
    HELD_Y,
    LENGTH,
    MARGIN,
    MOMENT_X,
    MOMENT_Y,
    PEG,
    PSI,
    RELEASE,
    RIGIDITY,
    RING_X,
    RING_X2,
    RING_Y,
    RING_Y2,
    ROOM,
    SIDE,
    SIDE_BOX,
    SIDE_LEAN,
    TAPER,
    TIP_SLIP,
    TIP_TABLE,
    at,
)
from vibrissa.rig.scene import GRID_REACH, TOP, index_cell

LEAST_DROP = 0.001  # m, a pivot is taken to be at least this far above a wall's top
MOST_ROOM, LEAST_ROOM = 0.02, 1e-4  # m
SLACK = 1e-6  # m, far above what rounding and the tables' ends can move
MOST_LEAN = 2.0  # a whisker bent further sideways than this comes free in any case


@compiled
def clear_of(length: float, angle: float, drop: float) -> bool:
    """Whether a straight whisker at ``angle`` surely ends above a plane ``drop`` below its pivot.

    Uses 1 - a^2/2 + a^4/24 >= cos(a).
    """
    square = angle * angle
    return length * (1.0 - square * (0.5 - square / 24.0)) < drop


@inlined
def touch(
    state: NDArray[np.float64],
    i: int,
    head: NDArray[np.float64],
    beam: NDArray[np.float64],
    boxes: NDArray[np.float64],
    grid: NDArray[np.float64],
    starts: NDArray[np.int32],
    items: NDArray[np.int32],
    skip: bool,
    px: float,
    py: float,
    pz: float,
    ux: float,
    uy: float,
    phi: float,
    sin_phi: float,
    cos_phi: float,
) -> None:
    """Contact of whisker i: updates PSI .. HELD_Y of its state and starts its vibration.

    state and head: float64[rows * 18], see `at`; (px, py, pz): pivot, m, world; (ux, uy): unit
    vector of the whisking plane, outward; phi: motor angle from straight down, rad, with sine and
    cosine. With ``skip`` only boxes the index names are looked at.
    """
    form, table = int(head[at(FORM, i)]), int(head[at(TIP_TABLE, i)])
    length, taper, rigidity = head[at(LENGTH, i)], head[at(TAPER, i)], head[at(RIGIDITY, i)]
    psi, gamma, bend = state[at(PSI, i)], state[at(GAMMA, i)], state[at(BEND, i)]
    # of the whisker as it is bent
    chord = length / (1.0 + head[at(TIP_SLIP, i)] * bend)
    peg_box, side_box, side = (
        int(state[at(PEG, i)]),
        int(state[at(SIDE_BOX, i)]),
        state[at(SIDE, i)],
    )
    lean, on_face = state[at(SIDE_LEAN, i)], state[at(FACE, i)] > 0.0
    came_down = state[at(ABOVE, i)] > 0.0
    old_peg, old_side_box = peg_box, side_box
    sin_psi, cos_psi, known = 0.0, 0.0, False  # of psi, once it is asked for
    floor = boxes.shape[0]

    low, low_box, low_face, low_y, low_x = phi, -1, False, 0.0, 0.0
    high, high_box, high_face, high_y, high_x = phi, -1, False, 0.0, 0.0
    grab, grab_cost, grab_side = -1, math.inf, 0.0

    first, last = 0, boxes.shape[0]
    if skip:
        cell = index_cell(grid, px, py)
        first, last = 0, 0
        if cell >= 0:
            first, last = starts[cell], starts[cell + 1]

    if length * cos_phi > pz:
        moment, offset, _arc = tip(form, beam, table, 1.0 - taper * length, pz / length, phi)
        if moment > 0.0:
            angle = max(atan2(offset, pz / length), phi)
            low, low_box, low_face, low_y = angle, floor, True, moment / length

    for n in range(first, last):
        b = items[n] if skip else n
        drop = max(pz - boxes[b, TOP], LEAST_DROP)
        if drop >= length:
            continue
        near, far, near_x, far_x = slice_box(boxes, b, px, py, ux, uy)
        if near >= far or near >= length:
            continue
        if b == side_box:
            continue
        own = b == peg_box
        if own:
            above = came_down
        else:
            if not known:
                sin_psi, cos_psi, known = sin(psi), cos(psi), True
            where = wall_side(chord, drop, near, far, sin_psi, cos_psi)
            if where == 2:
                continue
            above = where == 1
            if where == 0:
                # The head carried the wall into the whisker: the shortest way out is the way it
                # came.
                over, back = depths(chord, drop, near, far, near_x, far_x, ux, uy, sin_psi, cos_psi)
                if sin_psi > 0.0:
                    start, stop = drop * sin_psi / max(cos_psi, 1e-12), chord * sin_psi
                    left, left_u, right, right_u = side_extent(
                        boxes, b, px, py, ux, uy, start, stop
                    )
                    if left > 0.0 > right:
                        toward = side
                        if toward == 0.0:
                            toward = 1.0 if left * left_u <= -right * right_u else -1.0
                        if toward > 0.0:
                            cost = max(left - lean, 0.0) * left_u
                        else:
                            cost = max(-right - lean, 0.0) * right_u
                        if cost < min(over, back):
                            if side == 0.0 and (
                                cost < grab_cost or (cost == grab_cost and b < grab)
                            ):
                                grab, grab_cost, grab_side = b, cost, toward
                            continue
                above = over <= back
        face = on_face
        what, angle, moment_y, moment_x = FREE, phi, 0.0, 0.0
        for attempt in range(2):
            if above:
                what, angle, moment_y, moment_x = from_above(
                    form,
                    beam,
                    table,
                    taper,
                    length,
                    phi,
                    sin_phi,
                    cos_phi,
                    drop,
                    near,
                    far,
                    far_x,
                    ux,
                    uy,
                    face,
                )
            else:
                what, angle, moment_y, moment_x = from_inside(
                    form,
                    beam,
                    table,
                    taper,
                    length,
                    phi,
                    sin_phi,
                    cos_phi,
                    drop,
                    near,
                    near_x,
                    ux,
                    uy,
                )
            if what != PAST or attempt == 1:
                break
            # Slipped off: the straight whisker is now on the wall's other side.
            above, face = not above, False
        if what in (FREE, PAST):
            continue
        if above:
            if angle > low or (angle == low and b < low_box):
                low, low_box, low_face = angle, b, what == ON_FACE
                low_y, low_x = moment_y, moment_x
        elif high_box < 0 or angle < high or (angle == high and b < high_box):
            high, high_box, high_face = angle, b, what == ON_FACE
            high_y, high_x = moment_y, moment_x

    psi, peg_box, on_face, moment_y, moment_x = phi, -1, False, 0.0, 0.0
    came_down = low_box >= 0
    if low_box >= 0:
        psi, peg_box, on_face, moment_y, moment_x = low, low_box, low_face, low_y, low_x
    elif high_box >= 0:
        psi, peg_box, on_face, moment_y, moment_x = high, high_box, high_face, high_y, high_x

    if grab >= 0:
        side, side_box = grab_side, grab
    side_moment, turn_square = 0.0, 0.0
    if side != 0.0:
        drop = max(pz - boxes[side_box, TOP], LEAST_DROP)
        s, c = sin(psi), cos(psi)
        lean, held = 0.0, False
        if s > 0.0:
            left, left_u, right, right_u = side_extent(
                boxes, side_box, px, py, ux, uy, drop * s / max(c, 1e-12), chord * s
            )
            lean, u = (left, left_u) if side > 0.0 else (-right, right_u)
            if 0.0 < lean < MOST_LEAN:
                arm = min(max(u / s, LEAST_ARM * length), length)
                turn = lean * s
                half = sin(turn) / (1.0 + cos(turn))
                moment, arc, _angle, held = peg(form, beam, 1.0 - taper * arm, half)
                held = held and arc * arm <= length
                if held:
                    turn_square = turn * turn
                    side_moment = side * moment / arm
        if not held:
            # Slipped off, or left alone. If the straight whisker is still in the wall's way, it
            # now rests on its top or hangs behind it, whichever is nearer.
            near, far, near_x, far_x = slice_box(boxes, side_box, px, py, ux, uy)
            if grab < 0 and near < far and near < length and drop < length:
                inner, outer = wall_angles(length, drop, near, far)
                if inner < psi < outer:
                    above = outer - psi <= psi - inner
                    if above:
                        what, angle, one, two = from_above(
                            form,
                            beam,
                            table,
                            taper,
                            length,
                            phi,
                            sin_phi,
                            cos_phi,
                            drop,
                            near,
                            far,
                            far_x,
                            ux,
                            uy,
                            False,
                        )
                    else:
                        what, angle, one, two = from_inside(
                            form,
                            beam,
                            table,
                            taper,
                            length,
                            phi,
                            sin_phi,
                            cos_phi,
                            drop,
                            near,
                            near_x,
                            ux,
                            uy,
                        )
                    if what not in (FREE, PAST) and (angle > psi if above else peg_box < 0):
                        psi, peg_box, on_face = angle, side_box, what == ON_FACE
                        came_down = above
                        moment_y, moment_x = one, two
            side, side_box, lean = 0.0, -1, 0.0

    moment_y *= rigidity
    moment_x = (moment_x + side_moment) * rigidity
    gamma = psi - phi

    mu = head[at(FRICTION, i)]
    if mu > 0.0:
        drag = 0.0
        if peg_box >= 0:
            arm = length
            if peg_box != floor and not on_face:
                drop = max(pz - boxes[peg_box, TOP], LEAST_DROP)
                arm = min(drop / max(cos(psi), 0.1), length)
            u = arm * max(sin(psi), 0.0)
            at_x, at_y = px + u * ux, py + u * uy
            arm = max(arm, LEAST_ARM * length)
            if peg_box == old_peg:
                drag = state[at(DRAG, i)]
                drag -= (
                    (at_y - state[at(HELD_Y, i)]) * ux - (at_x - state[at(HELD_X, i)]) * uy
                ) / arm
            state[at(HELD_X, i)], state[at(HELD_Y, i)] = at_x, at_y
            stiffness = 3.0 * rigidity * (1.0 - taper * arm) / arm
            most = mu * math.sqrt(moment_y * moment_y + moment_x * moment_x) / stiffness
            drag = min(max(drag, -most), most)
            moment_x += stiffness * drag
        state[at(DRAG, i)] = drag

    if peg_box != old_peg or side_box != old_side_box:
        share = head[at(RELEASE, i)]
        freed_x, freed_y = state[at(MOMENT_X, i)] - moment_x, state[at(MOMENT_Y, i)] - moment_y
        state[at(RING_X, i)] += share * freed_x
        state[at(RING_X2, i)] += (1.0 - share) * freed_x
        state[at(RING_Y, i)] += share * freed_y
        state[at(RING_Y2, i)] += (1.0 - share) * freed_y
    if gamma * state[at(GAMMA, i)] < 0.0:
        bend = 0.0
    if peg_box >= 0 or side != 0.0:
        bend += 0.5 * (turn_square + gamma * gamma - bend)
    else:
        bend = 0.0
    state[at(PSI, i)], state[at(GAMMA, i)], state[at(BEND, i)] = psi, gamma, bend
    state[at(PEG, i)], state[at(SIDE, i)], state[at(SIDE_BOX, i)] = peg_box, side, side_box
    state[at(FACE, i)] = 1.0 if on_face else 0.0
    state[at(ABOVE, i)] = 1.0 if came_down else 0.0
    state[at(SIDE_LEAN, i)] = lean
    state[at(MOMENT_X, i)], state[at(MOMENT_Y, i)] = moment_x, moment_y


@compiled
def look_around(
    memo: NDArray[np.float64],
    i: int,
    head: NDArray[np.float64],
    boxes: NDArray[np.float64],
    grid: NDArray[np.float64],
    starts: NDArray[np.int32],
    items: NDArray[np.int32],
    pose: NDArray[np.float64],
    px: float,
    py: float,
    pz: float,
    ux: float,
    uy: float,
    phi: float,
    sin_phi: float,
    cos_phi: float,
) -> None:
    """Remember how far free whisker i is from what it could touch.

    MARGIN: as it may turn, from boxes; ROOM: as it is, from boxes and floor. Of a box, the part
    that is some height above it is as far away as that, and the rest as far as seen from above;
    the best of a few heights counts.
    """
    cell = index_cell(grid, px, py)
    length = head[at(LENGTH, i)]
    margin = grid[GRID_REACH] - length
    room = min(margin, pz - length * cos_phi)
    if cell >= 0:
        for n in range(starts[cell], starts[cell + 1]):
            b = items[n]
            whole = clearance(boxes, b, px, py, ux, uy, length)
            margin = min(margin, whole)
            drop = max(pz - boxes[b, TOP], LEAST_DROP)
            above = drop - length * cos_phi
            if whole < room and above < room:
                best, tall = max(above, whole), MOST_ROOM
                while tall > best and tall > LEAST_ROOM:
                    begin = 0.0
                    if cos_phi > 0.0:
                        begin = min(max((drop - tall) / cos_phi, 0.0), length)
                    start = min(begin * sin_phi, length * sin_phi)
                    extent = (length - begin) * abs(sin_phi)
                    part = clearance(boxes, b, px + start * ux, py + start * uy, ux, uy, extent)
                    best = max(best, min(part, tall))
                    tall *= 0.25
                room = min(room, best)
    memo[at(MARGIN, i)], memo[at(ROOM, i)] = margin - SLACK, room - SLACK
    memo[at(FROM_X, i)], memo[at(FROM_Y, i)], memo[at(FROM_Z, i)] = pose[0], pose[1], pose[2]
    memo[at(FROM_YAW, i)], memo[at(FROM_PHI, i)] = pose[3], phi
