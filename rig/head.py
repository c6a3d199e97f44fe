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
    DRIFT_STEP,
    DRIFT_X,
    DRIFT_Y,
    DT,
    ENCODER_NOISE,
    FIRST_QQ,
    FROM_X,
    FROM_Y,
    FROM_YAW,
    FULL_SCALE,
    GAMMA,
    INERTIA,
    LENGTH,
    MARGIN,
    MOMENT_X,
    MOMENT_Y,
    OMEGA,
    PEG,
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
    WEIGHT,
)
from vibrissa.rig.scene import GRID_TOP
from vibrissa.rig.sensing import DRIFT_TICKS, PAIRS, drift, measured, normals
from vibrissa.rig.touch import LEAST_DROP, clear_of, look_around, touch

TICK = 0.0005  # s, unless the head table has another
QUIET = 1e-14  # N m, where a vibration has died away
STILL = 1e-30  # rad/s, where a servo stands

OK, COMMAND_NOT_FINITE, POSE_OUT_OF_RANGE = range(3)
POSE_LIMIT = 1e4


class HeadModel(NamedTuple):
    """What does not change in a run: head, beam tables and the arrays of the scene."""

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
    """Advance every servo by one tick; fills in the ACCELERATION of the memo."""
    for i in range(state.shape[1]):
        low, high = head[THETA_LOW, i], head[THETA_HIGH, i]
        aim = state[COMMAND, i]
        step = head[RETRACT_STEP, i]
        back = aim - min(max(aim, -step), step)
        aim = back if silent else min(max(float(command[i]), low), high)
        state[COMMAND, i] = aim

        dt = head[DT, i]
        # The contact is a spring that answers within the tick, so that no stiffness is too much.
        gamma, moment = state[GAMMA, i], state[MOMENT_Y, i]
        spring = moment / gamma if abs(gamma) > 1e-9 else 0.0
        compliance, ee = head[COMPLIANCE, i], head[SERVO_EE, i]
        old_theta, old_omega = state[THETA, i], state[OMEGA, i]
        follow = (1.0 - ee) * compliance * spring
        goal = (1.0 - ee) * (aim - compliance * moment) + ee * old_theta
        theta = (goal + head[SERVO_EW, i] * old_omega + follow * old_theta) / (1.0 + follow)
        target = aim - compliance * (moment + spring * (theta - old_theta))
        omega = head[SERVO_WE, i] * (old_theta - target) + head[SERVO_WW, i] * old_omega
        limit = head[SPEED_LIMIT, i]
        fast = abs(omega) > limit or abs(theta - old_theta) > limit * dt
        pace = math.copysign(limit, theta - old_theta)
        omega = pace if fast else omega
        theta = old_theta + pace * dt if fast else theta
        inside = low <= theta <= high
        omega = omega if inside and abs(omega) > STILL else 0.0
        theta = min(max(theta, low), high)
        state[THETA, i], state[OMEGA, i] = theta, omega
        memo[ACCELERATION, i] = (omega - old_omega) * head[RATE, i]
    theta_row, start = state[THETA], head[PHI_START]
    sines, cosines = memo[SIN_PHI], memo[COS_PHI]
    for i in range(state.shape[1]):
        sines[i] = sin(start[i] - theta_row[i])
    for i in range(state.shape[1]):
        cosines[i] = cos(start[i] - theta_row[i])


