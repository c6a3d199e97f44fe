"""Open loop, RCP and retract: what the laws promise, alone and in a loop with a contact."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vibrissa.control.calibration import Calibration
from vibrissa.control.controller import Controller, LawController, SignalShapeError
from vibrissa.control.kinematics import PER_RING, WHISKERS, paper_head
from vibrissa.control.open_loop import OpenLoop, open_loop_block
from vibrissa.control.rcp import (
    CONTACT_STIFFNESS,
    Rcp,
    RcpParameterError,
    RcpParams,
    ResetRule,
    normalised_gain,
    rcp_block,
)
from vibrissa.control.retract import Retract, retract_block
from vibrissa.control.whisk_pattern import WhiskParameterError, WhiskParams, full_whisk

Signals = NDArray[np.float32]

HEAD = paper_head()
PERIOD = 200  # short cycles keep the tests short; the laws scale with the period
WHISK = WhiskParams(np.full(WHISKERS, 0.02), HEAD.swing * 0.9, PERIOD, slew_limit=0.02)
QUIET = np.zeros(WHISKERS, dtype=np.float32)
MU, THRESHOLD = -5e-5, 2e-4
ULP = 6e-8  # half a float32 step below 1 rad


def calibration() -> Calibration:
    return Calibration(
        mean_y=np.full(WHISKERS, MU),
        sigma_y=np.full(WHISKERS, THRESHOLD / 20),
        threshold_y=np.full(WHISKERS, THRESHOLD),
        mean_dy=np.zeros(WHISKERS),
        threshold_dy=np.full(WHISKERS, 1e-5),
        samples=24000,
    )


def rcp(
    reset: ResetRule = "cycle", window: int = 16, gain: float = 3.0, whisk: WhiskParams = WHISK
) -> Rcp:
    params = RcpParams(whisk, normalised_gain(gain), window_ticks=window, reset=reset)
    controller = Rcp(params)
    controller.calibrate(calibration())
    controller.activate(0, WHISK.minimum.astype(np.float32), QUIET)
    return controller


def open_loop() -> OpenLoop:
    controller = OpenLoop(WHISK)
    controller.activate(0, WHISK.minimum.astype(np.float32), QUIET)
    return controller


def run(controller: Controller, y: Signals, first_tick: int = 0) -> Signals:
    return np.array([controller.step(first_tick + j, QUIET, QUIET, y[j]) for j in range(len(y))])


def silence(ticks: int) -> Signals:
    return np.full((ticks, WHISKERS), MU, dtype=np.float32)


def noise(ticks: int, seed: int, scale: float = 1e-3) -> Signals:
    return np.random.default_rng(seed).normal(0, scale, (ticks, WHISKERS)).astype(np.float32)


# open loop


def test_open_loop_follows_the_raised_cosine_whatever_is_felt() -> None:
    tick = np.arange(3 * PERIOD)[:, None]
    cycle = (1 - np.cos(2 * math.pi * (tick % PERIOD) / PERIOD)) / 2
    expected = WHISK.minimum + WHISK.amplitude * cycle
    assert np.abs(run(open_loop(), noise(3 * PERIOD, 0)) - expected).max() < 1e-7


def test_full_whisk_spans_the_whole_travel_and_stays_in_it() -> None:
    controller = OpenLoop(full_whisk(HEAD, PERIOD, 0.02))
    commands = run(controller, silence(PERIOD))
    assert commands.min() == 0.0
    assert np.array_equal(commands.max(axis=0), HEAD.swing.astype(np.float32))


# RCP


@given(share=st.floats(-1, 1), first=st.integers(0, 10**9))
@settings(max_examples=25, deadline=None)
def test_rcp_is_open_loop_while_no_reading_exceeds_the_threshold(share: float, first: int) -> None:
    y = np.full((PERIOD, WHISKERS), MU + 0.999 * share * THRESHOLD, dtype=np.float32)
    assert run(rcp(), y, first).tobytes() == run(open_loop(), y, first).tobytes()


@given(
    whisker=st.integers(0, WHISKERS - 1),
    moment=st.floats(5e-4, 1e-2),
    side=st.sampled_from([-1, 1]),
    onset=st.integers(20, 150),
)
@settings(max_examples=25, deadline=None)
def test_rcp_reduces_the_amplitude_of_the_touched_whisker_alone_and_from_the_touch_on(
    whisker: int, moment: float, side: int, onset: int
) -> None:
    y = silence(PERIOD)
    y[onset:, whisker] += np.float32(side * moment)
    free, felt = run(open_loop(), silence(PERIOD)), run(rcp(), y)
    others = np.arange(WHISKERS) != whisker
    assert felt[:, others].tobytes() == free[:, others].tobytes()
    assert felt[:onset].tobytes() == free[:onset].tobytes()
    assert (felt[onset : PERIOD - 1, whisker] < free[onset : PERIOD - 1, whisker]).all()
    assert (felt >= WHISK.minimum.astype(np.float32)).all()


def test_rcp_is_the_published_equation() -> None:
    """Against a direct evaluation: mean of the last 16 excesses since the cycle's start."""
    window, ticks = 16, 3 * PERIOD
    gain = np.repeat(np.array(normalised_gain(0.3)), PER_RING)
    y = noise(ticks, 1)
    excess = np.maximum(0.0, np.abs(y.astype(np.float64) - MU) - THRESHOLD)
    expected = np.empty((ticks, WHISKERS))
    for t in range(ticks):
        since = max(t - window + 1, t - t % PERIOD)
        amplitude = WHISK.amplitude - gain * excess[since : t + 1].sum(axis=0) / window
        share = (1 - math.cos(2 * math.pi * (t % PERIOD) / PERIOD)) / 2
        expected[t] = WHISK.minimum + np.clip(amplitude, 0.0, WHISK.amplitude) * share
    free = run(open_loop(), y)
    unhurried = WhiskParams(WHISK.minimum, WHISK.amplitude, PERIOD, slew_limit=10.0)
    found = run(rcp(window=window, gain=0.3, whisk=unhurried), y)
    assert np.abs(found - expected).max() < 2e-7
    assert np.abs(found - free).max() > 0.05  # the touches did matter


