"""An odometer that is better than believed is found out from stretches that were driven twice."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from tests.slam.sequence_world import PLACES, STEP, World, drive, make_world
from tests.slam.test_sequence import energies, reckoned
from vibrissa.slam import sequence_trust
from vibrissa.slam.odometer import OdometerNoise
from vibrissa.slam.sequence_config import BATCH, SequenceConfig
from vibrissa.slam.sequence_rehearsal import rehearse
from vibrissa.slam.sequence_trust import LEAST_STRETCHES, Trust

LAP = 160
SIGMA = np.array([0.002, 0.02])


def laps(seed: int, ways: str, believed: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loops of every whisk to the first lap, their facing, and what odometry says was travelled."""
    rng = np.random.default_rng(seed)
    place = np.concatenate([np.arange(LAP) if way == "C" else np.arange(LAP)[::-1] for way in ways])
    sign = np.repeat([1 if way == "C" else -1 for way in ways], LAP)
    loops = np.stack([np.arange(len(place)), place], axis=1)[LAP:]
    facing = (sign[LAP:] < 0).astype(np.int8)
    steps = np.stack([np.full(len(place), 0.01), 0.05 * sign], axis=1)
    steps += rng.normal(size=steps.shape) * SIGMA
    variances = np.tile(np.square(believed * SIGMA), (len(place), 1))
    return loops, facing, np.cumsum(np.hstack([steps, variances]), axis=0)


@pytest.mark.parametrize("ways", ["C" * 9, "C" + "A" * 8])
def test_the_variance_factors_of_stretches_driven_twice(ways: str) -> None:
    found = []
    for seed in range(100):
        trust = Trust()
        trust.look_at(*laps(seed, ways, 1.0))
        assert (trust.factors == 1.0).all()
        found.append(trust.sums / trust.anchor[3])
    assert np.mean(found, axis=0) == pytest.approx([1.0, 1.0], abs=0.15)


@pytest.mark.parametrize("believed", [4.0, 10.0])
def test_an_odometer_that_is_believed_too_little_is_believed_more(believed: float) -> None:
    for seed in range(5):
        trust = Trust()
        trust.look_at(*laps(seed, "C" * 9, believed))
        assert (trust.factors * believed > 0.5).all() and (trust.factors * believed < 2.0).all()


def test_few_stretches_prove_nothing_and_being_too_sure_is_not_touched() -> None:
    trust = Trust()
    trust.look_at(*laps(1, "CCC", 10.0))
    assert trust.anchor[3] < LEAST_STRETCHES and (trust.factors == 1.0).all()
    trust = Trust()
    trust.look_at(*laps(1, "C" * 9, 0.1))
    assert (trust.factors == 1.0).all()


def test_loops_looked_at_bit_by_bit_are_the_same_as_at_once() -> None:
    loops, facing, travelled = laps(2, "CCACACC", 10.0)
    whole, parts = Trust(), Trust()
    whole.look_at(loops, facing, travelled)
    for end in range(7, len(loops) + 7, 7):
        parts.look_at(loops[:end], facing[:end], travelled)
    assert parts.sums.tobytes() == whole.sums.tobytes()
    assert parts.anchor.tobytes() == whole.anchor.tobytes()


def test_stretches_that_overlap_do_not_count() -> None:
    """Their common steps would agree with themselves."""
    n = 2000
    loops = np.stack([np.arange(40, n), np.arange(n - 40)], axis=1)
    travelled = np.cumsum(np.tile([0.01, 0.0, 1e-6, 1e-4], (n, 1)), axis=0)
    trust = Trust()
    trust.look_at(loops, np.zeros(n - 40, np.int8), travelled)
    assert trust.anchor[3] == 0


@pytest.mark.parametrize("lag", [BATCH, 100])
@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_wrong_calibration_does_not_harm_a_map_whose_odometer_errs_in_time(
    lag: int, factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = timed(13)
    odometer = OdometerNoise(0.0002 * factor, 0.2 * factor, 0.002 * factor, 0.2 * factor)
    config = SequenceConfig(lag=lag, odometer=odometer)
    checked = drive(world, config)[0].map().poses
    assert (energies(checked, world) < 1.05 * energies(reckoned(world), world)).all()
    if factor > 1.0:
        monkeypatch.setattr(sequence_trust, "LEAST_STRETCHES", 10**9)
        unchecked = drive(world, config)[0].map().poses
        assert (energies(checked, world) < energies(unchecked, world)).all()


def timed(seed: int) -> World:
    """A square track, straights and corners, where distance and turn of a step err by the same
    share, as they do when its time is not known well."""
    world = make_world(seed, "CCCCCCC")
    world.motion[:] = STEP, 0.0
    world.motion[PLACES // 8 :: PLACES // 4, 1] = np.pi / 2.0
    world.truth[:] = reckoned(world)
    world.motion *= 1.0 + 0.2 * np.random.default_rng(seed).normal(size=(len(world.motion), 1))
    return world


def test_a_rehearsal_finds_loops_and_leaves_nothing_to_compile() -> None:
    world = make_world(1, "CCA")
    assert rehearse() > 50
    before = compiled()
    for lag in (BATCH, 0, 100):
        slam, _ = drive(world, SequenceConfig(lag=lag, memory=200))
        slam.map()
    assert compiled() == before


def compiled() -> dict[str, int]:
    """How many machine codes the SLAM's kernels have."""
    modules = [module for name, module in sys.modules.items() if name.startswith("vibrissa.slam")]
    kernels = {id(f): f for module in modules for f in vars(module).values()}
    return {f.__qualname__: len(f.signatures) for f in kernels.values() if hasattr(f, "signatures")}
