"""Time measurements of a host, in constant memory whatever the length of a run."""

from __future__ import annotations

import bisect
import itertools

_BINS = 20_000
"""1 us bins up to 20 ms; the last bin holds everything later."""


class Histogram:
    """Counts of durations in us, exact to 1 us up to 20 ms, with the exact maximum.

    `add` and `recent` are for the loop; `quantile` takes milliseconds and is for afterwards.
    """

    def __init__(self) -> None:
        self.counts = [0] * (_BINS + 1)
        self.largest = 0.0
        self._total = 0.0
        self._number = 0
        self._peak = 0.0

    def add(self, microseconds: float) -> None:
        index = int(microseconds)
        self.counts[0 if index < 0 else index if index < _BINS else _BINS] += 1
        self.largest = max(self.largest, microseconds)
        self._total += microseconds
        self._number += 1
        self._peak = max(self._peak, microseconds)

    def recent(self) -> tuple[float, float]:
        """(mean, largest) in us since the last call; (0, 0) when nothing was measured."""
        mean, peak = self._total / max(self._number, 1), self._peak
        self._total, self._number, self._peak = 0.0, 0, 0.0
        return mean, peak

    def quantile(self, q: float) -> float:
        """The duration below which a share q of all lies (upper edge of its bin); nan if empty."""
        total = sum(self.counts)
        if total == 0:
            return float("nan")
        index = bisect.bisect_left(list(itertools.accumulate(self.counts)), q * total)
        return self.largest if index >= _BINS else min(float(index + 1), self.largest)

    def summary(self) -> dict[str, float]:
        """p50, p99, p99.9 and max in us; empty when nothing was measured."""
        if not any(self.counts):
            return {}
        return {
            "p50": self.quantile(0.5),
            "p99": self.quantile(0.99),
            "p999": self.quantile(0.999),
            "max": round(self.largest, 1),
        }


class Clocking:
    """Lateness, work time and period of the ticks of one node, and its reaction latency.

    lateness: from the moment a tick was due on the common clock to the start of its step;
    work: how long the step took; period: from the start of a step to the start of the next;
    latency: from the moment a probed message went out to the arrival of its answer.
    """

    def __init__(self) -> None:
        self.lateness = Histogram()
        self.work = Histogram()
        self.period = Histogram()
        self.latency = Histogram()
        self._last_start = 0

    def tick(self, due_ns: int, start_ns: int, end_ns: int) -> None:
        self.lateness.add((start_ns - due_ns) * 1e-3)
        self.work.add((end_ns - start_ns) * 1e-3)
        if self._last_start:
            self.period.add((start_ns - self._last_start) * 1e-3)
        self._last_start = start_ns

    def summary(self) -> dict[str, dict[str, float]]:
        return {
            "lateness_us": self.lateness.summary(),
            "work_us": self.work.summary(),
            "period_us": self.period.summary(),
            "latency_us": self.latency.summary(),
        }