@compiled
def vibrate(
    state: NDArray[np.float64], memo: NDArray[np.float64], head: NDArray[np.float64]
) -> None:
    """Advance both modes of every shaft, in both directions, by one tick.

    In y they ring about what the turning base does to the shaft's inertia.
    """
    for axis in range(2):
        for mode in range(2):
            row, step = RING_X + 4 * axis + 2 * mode, FIRST_QQ + 4 * mode
            for i in range(state.shape[1]):
                share = head[SWAY, i] if mode == 0 else 1.0 - head[SWAY, i]
                rest = share * head[INERTIA, i] * memo[ACCELERATION, i] if axis == 1 else 0.0
                a, v = state[row, i] - rest, state[row + 1, i]
                b = head[step, i] * a + head[step + 1, i] * v
                w = head[step + 2, i] * a + head[step + 3, i] * v
                # Died away: subnormal numbers would be slow.
                rings = abs(b) >= QUIET or abs(w) >= QUIET
                state[row, i] = rest + b if rings else rest
                state[row + 1, i] = w if rings else 0.0


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
    """Sample every encoder and deflection sensor into float32[18], rad and N m."""
    whiskers = state.shape[1]
    if tick % DRIFT_TICKS == 0:
        drift(state[DRIFT_X : DRIFT_Y + 1], head[DRIFT_STEP], seed, tick)
    noise, uniforms = np.empty(2 * PAIRS, dtype=np.float64), np.empty(2 * PAIRS, dtype=np.float64)
    normals(seed, tick, uniforms, noise)
    for i in range(whiskers):
        x = state[MOMENT_X, i] + (state[RING_X, i] + state[RING_X2, i])
        y = state[MOMENT_Y, i] + (state[RING_Y, i] + state[RING_Y2, i])
        y -= head[WEIGHT, i] * memo[SIN_PHI, i]
        mixed_x = x + head[CROSS_TALK, i] * y + state[DRIFT_X, i]
        mixed_y = y + head[CROSS_TALK, i] * x + state[DRIFT_Y, i]
        mixed_x += head[SENSOR_NOISE, i] * noise[whiskers + i]
        mixed_y += head[SENSOR_NOISE, i] * noise[2 * whiskers + i]
        theta_out[i] = state[THETA, i] + head[ENCODER_NOISE, i] * noise[i]
        full_scale, counts = head[FULL_SCALE, i], head[COUNTS, i]
        x_out[i] = measured(mixed_x, full_scale, counts, head[RESOLUTION, i])
        y_out[i] = measured(mixed_y, full_scale, counts, head[RESOLUTION, i])


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

    state float64[STATE_ROWS, 18] and memo float64[MEMO_ROWS, 18], changed in place; a memo belongs
    to one state and one model, and a fresh one of zeros may replace it at any time; pose
    float64[4]: x, y, z (m) and yaw (rad) of the head; command float32[18]: theta set-points, rad;
    silent: the watchdog has fired, the drives go back to theta = 0 by themselves. Results
    float32[18]: theta rad, x and y N m.
    Returns OK, or COMMAND_NOT_FINITE or POSE_OUT_OF_RANGE with nothing changed.
    """
    head, beam, boxes, grid, starts, items = model
    whiskers = state.shape[1]
    for k in range(4):
        if not abs(pose[k]) <= POSE_LIMIT:
            return POSE_OUT_OF_RANGE
    if not silent:
        for i in range(whiskers):
            if not math.isfinite(command[i]):
                return COMMAND_NOT_FINITE
    drive(state, memo, head, command, silent)
    cos_yaw, sin_yaw = cos(pose[3]), sin(pose[3])
    still = True
    for k in range(4):
        still = still and memo[POSE, k] == pose[k]
        memo[POSE, k] = pose[k]
    top = grid[GRID_TOP]
    for i in range(whiskers):
        phi = head[PHI_START, i] - state[THETA, i]
        length = head[LENGTH, i]
        pz = max(pose[2] + head[PIVOT_HEIGHT, i], LEAST_DROP)
        free = state[PEG, i] < 0.0 and state[SIDE, i] == 0.0
        if skip:
            if free:
                angle = min(abs(state[PSI, i]), abs(phi))
                moved = (
                    abs(pose[0] - memo[FROM_X, i])
                    + abs(pose[1] - memo[FROM_Y, i])
                    + abs(pose[3] - memo[FROM_YAW, i]) * (head[PIVOT_RADIUS, i] + length)
                )
                away = moved < memo[MARGIN, i]
                drop = pz if away else max(pz - top, LEAST_DROP)
                if clear_of(length, angle, drop):
                    state[PSI, i] = phi
                    memo[SETTLED, i] = 0.0
                    continue
            if still and memo[SETTLED, i] > 0.0 and memo[SETTLED_PHI, i] == phi:
                continue
        ux = cos_yaw * head[AZIMUTH_COS, i] - sin_yaw * head[AZIMUTH_SIN, i]
        uy = sin_yaw * head[AZIMUTH_COS, i] + cos_yaw * head[AZIMUTH_SIN, i]
        px = pose[0] + head[PIVOT_RADIUS, i] * ux
        py = pose[1] + head[PIVOT_RADIUS, i] * uy
        if skip and still:
            for k in range(CONTACT_ROWS):
                memo[BEFORE + k, i] = state[PSI + k, i]
        met = touch(
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
            memo[SIN_PHI, i],
            memo[COS_PHI, i],
        )
        if skip:
            settled = still
            if still:
                for k in range(CONTACT_ROWS):
                    settled = settled and memo[BEFORE + k, i] == state[PSI + k, i]
            memo[SETTLED, i], memo[SETTLED_PHI, i] = 1.0 if settled else 0.0, phi
            if met == 0 and state[PEG, i] < 0.0 and state[SIDE, i] == 0.0:
                look_around(memo, i, head, boxes, grid, starts, items, pose, px, py, ux, uy)
    vibrate(state, memo, head)
    sense(state, memo, head, seed, tick, theta_out, x_out, y_out)
    return OK