def test_rcp_rearms_at_each_cycle_start() -> None:
    y = silence(2 * PERIOD)
    y[50:PERIOD] += np.float32(5e-3)  # felt until the last tick of the first cycle
    free, felt = run(open_loop(), y), run(rcp(window=100), y)
    assert (felt[100] < free[100] - 0.05).all()
    assert felt[PERIOD:].tobytes() == free[PERIOD:].tobytes()


def test_without_reset_the_window_slides_over_the_cycle_start() -> None:
    y = silence(2 * PERIOD)
    y[PERIOD - 60 : PERIOD] += np.float32(5e-3)
    free, felt = run(open_loop(), y), run(rcp("never", window=100), y)
    assert (felt[PERIOD + 20 : PERIOD + 90] < free[PERIOD + 20 : PERIOD + 90]).all()
    assert np.abs(felt[PERIOD + 160 :] - free[PERIOD + 160 :]).max() <= 2 * ULP


def test_a_violent_touch_leaves_no_rounding_behind() -> None:
    """The running sum of the window is renewed: 1e9 N m is gone once it has left the window."""
    y = silence(2 * PERIOD)
    y[20:60] += noise(40, 3, scale=1e9)
    free, felt = run(open_loop(), y), run(rcp("never"), y)
    assert np.abs(felt[PERIOD:] - free[PERIOD:]).max() <= 2 * ULP


def test_the_latch_holds_the_smallest_amplitude_until_the_next_cycle() -> None:
    y = silence(2 * PERIOD)
    y[50:60] += np.float32(1e-3)
    share = (1 - np.cos(2 * math.pi * (np.arange(PERIOD) / PERIOD))) / 2
    free, felt = run(open_loop(), y), run(rcp("latch"), y)
    inner = slice(40, PERIOD - 40)
    amplitude = (felt[:PERIOD] - WHISK.minimum)[inner] / share[inner, None]
    assert (np.diff(amplitude, axis=0) <= 1e-6).all()
    assert (amplitude[-1] < WHISK.amplitude - 0.01).all()
    assert felt[PERIOD:].tobytes() == free[PERIOD:].tobytes()


