"""A small world for the sequence SLAM: a track whose places feel different, driven in laps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrissa.slam.interface import Odometry
from vibrissa.slam.sequence import SequenceSlam
from vibrissa.slam.sequence_config import SequenceConfig
from vibrissa.slam.sequence_table import turned

PLACES = 160
STEP = 0.01
BITS = np.arange(18)


@dataclass
class World:
    """masks int64[n], motion float64[n, 2] (m, rad, as measured), truth float64[n, 3], place
    int64[n], odometer sigmas used."""

    masks: NDArray[np.int64]
    motion: NDArray[np.float64]
    truth: NDArray[np.float64]
    place: NDArray[np.int64]


def make_world(
    seed: int, laps: str = "CCC", distance_noise: float = 0.002, turn_noise: float = 0.02
) -> World:
    """Laps of a circular track, C one way round and A the other, with a turn on the spot between
    laps of different direction. Masks change every few places and are felt with some flips."""
    rng = np.random.default_rng(seed)
    walls = np.repeat(rng.integers(0, 1 << 18, PLACES), rng.integers(2, 7, PLACES))[:PLACES]
    radius = PLACES * STEP / (2.0 * np.pi)
    place, heading, turns, distances = [], [], [], []
    at = 0
    for k, lap in enumerate(laps):
        way = 1 if lap == "C" else -1
        if k and lap != laps[k - 1]:
            for _ in range(6):
                place.append(at % PLACES)
                turns.append(np.pi / 6.0)
                distances.append(0.0)
                heading.append(heading[-1] + np.pi / 6.0)
        for _ in range(PLACES):
            at += way
            place.append(at % PLACES)
            turns.append(way * 2.0 * np.pi / PLACES)
            distances.append(STEP)
            angle = 2.0 * np.pi * at / PLACES
            heading.append(angle + way * np.pi / 2.0)
    where = np.array(place)
    angle = 2.0 * np.pi * where / PLACES
    facing = np.array(heading)
    truth = np.stack([radius * np.cos(angle), radius * np.sin(angle), facing], axis=1)
    masks = np.empty(len(where), dtype=np.int64)
    for i, p in enumerate(where):
        felt = int(walls[p])
        forwards = np.cos(facing[i] - (angle[i] + np.pi / 2.0)) > 0.0
        felt = felt if forwards else turned(felt)
        flips = int((1 << BITS)[rng.random(18) < 0.02].sum())
        masks[i] = felt ^ flips
    motion = np.stack([distances, turns], axis=1)
    motion += rng.normal(size=motion.shape) * [distance_noise, turn_noise]
    return World(masks, motion, truth, where)


def image_of(mask: int) -> NDArray[np.uint8]:
    """The mask as an image uint8[3, 6]."""
    return (((int(mask) >> BITS) & 1) * 200).astype(np.uint8).reshape(3, 6)


def drive(world: World, config: SequenceConfig) -> tuple[SequenceSlam, NDArray[np.float64]]:
    """A SLAM that went through the world, and the poses float64[n, 3] it said on the way."""
    slam = SequenceSlam(config)
    poses = np.empty((len(world.masks), 3))
    for k, (mask, (distance, turn)) in enumerate(zip(world.masks, world.motion, strict=True)):
        step = slam.step(image_of(mask), Odometry(distance, turn, 1.0))
        poses[k] = step.x, step.y, step.heading
    return slam, poses
