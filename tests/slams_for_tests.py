"""SLAMs for tests of how a run loads, compares and swaps them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.slam.config import WHISKER
from vibrissa.slam.interface import Odometry, SlamStep
from vibrissa.slam.ratslam import RatSlam


class Twin(RatSlam):
    """RatSLAM with the parameters of the default experiment."""

    def __init__(self) -> None:
        super().__init__(WHISKER)


class Fragile(Twin):
    """Raises an error in its sixth cycle."""

    def __init__(self) -> None:
        super().__init__()
        self._cycles = 0

    def step(self, image: NDArray[np.uint8], odometry: Odometry) -> SlamStep:
        self._cycles += 1
        if self._cycles == 6:
            raise ValueError("lost")
        return super().step(image, odometry)
