"""A stretch of the simulated head as one digest: run in other environments by test_same_bits.

The argument may be `skip` or `everything` (no skipping), or `libm`, which whisks by the C library's
cosine in a compiled loop, whose bits depend on the processor: what the check must catch.
"""

import hashlib
import math
import sys

import numba
import numpy as np

from vibrissa.rig.maze import load_maze
from vibrissa.rig.plant import HeadPlant
from vibrissa.rig.scene import wall_boxes


@numba.njit
def libm_share(tick: int) -> float:
    return 0.5 - 0.5 * math.cos(2 * math.pi * tick / 1000)


def own_share(tick: int) -> float:
    phase = tick % 1000 / 500 - 1
    return 1 - phase * phase


def digest(how: str) -> str:
    plant = HeadPlant(wall_boxes(load_maze("board7x5")), 5, skip=how != "everything")
    share = libm_share if how == "libm" else own_share
    found = hashlib.sha256()
    for tick in range(2500):
        s = tick / 2000
        pose = (0.09 + 0.05 * s, 0.09 + 0.01 * s * s, 0.077, 0.2 * s)
        command = (share(tick) * plant.params.geometry.swing).astype(np.float32)
        for values in plant.step(tick, pose, command):
            found.update(values.tobytes())
        if how == "libm":
            found.update(np.float64(share(tick)).tobytes())
    found.update(plant.state.tobytes() + plant.model.beam.tobytes())
    return found.hexdigest()


if __name__ == "__main__":
    print(digest(sys.argv[1]))
