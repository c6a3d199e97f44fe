"""The relation between a device's clock and the host's."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.devices.clock import ClockRelation, CycleTicks

TICK_NS = 500_000


def test_drift_and_offset_are_found_under_delays_of_milliseconds() -> None:
    clock, rng = ClockRelation(), random.Random(3)
    offset, drift = 7_000_000_000, 150e-6
    for k in range(40_000):
        device = k * 500_000
        host = offset + device * (1 + drift) + 30_000 + rng.expovariate(1 / 2e6)
        clock.see(device, round(host))
    assert clock.drift == pytest.approx(drift, abs=5e-6)
    later = 21_000_000_000
    assert clock.host_ns(later) == pytest.approx(offset + later * (1 + drift) + 30_000, abs=60_000)


def test_one_look_gives_the_offset_and_forgetting_starts_afresh() -> None:
    clock = ClockRelation()
    clock.see(1_000, 5_000)
    assert clock.host_ns(2_000) == 6_000 and clock.drift == 0.0
    clock.forget()
    clock.see(0, 100)
    assert clock.host_ns(50) == 150


@given(
    drift=st.floats(-300e-6, 300e-6),
    late=st.lists(st.integers(0, 6), min_size=50, max_size=300),
    lost=st.sets(st.integers(1, 299), max_size=20),
)
def test_cycles_of_an_arm_are_evenly_ticked_and_follow_the_hosts_clock(
    drift: float, late: list[int], lost: set[int]
) -> None:
    cycles = CycleTicks(0.008)
    before = None
    for k, delay in enumerate(late):
        if k in lost:
            continue
        now = round(100 + 16 * k * (1 + drift)) + delay
        tick = cycles.tick(5.0 + 0.008 * k, now)
        if before is not None:
            assert abs(tick - before[1] - 16 * (k - before[0])) <= 1
        assert abs(tick - now) <= 16
        before = k, tick


def test_a_controller_that_reboots_does_not_turn_ticks_back() -> None:
    cycles = CycleTicks(0.008)
    ticks = [cycles.tick(100 + 0.008 * k, 16 * k) for k in range(50)]
    ticks += [cycles.tick(0.008 * k, 20_000 + 16 * k) for k in range(50)]
    assert all(b > a for a, b in pairwise(ticks)) and ticks[-1] == 20_000 + 16 * 49


@pytest.mark.parametrize("head", [-0.1, -0.07, 0.0, 0.07, 0.1])
@pytest.mark.parametrize("arm", [-0.1, 0.0, 0.1])
def test_cycles_keep_to_a_clock_that_is_far_off_evenly_once_its_drift_is_known(
    head: float, arm: float
) -> None:
    """The clocks of head and arm run up to 10 % off the host's; both are heard up to 3 ms late."""
    rng = random.Random(5)
    late_ns = 3_000_000
    heads, arms = ClockRelation(), ClockRelation()
    cycles = CycleTicks(0.008)
    before = 0
    for k in range(2500):
        arm_ns = 8_000_000 * k
        host_ns = arm_ns * (1 + arm)
        head_ns = host_ns / (1 + head)
        arms.see(arm_ns, round(host_ns + rng.random() * late_ns))
        heads.see(round(head_ns), round(host_ns + rng.random() * late_ns))
        if arm_ns < 2e9:
            continue
        now = round((head_ns + rng.random() * late_ns) / TICK_NS)
        tick = cycles.tick(arm_ns * 1e-9, now, (1 + arms.drift) / (1 + heads.drift))
        assert abs(tick - head_ns / TICK_NS) <= 16
        assert not before or abs(tick - before - 16 * (1 + arm) / (1 + head)) <= 2
        before = tick
