"""A short made-up run of the sequence SLAM, after which nothing of it is left to compile."""

from __future__ import annotations

from typing import Final

import numpy as np

from vibrissa.numerics import philox_uniform
from vibrissa.slam.compass import HeadShape
from vibrissa.slam.interface import Odometry
from vibrissa.slam.sequence import SequenceSlam
from vibrissa.slam.sequence_config import BATCH, SequenceConfig
from vibrissa.slam.sequence_table import PER_RING, RINGS, WHISKERS

PLACES: Final = 60
LAPS: Final = 4
STREAM: Final = 0x736C616D
TOUCHED: Final = 0.4
"""Share of whiskers in contact."""


def rehearse() -> int:
    """Drive laps of a track whose places feel different, online and in batch; loops it found."""
    found = 0
    shape = HeadShape(*np.ones((4, WHISKERS)))
    for lag in (BATCH, 20):
        slam = SequenceSlam(SequenceConfig(lag=lag, memory=96, compass=lag != BATCH), shape)
        for whisk in range(LAPS * PLACES):
            first = WHISKERS * (whisk % PLACES // 3)
            draws = [philox_uniform(0, STREAM, first + k) for k in range(WHISKERS)]
            image = np.array(draws) < TOUCHED
            slam.step(image.astype(np.uint8).reshape(RINGS, PER_RING), Odometry(0.01, 0.1, 1.0))
        found += len(slam.map().links) - (LAPS * PLACES - 1)
    return found
