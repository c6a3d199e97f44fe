"""One tick of the simulated head: eighteen servos, shafts and sensors in one compiled call.

Order within a tick: servo, contact, vibration, sensor. The contact moment of one tick pushes on
the servo in the next. Nothing here draws from a sequence: noise is a function of (seed, whisker,
tick), so a skipped computation never shifts it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled, cos, philox_normals4, sin
from vibrissa.rig.scene import GRID_TOP, TOP, index_cell
from vibrissa.rig.whisker import (
    INERTIA,
    LEAST_ARM,
    LENGTH,
    NO_WALL,
    RIGIDITY,
    RING_QQ,
    RING_QV,
    RING_VQ,
    RING_VV,
    SHAFT_ROWS,
    TAPER,
    TIP_SLIP,
    WEIGHT,
    bending_stiffness,
    side_extent,
    slice_box,
    wall_angles,
)

# Rows of the head table float64[HEAD_ROWS, 18]; the first SHAFT_ROWS are those of the shaft table.
(
    PIVOT_RADIUS,  # m
    PIVOT_HEIGHT,  # m above the nose plane
    AZIMUTH_COS,
    AZIMUTH_SIN,
    PHI_START,  # rad
    THETA_LOW,  # rad, mechanical stops
    THETA_HIGH,
    SERVO_EE,  # servo over one tick: e' = EE e + EW w, w' = WE e + WW w, e = theta - target
    SERVO_EW,
    SERVO_WE,
    SERVO_WW,
    COMPLIANCE,  # rad/(N m), 1 / Kp
    SPEED_LIMIT,  # rad/s
    RETRACT_STEP,  # rad per tick, when the watchdog retracts
    ENCODER_NOISE,  # rad
    SENSOR_NOISE,  # N m
    DRIFT_STEP,  # N m, standard deviation per DRIFT_TICKS
    CROSS_TALK,  # fraction of x in y and of y in x
    FULL_SCALE,  # N m
    RESOLUTION,  # N m per count, 0 for none
) = range(SHAFT_ROWS, SHAFT_ROWS + 20)
HEAD_ROWS = SHAFT_ROWS + 20

# Rows of the state float64[STATE_ROWS, 18].
(
    THETA,  # rad
    OMEGA,  # rad/s
    COMMAND,  # rad, what the servo follows
    PSI,  # rad, chord of the shaft in the whisking plane
    GAMMA,  # rad, psi - phi: > 0 pushed back while protracting, < 0 hooked while retracting
    PEG,  # wall touched in the whisking plane: box, or number of boxes for the floor; -1 none
    SIDE,  # 1 pushed to the left (counterclockwise seen from above) by a wall met sideways, -1, 0
    SIDE_BOX,  # the box that pushes sideways, -1 none
    SIDE_LEAN,  # horizontal lean sideways, offset over distance from the pivot, >= 0
    BEND,  # rad^2, angle^2 of the contact, smoothed over two ticks
    MOMENT_X,  # N m, quasi-static
    MOMENT_Y,
    RING_X,  # N m and N m/s, vibration of the first mode
    RING_X_RATE,
    RING_Y,
    RING_Y_RATE,
    DRIFT_X,  # N m
    DRIFT_Y,
) = range(18)
STATE_ROWS = 18

TICK = 0.0005  # s
DRIFT_TICKS = 200
LEAST_DROP = 0.001  # m, a pivot is taken to be at least this far above a wall's top
MOST_LEAN = 2.0  # a whisker bent further sideways than this comes free in any case
QUIET = 1e-14  # N m, where a vibration has died away
DRIFT_STREAM = 32  # first noise stream of the drift; those below are the whiskers' samples

OK, COMMAND_NOT_FINITE, POSE_OUT_OF_RANGE = range(3)
POSE_LIMIT = 1e4


@compiled
def clear_of(length: float, angle: float, drop: float) -> bool:
    """Whether a straight whisker at ``angle`` surely ends above a plane ``drop`` below its pivot.

    Uses 1 - a^2/2 + a^4/24 >= cos(a).
    """
    square = angle * angle
    return length * (1.0 - square * (0.5 - square / 24.0)) < drop


@compiled
def touch(
    state: NDArray[np.float64],
    i: int,
    head: NDArray[np.float64],
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
) -> None:
    """Contact of whisker i: updates PSI .. MOMENT_Y of its state and starts its vibration.

    (px, py, pz): pivot, m, world; (ux, uy): unit vector of the whisking plane, outward; phi: motor
    angle from straight down, rad. With ``skip`` only boxes the index names are looked at.
    """
    length, taper = head[LENGTH, i], head[TAPER, i]
    chord = length / (1.0 + head[TIP_SLIP, i] * state[BEND, i])  # of the whisker as it is bent
    psi, gamma, bend = state[PSI, i], state[GAMMA, i], state[BEND, i]
    peg, side_box, side = int(state[PEG, i]), int(state[SIDE_BOX, i]), state[SIDE, i]
    lean = state[SIDE_LEAN, i]
    old_peg, old_side_box = peg, side_box
    floor = boxes.shape[0]

    low, low_box, low_edge, low_far, low_x, low_drop = -NO_WALL, -1, False, 0.0, True, 1.0
    high, high_box, high_x = NO_WALL, -1, True
    grab, grab_cost, grab_side = -1, math.inf, 0.0

    lowest = min(psi, phi)
    first, last = 0, boxes.shape[0]
    if skip:
        last = 0
        if not clear_of(length, lowest, max(pz - grid[GRID_TOP], LEAST_DROP)):
            cell = index_cell(grid, px, py)
            if cell >= 0:
                first, last = starts[cell], starts[cell + 1]

    if chord > pz and not clear_of(length, lowest, pz):
        low, low_box = atan2(math.sqrt(chord * chord - pz * pz), pz), floor

    for n in range(first, last):
        b = items[n] if skip else n
        if b == side_box:
            continue
        box = boxes[b]
        drop = max(pz - box[TOP], LEAST_DROP)
        if drop >= length:
            continue
        near, far, near_x, far_x = slice_box(box, px, py, ux, uy)
        if near >= far or near >= length:
            continue
        own = b == peg
        inner, outer, edge = wall_angles(chord, drop, near, far)
        above = psi >= outer
        if own:
            above = gamma > 0.0
            if inner >= outer:
                # Slipped off: the straight whisker is now on the wall's other side.
                inner, outer, edge = wall_angles(length, drop, near, far)
                above = not above
        elif inner < psi < outer:
            # The head carried the wall into the whisker: the shortest way out is the way it came.
            out = min(outer - psi, psi - inner)
            s, c = sin(psi), cos(psi)
            if s > 0.0:
                left, left_u, right, right_u = side_extent(
                    box, px, py, ux, uy, drop * s / c, chord * s
                )
                if left > 0.0 > right:
                    toward = side
                    if toward == 0.0:
                        toward = 1.0 if left * left_u <= -right * right_u else -1.0
                    if toward > 0.0:
                        cost = max(left - lean, 0.0) * left_u
                    else:
                        cost = max(-right - lean, 0.0) * right_u
                    if cost < out * length:
                        if side == 0.0 and (cost < grab_cost or (cost == grab_cost and b < grab)):
                            grab, grab_cost, grab_side = b, cost, toward
                        continue
            above = outer - psi <= psi - inner
        if inner >= outer:
            continue
        if above:
            if outer > low or (outer == low and b < low_box):
                low, low_box, low_edge = outer, b, edge
                low_far, low_x, low_drop = far, far_x, drop
        elif -NO_WALL < inner < high or (inner == high and b < high_box):
            high, high_box, high_x = inner, b, near_x

    psi, peg = phi, -1
    if phi < low:
        psi, peg = low, low_box
    elif phi > high:
        psi, peg = high, high_box

    if grab >= 0:
        side, side_box = grab_side, grab
    moment_x, turn_square = 0.0, 0.0
    if side != 0.0:
        box = boxes[side_box]
        drop = max(pz - box[TOP], LEAST_DROP)
        s, c = sin(psi), cos(psi)
        lean, u = 0.0, 0.0
        if s > 0.0:
            left, left_u, right, right_u = side_extent(box, px, py, ux, uy, drop * s / c, chord * s)
            lean, u = (left, left_u) if side > 0.0 else (-right, right_u)
        if 0.0 < lean < MOST_LEAN:
            arm = min(max(u / s, LEAST_ARM * length), length)
            turn = side * lean * s
            turn_square = turn * turn
            moment_x = bending_stiffness(head[RIGIDITY, i], taper, arm) * turn
        else:
            # Slipped off, or left alone. If the straight whisker is still in the wall's way, it
            # now rests on its top or hangs behind it, whichever is nearer.
            near, far, near_x, far_x = slice_box(box, px, py, ux, uy)
            if grab < 0 and near < far and near < length and drop < length:
                inner, outer, edge = wall_angles(length, drop, near, far)
                if inner < psi < outer:
                    peg = side_box
                    if outer - psi <= psi - inner:
                        psi, low_edge, low_far, low_x, low_drop = outer, edge, far, far_x, drop
                        low_box = peg
                    else:
                        psi, high_x = inner, near_x
            side, side_box, lean = 0.0, -1, 0.0

    gamma = psi - phi
    moment_y = 0.0
    if peg >= 0:
        arm = length
        across, along, lever = 0.0, 1.0, 1.0
        if peg != floor:
            if gamma > 0.0:
                if low_edge:
                    arm = math.sqrt(low_far * low_far + low_drop * low_drop)
                    along = abs(ux) if low_x else abs(uy)
                    across = -uy * math.copysign(1.0, ux) if low_x else ux * math.copysign(1.0, uy)
                    lever = low_drop / arm
            else:
                along = abs(ux) if high_x else abs(uy)
                across = -uy * math.copysign(1.0, ux) if high_x else ux * math.copysign(1.0, uy)
                lever = 1.0 / max(cos(psi), 0.1)
        # A frictionless contact pushes along the normal of shaft and edge (or of the face): an
        # oblique wall turns part of gamma sideways.
        across *= lever
        share = along / (along * along + across * across)
        turn_square += gamma * gamma * along * share
        stiffness = bending_stiffness(head[RIGIDITY, i], taper, max(arm, LEAST_ARM * length))
        moment_y = stiffness * gamma * along * share
        moment_x += stiffness * gamma * across * share

    if peg != old_peg or side_box != old_side_box:
        state[RING_Y, i] += state[MOMENT_Y, i] - moment_y
        state[RING_X, i] += state[MOMENT_X, i] - moment_x
    if gamma * state[GAMMA, i] < 0.0:
        bend = 0.0
    if peg >= 0 or side != 0.0:
        bend += 0.5 * (turn_square - bend)
    else:
        bend = 0.0
    state[PSI, i], state[GAMMA, i], state[BEND, i] = psi, gamma, bend
    state[PEG, i], state[SIDE, i], state[SIDE_BOX, i] = peg, side, side_box
    state[SIDE_LEAN, i] = lean
    state[MOMENT_X, i], state[MOMENT_Y, i] = moment_x, moment_y


@compiled
def drive(
    state: NDArray[np.float64],
    head: NDArray[np.float64],
    command: NDArray[np.float32],
    silent: bool,
    acceleration: NDArray[np.float64],
) -> None:
    """Advance every servo by one tick; acceleration float64[18], rad/s^2, is filled in."""
    for i in range(state.shape[1]):
        low, high = head[THETA_LOW, i], head[THETA_HIGH, i]
        aim = state[COMMAND, i]
        if silent:
            step = head[RETRACT_STEP, i]
            aim -= min(max(aim, -step), step)
        else:
            aim = min(max(float(command[i]), low), high)
        state[COMMAND, i] = aim

        target = aim - state[MOMENT_Y, i] * head[COMPLIANCE, i]
        old_theta, old_omega = state[THETA, i], state[OMEGA, i]
        e = old_theta - target
        theta = target + head[SERVO_EE, i] * e + head[SERVO_EW, i] * old_omega
        omega = head[SERVO_WE, i] * e + head[SERVO_WW, i] * old_omega
        limit = head[SPEED_LIMIT, i]
        if abs(omega) > limit or abs(theta - old_theta) > limit * TICK:
            omega = math.copysign(limit, theta - old_theta)
            theta = old_theta + omega * TICK
        if theta < low or theta > high:
            theta = min(max(theta, low), high)
            omega = 0.0
        state[THETA, i], state[OMEGA, i] = theta, omega
        acceleration[i] = (omega - old_omega) / TICK


@compiled
def vibrate(state: NDArray[np.float64], head: NDArray[np.float64]) -> None:
    """Advance the first mode of every shaft, in both directions, by one tick."""
    for q in (RING_X, RING_Y):
        for i in range(state.shape[1]):
            a, v = state[q, i], state[q + 1, i]
            b = head[RING_QQ, i] * a + head[RING_QV, i] * v
            w = head[RING_VQ, i] * a + head[RING_VV, i] * v
            # Died away: subnormal numbers would be slow.
            rings = abs(b) >= QUIET or abs(w) >= QUIET
            state[q, i] = b if rings else 0.0
            state[q + 1, i] = w if rings else 0.0


@compiled
def measured(moment: float, full_scale: float, resolution: float) -> float:
    """A base moment as the sensor reports it: rounded to counts and clipped, N m."""
    counts = np.floor(moment / max(resolution, 1e-30) + 0.5)
    moment = counts * resolution if resolution > 0.0 else moment
    return min(max(moment, -full_scale), full_scale)


@compiled
def sense(
    state: NDArray[np.float64],
    head: NDArray[np.float64],
    acceleration: NDArray[np.float64],
    seed: int,
    tick: int,
    theta_out: NDArray[np.float32],
    x_out: NDArray[np.float32],
    y_out: NDArray[np.float32],
) -> None:
    """Sample every encoder and deflection sensor into float32[18], rad and N m."""
    whiskers = state.shape[1]
    if tick % DRIFT_TICKS == 0:
        for i in range(whiskers):
            walk_x, walk_y, _, _ = philox_normals4(seed, DRIFT_STREAM + i, tick)
            state[DRIFT_X, i] += head[DRIFT_STEP, i] * walk_x
            state[DRIFT_Y, i] += head[DRIFT_STEP, i] * walk_y
    noise = np.empty((3, whiskers), dtype=np.float64)
    for i in range(whiskers):
        noise[0, i], noise[1, i], noise[2, i], _ = philox_normals4(seed, i, tick)
    for i in range(whiskers):
        x = state[MOMENT_X, i] + state[RING_X, i]
        y = state[MOMENT_Y, i] + state[RING_Y, i] + head[INERTIA, i] * acceleration[i]
        y -= head[WEIGHT, i] * sin(head[PHI_START, i] - state[THETA, i])
        mixed_x = x + head[CROSS_TALK, i] * y + state[DRIFT_X, i]
        mixed_y = y + head[CROSS_TALK, i] * x + state[DRIFT_Y, i]
        mixed_x += head[SENSOR_NOISE, i] * noise[1, i]
        mixed_y += head[SENSOR_NOISE, i] * noise[2, i]
        theta_out[i] = state[THETA, i] + head[ENCODER_NOISE, i] * noise[0, i]
        x_out[i] = measured(mixed_x, head[FULL_SCALE, i], head[RESOLUTION, i])
        y_out[i] = measured(mixed_y, head[FULL_SCALE, i], head[RESOLUTION, i])


@compiled
def head_step(
    state: NDArray[np.float64],
    head: NDArray[np.float64],
    boxes: NDArray[np.float64],
    grid: NDArray[np.float64],
    starts: NDArray[np.int32],
    items: NDArray[np.int32],
    skip: bool,
    seed: int,
    tick: int,
    pose: NDArray[np.float64],
    command: NDArray[np.float32],
    silent: bool,
    theta_out: NDArray[np.float32],
    x_out: NDArray[np.float32],
    y_out: NDArray[np.float32],
) -> int:
    """Advance all whiskers by one tick and sample them.

    state float64[STATE_ROWS, 18], changed in place; head float64[HEAD_ROWS, 18]; boxes, grid,
    starts, items: the arrays of a Scene; pose float64[4]: x, y, z (m) and yaw (rad) of the head;
    command float32[18]: theta set-points, rad; silent: the watchdog has fired, the drives go back
    to theta = 0 by themselves. Results float32[18]: theta rad, x and y N m.
    Returns OK, or COMMAND_NOT_FINITE or POSE_OUT_OF_RANGE with nothing changed.
    """
    whiskers = state.shape[1]
    for k in range(4):
        if not abs(pose[k]) <= POSE_LIMIT:
            return POSE_OUT_OF_RANGE
    if not silent:
        for i in range(whiskers):
            if not math.isfinite(command[i]):
                return COMMAND_NOT_FINITE
    acceleration = np.empty(whiskers, dtype=np.float64)
    drive(state, head, command, silent, acceleration)
    cos_yaw, sin_yaw = cos(pose[3]), sin(pose[3])
    for i in range(whiskers):
        ux = cos_yaw * head[AZIMUTH_COS, i] - sin_yaw * head[AZIMUTH_SIN, i]
        uy = sin_yaw * head[AZIMUTH_COS, i] + cos_yaw * head[AZIMUTH_SIN, i]
        touch(
            state,
            i,
            head,
            boxes,
            grid,
            starts,
            items,
            skip,
            pose[0] + head[PIVOT_RADIUS, i] * ux,
            pose[1] + head[PIVOT_RADIUS, i] * uy,
            max(pose[2] + head[PIVOT_HEIGHT, i], LEAST_DROP),
            ux,
            uy,
            head[PHI_START, i] - state[THETA, i],
        )
    vibrate(state, head)
    sense(state, head, acceleration, seed, tick, theta_out, x_out, y_out)
    return OK
