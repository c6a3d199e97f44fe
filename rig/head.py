"""One tick of the simulated head: eighteen servos, shafts and sensors in one compiled call.

Order within a tick: servo, contact, vibration, sensor. The contact moment of one tick pushes on
the servo in the next.

Skipping is exact. A whisker that no wall can reach is passed over, found by bounds that hold
whatever it does meanwhile; one whose wall and angle have not changed keeps its contact. What the
bounds need is remembered in ``memo``, apart from the state, which is the same bytes either way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.kinematics import WHISKERS
from vibrissa.numerics import compiled, cos, sin
from vibrissa.rig.rows import (
    ACCELERATION,
    AZIMUTH_COS,
    AZIMUTH_SIN,
    BEFORE,
    COMMAND,
    COMPLIANCE,
    CONTACT_ROWS,
    COS_PHI,
    COUNTS,
    CROSS_TALK,
    DRIFT_X,
    DT,
    ENCODER_NOISE,
    FIRST_QQ,
    FROM_PHI,
    FROM_X,
    FROM_Y,
    FROM_YAW,
    FROM_Z,
    FULL_SCALE,
    GAMMA,
    INERTIA,
    LENGTH,
    MARGIN,
    MOMENT_X,
    MOMENT_Y,
    NOISE,
    OMEGA,
    PASSED,
    PEG,
    PHI,
    PHI_START,
    PIVOT_HEIGHT,
    PIVOT_RADIUS,
    POSE,
    PSI,
    RATE,
    RESOLUTION,
    RETRACT_STEP,
    RING_X,
    RING_X2,
    RING_Y,
    RING_Y2,
    ROOM,
    SENSOR_NOISE,
    SERVO_EE,
    SERVO_EW,
    SERVO_WE,
    SERVO_WW,
    SETTLED,
    SETTLED_PHI,
    SIDE,
    SIN_PHI,
    SPEED_LIMIT,
    SWAY,
    THETA,
    THETA_HIGH,
    THETA_LOW,
    UNIFORMS,
    WEIGHT,
    at,
)
from vibrissa.rig.scene import GRID_TOP
from vibrissa.rig.sensing import DRIFT_TICKS, PAIRS, drift, measured, normals
from vibrissa.rig.touch import LEAST_DROP, clear_of, look_around, touch

TICK = 0.0005  # s, unless the head table has another
QUIET = 1e-14  # N m, where a vibration has died away
STILL = 1e-30  # rad/s, where a servo stands
IN_VECTORS = 24  # whiskers, with some of no meaning that fill the last vector

OK, COMMAND_NOT_FINITE, POSE_OUT_OF_RANGE = range(3)
POSE_LIMIT = 1e4


class HeadModel(NamedTuple):
    """What does not change in a run: head, beam tables and the arrays of the scene.

    head: float64[HEAD_ROWS * 18], see `at`.
    """

    head: NDArray[np.float64]
    beam: NDArray[np.float64]
    boxes: NDArray[np.float64]
    grid: NDArray[np.float64]
    starts: NDArray[np.int32]
    items: NDArray[np.int32]


@compiled
def drive(
    state: NDArray[np.float64],
    memo: NDArray[np.float64],
    head: NDArray[np.float64],
    command: NDArray[np.float32],
    silent: bool,
) -> None:
    """Advance every servo by one tick; fills in ACCELERATION and PHI .. COS_PHI of the memo.

    state, memo and head: float64[rows * 18], see `at`.
    """
    for i in range(WHISKERS):
        low, high = head[at(THETA_LOW, i)], head[at(THETA_HIGH, i)]
        aim = state[at(COMMAND, i)]
        step = head[at(RETRACT_STEP, i)]
        back = aim - min(max(aim, -step), step)
        aim = back if silent else min(max(float(command[i]), low), high)
        state[at(COMMAND, i)] = aim

        dt = head[at(DT, i)]
        # The contact is a spring that answers within the tick, so that no stiffness is too much.
        gamma, moment = state[at(GAMMA, i)], state[at(MOMENT_Y, i)]
        spring = moment / gamma if abs(gamma) > 1e-9 else 0.0
        compliance, ee = head[at(COMPLIANCE, i)], head[at(SERVO_EE, i)]
        old_theta, old_omega = state[at(THETA, i)], state[at(OMEGA, i)]
        follow = (1.0 - ee) * compliance * spring
        goal = (1.0 - ee) * (aim - compliance * moment) + ee * old_theta
        theta = (goal + head[at(SERVO_EW, i)] * old_omega + follow * old_theta) / (1.0 + follow)
        target = aim - compliance * (moment + spring * (theta - old_theta))
        omega = head[at(SERVO_WE, i)] * (old_theta - target) + head[at(SERVO_WW, i)] * old_omega
        limit = head[at(SPEED_LIMIT, i)]
        fast = abs(omega) > limit or abs(theta - old_theta) > limit * dt
        pace = math.copysign(limit, theta - old_theta)
        omega = pace if fast else omega
        theta = old_theta + pace * dt if fast else theta
        inside = low <= theta <= high
        omega = omega if inside and abs(omega) > STILL else 0.0
        theta = min(max(theta, low), high)
        state[at(THETA, i)], state[at(OMEGA, i)] = theta, omega
        memo[at(ACCELERATION, i)] = (omega - old_omega) * head[at(RATE, i)]
        memo[at(PHI, i)] = head[at(PHI_START, i)] - theta
    for i in range(IN_VECTORS):
        memo[at(SIN_PHI, i)] = sin(memo[at(PHI, i)])
    for i in range(IN_VECTORS):
        memo[at(COS_PHI, i)] = cos(memo[at(PHI, i)])


@compiled
def vibrate(
    state: NDArray[np.float64], memo: NDArray[np.float64], head: NDArray[np.float64]
) -> None:
    """Advance both modes of every shaft, in both directions, by one tick.

    In y they ring about what the turning base does to the shaft's inertia. Arguments as for
    `drive`.
    """
    for axis in range(2):
        for mode in range(2):
            row, step = RING_X + 4 * axis + 2 * mode, FIRST_QQ + 4 * mode
            for i in range(WHISKERS):
                share = head[at(SWAY, i)] if mode == 0 else 1.0 - head[at(SWAY, i)]
                rest = 0.0
                if axis == 1:
                    rest = share * head[at(INERTIA, i)] * memo[at(ACCELERATION, i)]
                a, v = state[at(row, i)] - rest, state[at(row + 1, i)]
                b = head[at(step, i)] * a + head[at(step + 1, i)] * v
                w = head[at(step + 2, i)] * a + head[at(step + 3, i)] * v
                # Died away: subnormal numbers would be slow.
                rings = abs(b) >= QUIET or abs(w) >= QUIET
                state[at(row, i)] = rest + b if rings else rest
                state[at(row + 1, i)] = w if rings else 0.0


@compiled
def sense(
    state: NDArray[np.float64],
    memo: NDArray[np.float64],
    head: NDArray[np.float64],
    seed: int,
    tick: int,
    theta_out: NDArray[np.float32],
    x_out: NDArray[np.float32],
    y_out: NDArray[np.float32],
) -> None:
    """Sample every encoder and deflection sensor into float32[18], rad and N m.

    state, memo and head as for `drive`.
    """
    if tick % DRIFT_TICKS == 0:
        drift(state, head, seed, tick)
    noise = memo[at(NOISE, 0) : at(NOISE, 2 * PAIRS)]
    normals(seed, tick, memo[at(UNIFORMS, 0) : at(UNIFORMS, 2 * PAIRS)], noise)
    for i in range(WHISKERS):
        theta_out[i] = state[at(THETA, i)] + head[at(ENCODER_NOISE, i)] * noise[i]
    for axis in range(2):
        out = y_out if axis == 1 else x_out
        for i in range(WHISKERS):
            x = state[at(MOMENT_X, i)] + (state[at(RING_X, i)] + state[at(RING_X2, i)])
            y = state[at(MOMENT_Y, i)] + (state[at(RING_Y, i)] + state[at(RING_Y2, i)])
            y -= head[at(WEIGHT, i)] * memo[at(SIN_PHI, i)]
            own, other = (y, x) if axis == 1 else (x, y)
            mixed = own + head[at(CROSS_TALK, i)] * other + state[at(DRIFT_X + axis, i)]
            mixed += head[at(SENSOR_NOISE, i)] * noise[at(1 + axis, i)]
            out[i] = measured(
                mixed, head[at(FULL_SCALE, i)], head[at(COUNTS, i)], head[at(RESOLUTION, i)]
            )


@compiled
def pass_over(
    state: NDArray[np.float64],
    memo: NDArray[np.float64],
    head: NDArray[np.float64],
    pose: NDArray[np.float64],
    top: float,
    still: bool,
) -> None:
    """Find the whiskers whose contact needs no look, and advance them: PASSED of the memo is 1.

    Those are: free and with room to where they are now, or above all walls, or above the floor and
    away from walls; and held as in the tick before, from which nothing has changed. top: of the
    highest wall, m; still: whether the head stands. Other arguments as for `drive`.
    """
    for i in range(WHISKERS):
        phi, psi, length = memo[at(PHI, i)], state[at(PSI, i)], head[at(LENGTH, i)]
        from_phi = memo[at(FROM_PHI, i)]
        moved = (
            abs(pose[0] - memo[at(FROM_X, i)])
            + abs(pose[1] - memo[at(FROM_Y, i)])
            + abs(pose[3] - memo[at(FROM_YAW, i)]) * (head[at(PIVOT_RADIUS, i)] + length)
        )
        turned = max(abs(phi - from_phi), abs(psi - from_phi))
        reached = moved + abs(pose[2] - memo[at(FROM_Z, i)]) + turned * length
        pz = max(pose[2] + head[at(PIVOT_HEIGHT, i)], LEAST_DROP)
        drop = pz if moved < memo[at(MARGIN, i)] else max(pz - top, LEAST_DROP)
        clear = clear_of(length, min(abs(psi), abs(phi)), drop)
        free = (state[at(PEG, i)] < 0.0) & (state[at(SIDE, i)] == 0.0)
        flies = free & (clear | (reached < memo[at(ROOM, i)]))
        settled, settled_phi = memo[at(SETTLED, i)], memo[at(SETTLED_PHI, i)]
        rests = still & (settled > 0.0) & (settled_phi == phi)
        state[at(PSI, i)] = phi if flies else psi
        memo[at(SETTLED, i)] = 0.0 if flies else settled
        memo[at(PASSED, i)] = 1.0 if flies | rests else 0.0


@compiled
def head_step(
    state: NDArray[np.float64],
    memo: NDArray[np.float64],
    model: HeadModel,
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

    state float64[STATE_ROWS * 18] and memo float64[MEMO_ROWS * 18], changed in place, see `at`; a
    memo belongs to one state and one model, and a fresh one of zeros may replace it at any time;
    pose float64[4]: x, y, z (m) and yaw (rad) of the head; command float32[18]: theta set-points,
    rad; silent: the watchdog has fired, the drives go back to theta = 0 by themselves. Results
    float32[18]: theta rad, x and y N m.
    Returns OK, or COMMAND_NOT_FINITE or POSE_OUT_OF_RANGE with nothing changed.
    """
    head, beam, boxes, grid, starts, items = model
    for k in range(4):
        if not abs(pose[k]) <= POSE_LIMIT:
            return POSE_OUT_OF_RANGE
    bad = 0
    for i in range(WHISKERS):
        bad += 0 if math.isfinite(command[i]) else 1
    if bad > 0 and not silent:
        return COMMAND_NOT_FINITE
    drive(state, memo, head, command, silent)
    cos_yaw, sin_yaw = cos(pose[3]), sin(pose[3])
    still = True
    for k in range(4):
        still = still and memo[at(POSE, k)] == pose[k]
        memo[at(POSE, k)] = pose[k]
    if skip:
        pass_over(state, memo, head, pose, grid[GRID_TOP], still)
    for i in range(WHISKERS):
        if skip and memo[at(PASSED, i)] > 0.0:
            continue
        phi = memo[at(PHI, i)]
        pz = max(pose[2] + head[at(PIVOT_HEIGHT, i)], LEAST_DROP)
        ux = cos_yaw * head[at(AZIMUTH_COS, i)] - sin_yaw * head[at(AZIMUTH_SIN, i)]
        uy = sin_yaw * head[at(AZIMUTH_COS, i)] + cos_yaw * head[at(AZIMUTH_SIN, i)]
        px = pose[0] + head[at(PIVOT_RADIUS, i)] * ux
        py = pose[1] + head[at(PIVOT_RADIUS, i)] * uy
        if skip and still:
            for k in range(CONTACT_ROWS):
                memo[at(BEFORE + k, i)] = state[at(PSI + k, i)]
        touch(
            state,
            i,
            head,
            beam,
            boxes,
            grid,
            starts,
            items,
            skip,
            px,
            py,
            pz,
            ux,
            uy,
            phi,
            memo[at(SIN_PHI, i)],
            memo[at(COS_PHI, i)],
        )
        if skip:
            settled = still
            if still:
                for k in range(CONTACT_ROWS):
                    settled = settled and memo[at(BEFORE + k, i)] == state[at(PSI + k, i)]
            memo[at(SETTLED, i)], memo[at(SETTLED_PHI, i)] = 1.0 if settled else 0.0, phi
            if state[at(PEG, i)] < 0.0 and state[at(SIDE, i)] == 0.0:
                look_around(
                    memo,
                    i,
                    head,
                    boxes,
                    grid,
                    starts,
                    items,
                    pose,
                    px,
                    py,
                    pz,
                    ux,
                    uy,
                    phi,
                    memo[at(SIN_PHI, i)],
                    memo[at(COS_PHI, i)],
                )
    vibrate(state, memo, head)
    sense(state, memo, head, seed, tick, theta_out, x_out, y_out)
    return OK
