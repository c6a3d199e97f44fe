"""The simulated head carried along a path, with given commands: for measuring the plant alone.

Path and commands are given at knots a fixed time apart, whatever the rate of the plant's ticks, so
that runs at different rates can be compared sample by sample. Between knots the head goes straight
and the command is held; samples are taken at the knots.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.kinematics import NOSE_HEIGHT, WHISKERS
from vibrissa.numerics import compiled
from vibrissa.rig.head import HeadModel, head_step
from vibrissa.rig.plant import HeadPlantParams, fresh_memo, head_model, rest_state
from vibrissa.rig.rows import PEG, SIDE, at

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Carriage:
    """What a head is put through: poses float64[n + 1, 4] (m, rad), commands float32[n, 18] (rad).

    rate: knots per second.
    """

    poses: Float64s
    commands: Float32s
    rate: int

    def repeated(self, times: int) -> Carriage:
        """The same again and again; the path should end where it begins."""
        poses = np.concatenate([np.tile(self.poses[:-1], (times, 1)), self.poses[-1:]])
        return replace(self, poses=poses, commands=np.tile(self.commands, (times, 1)))


@dataclass(frozen=True, eq=False)
class Felt:
    """Samples float32[n, 18] of a run (theta rad, x and y N m), how it went and how long it took.

    held: whisker ticks in contact; seconds: processor time; state: at the end.
    """

    theta: Float32s
    x: Float32s
    y: Float32s
    held: int
    ticks: int
    seconds: float
    state: Float64s

    def bytes(self) -> bytes:
        """Everything that must not depend on skipping."""
        return b"".join(v.tobytes() for v in (self.theta, self.x, self.y, self.state))


def tour(
    seconds: float, rate: int, height: float = NOSE_HEIGHT, swing: Float64s | None = None
) -> Carriage:
    """A winding tour over the 7 x 5 board at about 0.1 m/s, turning, whisking once a second."""
    t = np.arange(round(seconds * rate) + 1) / rate
    poses = np.empty((len(t), 4), dtype=np.float64)
    poses[:, 0] = 0.63 + 0.5 * np.sin(0.13 * t)
    poses[:, 1] = 0.45 + 0.3 * np.sin(0.22 * t + 0.4)
    poses[:, 2] = height
    poses[:, 3] = 0.8 * np.sin(0.17 * t)
    if swing is None:
        swing = HeadPlantParams().geometry.swing
    share = 0.5 - 0.5 * np.cos(2.0 * math.pi * t[:-1])
    return Carriage(poses, (share[:, None] * swing).astype(np.float32), rate)


def carry(
    model: HeadModel,
    params: HeadPlantParams,
    carriage: Carriage,
    *,
    seed: int = 1,
    skip: bool = True,
    first_tick: int = 0,
) -> Felt:
    """Carry a head that starts at rest. The plant's rate is a multiple of the carriage's."""
    per = round(params.rate / carriage.rate)
    if per < 1 or per * carriage.rate != params.rate:
        raise ValueError(f"rate: expected a multiple of {carriage.rate} Hz, found {params.rate}")
    n = len(carriage.commands)
    state, memo = rest_state(params).reshape(-1), fresh_memo().reshape(-1)
    samples = np.zeros((3, n, WHISKERS), dtype=np.float32)
    start = time.process_time()
    held = _carry(
        state, memo, model, skip, seed, first_tick, per, carriage.poses, carriage.commands, samples
    )
    seconds = time.process_time() - start
    theta, x, y = samples
    return Felt(theta, x, y, held, n * per, seconds, state)


def carried(boxes: Float64s, params: HeadPlantParams, carriage: Carriage) -> Felt:
    """`carry` over boxes float64[n, 5]."""
    return carry(head_model(boxes, params), params, carriage)


@compiled
def _carry(
    state: Float64s,
    memo: Float64s,
    model: HeadModel,
    skip: bool,
    seed: int,
    first: int,
    per: int,
    poses: Float64s,
    commands: Float32s,
    samples: Float32s,
) -> int:
    pose = np.empty(4, dtype=np.float64)
    held = 0
    for k in range(commands.shape[0]):
        theta, x, y = samples[0, k], samples[1, k], samples[2, k]
        for m in range(per):
            part = (m + 1) / per
            for a in range(4):
                pose[a] = poses[k, a] + (poses[k + 1, a] - poses[k, a]) * part
            tick = first + k * per + m
            head_step(state, memo, model, skip, seed, tick, pose, commands[k], False, theta, x, y)
            for i in range(WHISKERS):
                touches = state[at(PEG, i)] >= 0.0 or state[at(SIDE, i)] != 0.0
                held += 1 if touches else 0
    return held
