"""What the encoders and deflection sensors report: noise, drift, cross-talk, counts, clipping.

Noise is a function of (seed, tick): 64 normal draws from sixteen blocks of random bits, made for
all whiskers at once; 54 are used, and whole vectors take less time than fewer would. Nothing draws
from a sequence, so skipped work never shifts it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.kinematics import WHISKERS
from vibrissa.numerics import compiled, cos, log, philox4x32, philox_normals4, sin
from vibrissa.rig.rows import DRIFT_STEP, DRIFT_X, DRIFT_Y, at

BLOCKS = 16  # of four 32-bit words, each pair of words gives two normals
PAIRS = 2 * BLOCKS
DRIFT_TICKS = 200
DRIFT_STREAM = 32  # first noise stream of the drift; those below are the blocks of a tick


@compiled
def normals(seed: int, tick: int, uniforms: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """64 independent standard normals, |z| < 6.8, by the method of Box and Muller.

    uniforms: float64[64], overwritten; out: float64[64].
    """
    for n in range(BLOCKS):
        w0, w1, w2, w3 = philox4x32(tick, tick >> 32, n, 0, seed, seed >> 32)
        # 2^52 + w, written as bits: a word becomes a float without a conversion.
        uniforms[n] = np.int64(w0 | 0x4330000000000000).view(np.float64)
        uniforms[BLOCKS + n] = np.int64(w1 | 0x4330000000000000).view(np.float64)
        uniforms[PAIRS + n] = np.int64(w2 | 0x4330000000000000).view(np.float64)
        uniforms[PAIRS + BLOCKS + n] = np.int64(w3 | 0x4330000000000000).view(np.float64)
    for n in range(PAIRS):
        u = ((uniforms[n] - 2.0**52) + 0.5) * 2.0**-32
        uniforms[n] = math.sqrt(-2.0 * log(u))
    for n in range(PAIRS):
        angle = ((uniforms[PAIRS + n] - 2.0**52) + 0.5) * (2.0**-31 * math.pi)
        out[n] = uniforms[n] * cos(angle)
        out[PAIRS + n] = uniforms[n] * sin(angle)


@compiled
def drift(state: NDArray[np.float64], head: NDArray[np.float64], seed: int, tick: int) -> None:
    """Random walk of the biases DRIFT_X and DRIFT_Y; state and head as one row each, see `at`."""
    for i in range(WHISKERS):
        walk_x, walk_y, _, _ = philox_normals4(seed, DRIFT_STREAM + i, tick)
        state[at(DRIFT_X, i)] += head[at(DRIFT_STEP, i)] * walk_x
        state[at(DRIFT_Y, i)] += head[at(DRIFT_STEP, i)] * walk_y


@compiled
def measured(moment: float, full_scale: float, counts: float, resolution: float) -> float:
    """A base moment as the sensor reports it, N m: rounded to counts and clipped.

    counts per N m, and resolution in N m per count, are inverse; both 0 for a sensor without.
    """
    whole = np.floor(moment * counts + 0.5) * resolution
    moment = whole if counts > 0.0 else moment
    return min(max(moment, -full_scale), full_scale)
