"""A stretch of the simulated head as one digest: run in other environments by test_same_bits.

The argument may be `skip` or `everything` (no skipping). What the check must catch: `libm` is a
compiled loop over the C library's functions, whose bits depend on the processor, and `fused` one
in which a multiplication and an addition may be contracted.
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
def libm(x: float) -> float:
    return math.log(math.sin(937.0 * x) + 1.1) + math.exp(-40.0 * x)


@numba.njit(fastmath={"contract"})
def fused(x: float) -> float:
    return (0.3 * x + 0.7) * x + 1.1


def share(tick: int) -> float:
    phase = tick % 1000 / 500 - 1
    return 1 - phase * phase


def digest(how: str) -> str:
    if how in ("libm", "fused"):
        values = [libm(k / 2000) if how == "libm" else fused(k / 2000) for k in range(2500)]
        return hashlib.sha256(np.array(values).tobytes()).hexdigest()
    plant = HeadPlant(wall_boxes(load_maze("board7x5")), 5, skip=how != "everything")
    found = hashlib.sha256()
    for tick in range(2500):
        s = tick / 2000
        pose = (0.09 + 0.05 * s, 0.09 + 0.01 * s * s, 0.077, 0.2 * s)
        command = (share(tick) * plant.params.geometry.swing).astype(np.float32)
        for values in plant.step(tick, pose, command):
            found.update(values.tobytes())
    found.update(plant.state.tobytes() + plant.model.beam.tobytes())
    return found.hexdigest()


if __name__ == "__main__":
    print(digest(sys.argv[1]))