def test_amplitude_never_falls_below_its_minimum() -> None:
    params = RcpParams(WHISK, amplitude_minimum=0.1)
    controller = Rcp(params)
    controller.calibrate(calibration())
    commands = run(controller, silence(PERIOD) + np.float32(0.1))
    assert commands[PERIOD // 2] == pytest.approx(WHISK.minimum + 0.1, abs=1e-6)


def test_an_uncalibrated_rcp_whisks_in_open_loop_and_says_so() -> None:
    controller = Rcp(RcpParams(WHISK))
    controller.activate(0, WHISK.minimum.astype(np.float32), QUIET)
    y = noise(PERIOD, 2, scale=1.0)
    assert controller.needs_calibration
    assert run(controller, y).tobytes() == run(open_loop(), y).tobytes()
    controller.calibrate(calibration())
    assert not controller.needs_calibration
    assert run(controller, y).tobytes() != run(open_loop(), y).tobytes()


def test_a_reading_that_is_not_finite_counts_as_no_touch() -> None:
    y = silence(PERIOD)
    y[50:80, 3], y[50:80, 9], y[50:80, 15] = np.nan, np.inf, -np.inf
    assert run(rcp(), y).tobytes() == run(open_loop(), y).tobytes()


def test_a_lost_cycle_start_does_not_lose_the_reset() -> None:
    controller, free = rcp(window=100), open_loop()
    y = silence(2 * PERIOD)
    y[50:PERIOD] += np.float32(5e-3)
    ticks = [t for t in range(2 * PERIOD) if not PERIOD <= t < PERIOD + 5]
    felt = np.array([controller.step(t, QUIET, QUIET, y[t]) for t in ticks])
    expected = np.array([free.step(t, QUIET, QUIET, y[t]) for t in ticks])
    assert felt[PERIOD:].tobytes() == expected[PERIOD:].tobytes()


@pytest.mark.parametrize("stiffening", [1.0, 2.2])
def test_rcp_ceases_protraction_without_chatter(stiffening: float) -> None:
    """Default RCP on a 10 Hz motor and a contact at 30 % of the travel; 2.2: touched half-way."""
    whisk = full_whisk(HEAD)
    stiffness = np.repeat(np.array(CONTACT_STIFFNESS), PER_RING) * stiffening
    contact = 0.3 * HEAD.swing

    def impingement(controller: Controller) -> NDArray[np.float64]:
        controller.activate(0, QUIET, QUIET)
        theta, speed = np.zeros(WHISKERS), np.zeros(WHISKERS)
        depth = np.zeros((2000, WHISKERS))
        omega, tick = 2 * math.pi * 10.0, 5e-4
        for t in range(2000):
            depth[t] = np.maximum(0.0, theta - contact)
            y = (MU + stiffness * depth[t]).astype(np.float32)
            command = controller.step(t, theta.astype(np.float32), QUIET, y)
            speed += (omega * omega * (command - theta) - 2 * omega * speed) * tick
            theta += speed * tick
        return depth

    controller = Rcp(RcpParams(whisk))
    controller.calibrate(calibration())
    pushed, ceased = impingement(OpenLoop(whisk)), impingement(controller)
    assert np.allclose(pushed.max(axis=0), 0.7 * HEAD.swing, rtol=0.01)
    assert (ceased.max(axis=0) < 0.45 * pushed.max(axis=0)).all()
    assert (ceased.max(axis=0) > 0.0).all()
    held = np.diff(ceased[700:1300], axis=0)  # the middle of the contact, rad per tick
    assert np.abs(held).max() < 1e-3


@pytest.mark.parametrize(
    ("ring", "length", "base", "tip"),
    [(0, 0.050, 0.8e-3, 0.3e-3), (1, 0.110, 1.3e-3, 0.4e-3), (2, 0.160, 1.6e-3, 0.4e-3)],
)
def test_contact_stiffness_is_that_of_a_tapered_cantilever(
    ring: int, length: float, base: float, tip: float
) -> None:
    """Deflection at d under F is F * integral (d - s)^2 / (E I(s)) ds; M0 = F d, angle = w / d."""
    d, n = 0.75 * length, 20000
    s = (np.arange(n) + 0.5) * d / n
    bending = 3e9 * math.pi / 64 * (base + (tip - base) * s / length) ** 4
    compliance = float(((d - s) ** 2 / bending).sum() * d / n)
    assert CONTACT_STIFFNESS[ring] == pytest.approx(d * d / compliance, rel=0.02)


# all laws

CONTROLLERS = {
    "open loop": (open_loop, open_loop_block),
    "rcp": (rcp, rcp_block),
    "rcp latch": (lambda: rcp("latch", 7), rcp_block),
    "retract": (lambda: Retract(0.003), retract_block),
}


@pytest.mark.parametrize("name", CONTROLLERS)
@given(
    first=st.integers(0, 10**7),
    cuts=st.lists(st.integers(1, 299), max_size=4),
    start=st.floats(0, 0.3),
    seed=st.integers(0, 10),
)
@settings(max_examples=15, deadline=None)
def test_ticks_and_blocks_give_the_same_bits(
    name: str, first: int, cuts: list[int], start: float, seed: int
) -> None:
    make, block = CONTROLLERS[name]
    ticks = 300
    theta, x, y = (noise(ticks, seed + k) for k in range(3))
    last = np.full(WHISKERS, start, dtype=np.float32)
    by_tick, by_block = make(), make()
    by_tick.activate(first, last, last)
    by_block.activate(first, last, last)
    single = np.array([by_tick.step(first + j, theta[j], x[j], y[j]) for j in range(ticks)])
    commands = np.empty((ticks, WHISKERS), dtype=np.float32)
    edges = [0, *sorted(set(cuts)), ticks]
    for a, b in pairwise(edges):
        signals = theta[a:b], x[a:b], y[a:b]
        block(first + a, *signals, by_block.parameters, by_block.state, commands[a:b])
    assert single.tobytes() == commands.tobytes()
    assert by_tick.state.tobytes() == by_block.state.tobytes()


@pytest.mark.parametrize("name", CONTROLLERS)
@given(tick=st.integers(0, 10**7), start=st.floats(0, 0.8), seed=st.integers(0, 10))
@settings(max_examples=15, deadline=None)
def test_a_newcomer_starts_from_the_last_command_and_never_jumps(
    name: str, tick: int, start: float, seed: int
) -> None:
    controller: LawController = CONTROLLERS[name][0]()
    run(controller, noise(50, seed))  # whatever it did before counts no more
    last = np.full(WHISKERS, start, dtype=np.float32)
    controller.activate(tick, last, QUIET)
    commands = np.vstack([last, run(controller, noise(300, seed), tick)])
    limit = 0.003 if name == "retract" else WHISK.slew_limit
    assert np.abs(np.diff(commands.astype(np.float64), axis=0)).max() <= limit + ULP


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_newcomer_has_forgotten_everything_it_felt_before(name: str) -> None:
    used, fresh = (CONTROLLERS[name][0]() for _ in range(2))
    run(used, noise(70, 8))
    for controller in (used, fresh):
        controller.activate(70, np.full(WHISKERS, 0.1, dtype=np.float32), QUIET)
    y = noise(PERIOD, 9)
    assert run(used, y, 70).tobytes() == run(fresh, y, 70).tobytes()


def test_a_newcomer_converges_to_its_own_law() -> None:
    y = noise(3 * PERIOD, 5)
    displaced, settled = rcp(), rcp()
    displaced.activate(0, np.full(WHISKERS, 0.3, dtype=np.float32), QUIET)
    assert run(displaced, y)[PERIOD:].tobytes() == run(settled, y)[PERIOD:].tobytes()


def test_retract_brings_every_whisker_home_and_keeps_it_there() -> None:
    controller = Retract(0.01)
    controller.activate(0, HEAD.swing.astype(np.float32), QUIET)
    commands = run(controller, noise(200, 6))
    needed = np.ceil(HEAD.swing / 0.01).astype(int)
    for i in range(WHISKERS):
        assert commands[needed[i] - 2, i] > 0.0
        assert (commands[needed[i] :, i] == 0.0).all()


def test_read_only_and_strided_signals_compile_nothing_new() -> None:
    controller = rcp()
    y = noise(PERIOD, 7)
    expected = run(rcp(), y)
    before = len(controller.law.signatures)  # type: ignore[attr-defined]
    wide = np.zeros((PERIOD, 2 * WHISKERS), dtype=np.float32)
    wide[:, ::2] = y
    wide.setflags(write=False)
    assert run(controller, wide[:, ::2]).tobytes() == expected.tobytes()
    assert len(controller.law.signatures) == before  # type: ignore[attr-defined]


def test_signals_of_the_wrong_length_are_refused_before_anything_changes() -> None:
    controller = rcp()
    before = controller.state.tobytes()
    with pytest.raises(SignalShapeError, match=r"y: expected shape \(18,\), found \(17,\)"):
        controller.step(0, QUIET, QUIET, QUIET[:17])
    with pytest.raises(SignalShapeError, match=r"last_command: expected shape \(18,\)"):
        controller.activate(0, QUIET[:1], QUIET)
    assert controller.state.tobytes() == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"minimum": -0.1}, r"minimum: whisker 0 .* expected >= 0"),
        ({"amplitude": np.inf}, r"amplitude: whisker 0 .* expected a finite number"),
        ({"period_ticks": 1}, "period_ticks: 1, expected >= 2"),
        ({"slew_limit": 0.0001}, "slew_limit: 0.0001 .* steepest change of the whisk itself"),
    ],
)
def test_an_impossible_whisk_is_refused(changes: dict[str, object], message: str) -> None:
    arguments = {"minimum": 0.0, "amplitude": 0.5} | changes
    with pytest.raises(WhiskParameterError, match=message):
        WhiskParams(**arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gain": (1.0, -1.0, 1.0)}, "gain: mid ring is -1.0"),
        ({"gain": (1.0, 1.0)}, "gain: 2 values, expected one per ring"),
        ({"window_ticks": 0}, "window_ticks: 0, expected >= 1"),
        ({"reset": "often"}, "reset: 'often', expected one of"),
        ({"amplitude_minimum": 0.9}, "amplitude_minimum: whisker 0 .* is 0.9"),
    ],
)
def test_impossible_rcp_parameters_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(RcpParameterError, match=message):
        RcpParams(WHISK, **changes)
