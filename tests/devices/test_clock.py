"""The relation between a device's clock and the host's."""

from __future__ import annotations

import random

import pytest

from vibrissa.rig.devices.clock import ClockRelation


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
