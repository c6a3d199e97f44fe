"""The sequence SLAM in a small world: what it finds, what it leaves alone, and that it is exact."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.slam.sequence_world import PLACES, STEP, World, drive, image_of, make_world
from vibrissa.numerics import cos, sin
from vibrissa.slam.angles import wrap_pi
from vibrissa.slam.config import ConfigError
from vibrissa.slam.graph_start import reckon
from vibrissa.slam.interface import Odometry, SlamInputError
from vibrissa.slam.metrics import energy_metric, fixed_interval
from vibrissa.slam.odometer import OdometerNoise
from vibrissa.slam.sequence import SequenceSlam
from vibrissa.slam.sequence_config import BATCH, SequenceConfig
from vibrissa.slam.sequence_table import count_newest, empty_counts, score, turned, weights

ODOMETER = OdometerNoise(0.002, 0.0, 0.02, 0.0)
LAGS = (BATCH, 0, 10, 100)


def config(**changes: object) -> SequenceConfig:
    return SequenceConfig(**{"odometer": ODOMETER, **changes})


def reckoned(world: World) -> np.ndarray:
    pose, poses = np.zeros(3), []
    for distance, turn in world.motion:
        reckon(pose, distance, turn)
        poses.append((pose[0], pose[1], wrap_pi(pose[2])))
    return np.array(poses)


def energies(poses: np.ndarray, world: World) -> np.ndarray:
    n = len(poses)
    far = np.random.default_rng(0).integers(0, n, (4000, 2)).astype(np.int32)
    sets = (fixed_interval(n, 1), fixed_interval(n, 20), far)
    return np.array([energy_metric(poses, world.truth, pairs).total for pairs in sets])


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize("laps", ["CCCC", "CCAA"])
def test_in_a_world_that_can_be_felt_the_map_beats_the_odometry(lag: int, laps: str) -> None:
    world = make_world(1, laps)
    slam, _ = drive(world, config(lag=lag))
    found = slam.map()
    loops = found.links[len(world.masks) - 1 :]
    assert len(loops) > 50
    away = np.abs(world.place[loops[:, 0]] - world.place[loops[:, 1]])
    assert (np.minimum(away, PLACES - away) <= 5).mean() > 0.98
    ratio = energies(found.poses, world) / energies(reckoned(world), world)
    assert ratio[2] < 0.5
    assert (ratio < 1.0).all()


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize("felt", [0, (1 << 18) - 1, 0b000001_000011_000001])
def test_blind_or_the_same_everywhere_it_is_the_odometry_to_the_bit(lag: int, felt: int) -> None:
    world = make_world(2, "CCA")
    world.masks[:] = felt
    slam, said = drive(world, config(lag=lag))
    assert np.array_equal(slam.map().poses, reckoned(world))
    assert np.array_equal(said, reckoned(world))
    assert len(slam.loops) == 0


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize("seed", [3, 4])
def test_shuffled_whisks_close_no_loop(lag: int, seed: int) -> None:
    world = make_world(seed, "CCC")
    world.masks[:] = np.random.default_rng(seed).permutation(world.masks)
    slam, _ = drive(world, config(lag=lag))
    assert np.array_equal(slam.map().poses, reckoned(world))


def test_dead_reckoning_is_written_out_here_once_more() -> None:
    world = make_world(5, "C")
    x = y = heading = 0.0
    for (distance, turn), pose in zip(world.motion, reckoned(world), strict=True):
        heading += turn
        x, y = x + distance * cos(heading), y + distance * sin(heading)
        assert pose.tolist() == [x, y, wrap_pi(heading)]


def test_a_run_and_the_same_run_felt_the_other_way_round_find_the_same_loops() -> None:
    world = make_world(6, "CCA")
    mirrored = make_world(6, "CCA")
    mirrored.masks[:] = [turned(int(mask)) for mask in world.masks]
    for lag in (BATCH, 20):
        loops = [drive(w, config(lag=lag))[0].map().links for w in (world, mirrored)]
        assert np.array_equal(*loops)


def test_the_past_alone_gives_the_forward_probabilities_of_a_plain_chain() -> None:
    world = make_world(7, "CC", distance_noise=0.0)
    settings = config(lag=0)
    slam = SequenceSlam(settings)
    counts = empty_counts()
    before, fresh = np.zeros((2, 0)), 1.0
    stay, one, two = settings.advance
    for t, mask in enumerate(world.masks[:250]):
        slam.step(image_of(mask), Odometry(0.01, 0.0, 1.0))
        count_newest(counts, world.masks, t)
        now = max(t - settings.gap + 1, 0)
        known = before.shape[1]
        arrived = np.zeros((2, now + 4))
        for j in range(known):
            for ahead, chance in enumerate((stay, one, two)):
                if j + ahead < now:
                    arrived[0, j + ahead] += chance * before[0, j]
                if j - ahead >= 0:
                    arrived[1, j - ahead] += chance * before[1, j]
        after = (1.0 - settings.leave) * arrived[:, :now]
        if now:
            after += settings.enter * fresh / (2 * now)
        rest = 1.0 - after.sum()
        table = weights(counts)
        for j in range(now):
            other = int(world.masks[j])
            after[0, j] *= math.exp(settings.evidence * score(table, int(mask), other))
            after[1, j] *= math.exp(settings.evidence * score(table, turned(int(mask)), other))
        total = after.sum() + rest
        before, fresh = after / total, rest / total
        assert slam._belief.known == pytest.approx(before, rel=1e-9, abs=1e-15)


def test_the_same_run_gives_the_same_bytes_and_asking_for_the_map_changes_nothing() -> None:
    world = make_world(8, "CCA")
    one, said = drive(world, config(lag=30))
    other = SequenceSlam(config(lag=30))
    for k, (mask, (distance, turn)) in enumerate(zip(world.masks, world.motion, strict=True)):
        step = other.step(image_of(mask), Odometry(distance, turn, 1.0))
        assert (step.x, step.y, step.heading) == tuple(said[k].tolist())
        if k % 100 == 0:
            other.map()
    for name in ("poses", "links", "templates"):
        assert getattr(one.map(), name).tobytes() == getattr(other.map(), name).tobytes()


def test_a_small_memory_is_kept_and_still_closes_loops_that_are_right() -> None:
    world = make_world(9, "CCCCCCAA")
    slam, _ = drive(world, config(lag=30, memory=400))
    whole, _ = drive(world, config(lag=30))
    assert slam._memory.remembered <= 400 < whole._memory.remembered
    for found in (slam, whole):
        loops = found.loops
        away = np.abs(world.place[loops[:, 0]] - world.place[loops[:, 1]])
        assert (np.minimum(away, PLACES - away) <= 5).mean() > 0.98
    recognised = [len(np.unique(found.loops[:, 0])) for found in (slam, whole)]
    assert recognised[0] > 0.7 * recognised[1]


def test_a_small_memory_without_evidence_forgets_and_stays_the_odometry() -> None:
    world = make_world(10, "CCCCC")
    world.masks[:] = 1 << 7
    slam, said = drive(world, config(lag=20, memory=100))
    assert np.array_equal(said, reckoned(world))
    assert slam._memory.remembered <= 100


@pytest.mark.parametrize("factor", [0.1, 10.0])
@pytest.mark.parametrize("lag", [BATCH, 100])
def test_an_odometer_believed_ten_times_too_much_or_too_little_does_not_harm(
    factor: float, lag: int
) -> None:
    odometer = OdometerNoise(0.002 * factor, 0.0, 0.02 * factor, 0.0)
    for seed in (11, 12, 13):
        world = make_world(seed, "CCCC")
        slam, _ = drive(world, config(lag=lag, odometer=odometer))
        ratio = energies(slam.map().poses, world) / energies(reckoned(world), world)
        assert (ratio < 1.05).all()


def test_the_first_whisks_and_an_empty_run() -> None:
    for lag in LAGS:
        slam = SequenceSlam(config(lag=lag))
        assert slam.map().poses.shape == (0, 3)
        assert slam.map().links.shape == (0, 2)
        first = slam.step(image_of(5), Odometry(0.5, 0.25, 1.0))
        assert (first.experience, first.template, first.new_template) == (0, 0, True)
        assert first.match_error == math.inf
        assert slam.map().poses.tolist() == [[first.x, first.y, first.heading]]
        again = slam.step(image_of(5), Odometry(0.5, 0.25, 1.0))
        assert (again.experience, again.template, again.new_template) == (1, 0, False)
        assert slam.map().links.tolist() == [[0, 1]]


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((3, 6), np.int64), "image: expected an array of uint8, found int64"),
        ([[0]], "image: expected an array of uint8, found list"),
        (np.zeros((6, 3), np.uint8), r"image: expected shape \(3, 6\), found \(6, 3\)"),
        (np.zeros((3, 6, 3), np.uint8), r"image: expected shape \(3, 6\)"),
    ],
)
def test_bad_images_are_refused_before_anything_changes(image: np.ndarray, message: str) -> None:
    slam = SequenceSlam(config())
    slam.step(image_of(1), Odometry(0.01, 0.0, 1.0))
    before = slam.map()
    with pytest.raises(SlamInputError, match=message):
        slam.step(image, Odometry(0.01, 0.0, 1.0))
    assert np.array_equal(slam.map().poses, before.poses)


@pytest.mark.parametrize("motion", [(2e3, 0.0, 1.0), (0.0, -1.1e3, 1.0), (1e300, 0.0, 1e300)])
def test_impossible_steps_are_refused_before_anything_changes(motion: tuple[float, ...]) -> None:
    slam = SequenceSlam(config())
    with pytest.raises(SlamInputError, match=r"odometry (distance|turn): expected at most 1000"):
        slam.step(image_of(1), Odometry(*motion))
    assert len(slam.map().poses) == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lag": -2}, "lag: expected -1 to 10000, found -2"),
        ({"lag": 1.5}, "lag: expected int, found 1.5"),
        ({"gap": 1}, "gap: expected 2 to"),
        ({"evidence": float("nan")}, "evidence: expected 0 to 10, found nan"),
        ({"certain": 0.5}, "certain: expected 0.51 to 1"),
        ({"stay": 0.6, "skip": 0.5}, "stay and skip: expected a sum below 1"),
        ({"memory": True}, "memory: expected int, found True"),
        ({"odometer": 3}, "odometer: expected OdometerNoise, found 3"),
    ],
)
def test_impossible_parameters_are_refused_by_name(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        config(**changes)


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize("period", [6, 18, 45])
def test_in_a_corridor_for_ever_whose_walls_repeat_it_is_no_worse_than_the_odometry(
    lag: int, period: int
) -> None:
    """Posts at equal distances feel the same; nothing is ever met again."""
    rng = np.random.default_rng(period)
    n = 1200
    walls = np.repeat(rng.integers(0, 1 << 18, period), 3)[:period]
    flips = (rng.random((n, 18)) < 0.02) @ (1 << np.arange(18))
    masks = np.resize(walls, n) ^ flips
    motion = np.tile([STEP, 0.0], (n, 1))
    truth = np.cumsum(np.hstack([motion, np.zeros((n, 1))]), axis=0)
    motion = motion + rng.normal(size=motion.shape) * [0.002, 0.02]
    world = World(masks, motion, truth, np.arange(n))
    slam, _ = drive(world, config(lag=lag))
    ratio = energies(slam.map().poses, world) / energies(reckoned(world), world)
    assert (ratio < 1.05).all()
