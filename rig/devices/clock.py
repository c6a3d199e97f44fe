"""How one clock reads on another: offset and drift from stamped arrivals.

A message is never early, so the smallest delay in a stretch of time is the least disturbed. The
smallest of every half second are kept, and a straight line through the last of them is the
relation.
"""

from __future__ import annotations

import collections
from typing import Final

STRETCH_NS: Final = 500_000_000
KEPT: Final = 40


class ClockRelation:
    """Host time as a line over device time, both in ns."""

    def __init__(self) -> None:
        self._points: collections.deque[tuple[int, int]] = collections.deque(maxlen=KEPT)
        self._begin: int | None = None
        self._best = (0, 0)
        self._centre = (0.0, 0.0)
        self._slope = 0.0

    def see(self, device_ns: int, host_ns: int) -> None:
        """A message stamped `device_ns` arrived at `host_ns`."""
        delay = host_ns - device_ns
        if self._begin is None or device_ns < self._begin:
            self._begin, self._best = device_ns, (device_ns, delay)
        elif device_ns - self._begin >= STRETCH_NS:
            self._points.append(self._best)
            self._begin, self._best = device_ns, (device_ns, delay)
            self._draw()
        elif delay < self._best[1]:
            self._best = (device_ns, delay)

    def forget(self) -> None:
        """The device's clock has started afresh."""
        self._points.clear()
        self._begin = None
        self._slope = 0.0

    @property
    def drift(self) -> float:
        """How much faster the host's clock runs: 1e-6 is one ppm; 0 until it can be told."""
        return self._slope

    def host_ns(self, device_ns: int) -> int:
        """Host time at a device time, less the smallest delay of the line."""
        if not self._points:
            return device_ns + self._best[1]
        x, y = self._centre
        return round(device_ns + y + self._slope * (device_ns - x))

    def _draw(self) -> None:
        """The line of least squares through the points kept."""
        n = len(self._points)
        x0, y0 = self._points[0]
        x = sum(p[0] - x0 for p in self._points) / n
        y = sum(p[1] - y0 for p in self._points) / n
        xx = sum((p[0] - x0 - x) ** 2 for p in self._points)
        xy = sum((p[0] - x0 - x) * (p[1] - y0 - y) for p in self._points)
        self._centre = x0 + x, y0 + y
        self._slope = xy / xx if xx else 0.0


class CycleTicks:
    """Ticks of a run for the cycles of a device with a clock of its own.

    Cycles are as far apart as the device stamps them, so that a path sampled at these ticks is as
    smooth as the device's clock; the ticks follow the host's by one tick per cycle.
    """

    SLACK: Final = 8
    """Ticks the arrival of a cycle may be off, by which nothing is corrected."""
    STEP: Final = 2000
    """Ticks off beyond which the device's clock was set: its cycles start afresh."""

    def __init__(self, period: float) -> None:
        """period: s, between cycles."""
        self._ticks_per_s = 2000.0
        self._period = period
        self._last: tuple[float, float] | None = None

    def tick(self, stamp: float, now: int, rate: float = 1.0) -> int:
        """The tick of the cycle stamped `stamp` s that came at tick `now`; always a later one.

        rate: how much faster the ticks' clock runs than the device's.
        """
        if self._last is None:
            self._last = stamp, float(max(now, 0))
            return max(now, 0)
        before, last = self._last
        cycles = max(round((stamp - before) / self._period), 1)
        exact = last + cycles * self._period * self._ticks_per_s * rate
        off = now - exact
        if not -self.STEP < off < self.STEP:
            exact = now
        elif abs(off) > self.SLACK:
            exact += 1 if off > 0 else -1
        exact = max(exact, round(last) + 1.0)
        self._last = stamp, exact
        return round(exact)
