"""Tuning as the paper does it, over a grid, beside controls that feel nothing.

Salman & Pearson lower the injected energy and raise the match threshold until the first loop closes
without a wrong re-localisation. That curve is not monotone: a template that matches everywhere
habituates and stops injecting, so a point may be good by luck between two bad ones. The grid
therefore also holds the size of the pose-cell torus, and every point is judged together with its
neighbours, and with two controls: `blind` (all images black) and `shuffled` (the images of other
whisks, drawn once).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import cos, philox_uniform, sin
from vibrissa.slam.angles import wrap_pi
from vibrissa.slam.circuits import circuit_numbers
from vibrissa.slam.config import ConfigError, RatSlamConfig
from vibrissa.slam.interface import Odometry
from vibrissa.slam.metrics import (
    ANGLE_THRESHOLD,
    POSITION_THRESHOLD,
    EnergyMetric,
    all_pairs,
    energy_metric,
    experience_metric,
    first_circuit,
    fixed_interval,
)
from vibrissa.slam.ratslam import RatSlam

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Value = float | int
Point = Mapping[str, Value]
"""A point of the grid: parameter name -> value."""
Control = Literal["touch", "blind", "shuffled"]

THRESHOLD: Final = "vt_match_threshold"
ENERGY: Final = "pc_vt_inject_energy"
CONTROLS: Final[tuple[Control, ...]] = ("touch", "blind", "shuffled")
GRID: Final[dict[str, tuple[Value, ...]]] = {
    THRESHOLD: (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016),
    ENERGY: (0.01, 0.02, 0.05),
    "pc_dim_xy": (11, 21),
    "pc_cell_x_size": (0.03, 0.06),
    "exp_delta_pc_threshold": (1.0, 2.0),
}
INTERVAL: Final = 20
SHUFFLE_SEED, SHUFFLE_STREAM = 1, 3000
STAGES: Final = ("stable", "isolated", "untouched", "wrong", "open")
"""How good the best points are, best first; see `choose`."""


class TuningError(ValueError):
    """A recording or a grid that nothing can be tuned on."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What SLAM is given and judged by: one row per whisk.

    images: uint8[n, rows, columns]; odometry: float64[n, 3], v (m/s), w (rad/s), dt (s) since the
    row before; truth: float64[n, 3], x, y (m), heading (rad). Raises TuningError when these do not
    fit together or hold no complete circuit.
    """

    images: NDArray[np.uint8]
    odometry: Floats
    truth: Floats

    def __post_init__(self) -> None:
        n = len(self.images)
        if self.odometry.shape != (n, 3) or self.truth.shape != (n, 3):
            raise TuningError(
                f"recording: expected odometry and truth of shape ({n}, 3) for {n} images,"
                f" found {self.odometry.shape} and {self.truth.shape}"
            )
        if n <= INTERVAL or first_circuit(self.truth) == n:
            raise TuningError(
                f"recording: expected a return to the start, found none in {n} whisks;"
                " tuning needs more than one circuit"
            )

    def controlled(self, control: Control) -> NDArray[np.uint8]:
        """The images as they are, all black, or those of other whisks."""
        if control == "blind":
            return np.zeros_like(self.images)
        if control == "shuffled":
            n = len(self.images)
            keys = [philox_uniform(SHUFFLE_SEED, SHUFFLE_STREAM, i) for i in range(n)]
            return self.images[np.argsort(keys, kind="stable")]
        return self.images


@dataclass(frozen=True, slots=True)
class Energies:
    """Energy Metric over consecutive relations, relations 20 apart, and all of them."""

    consecutive: EnergyMetric
    interval: EnergyMetric
    all: EnergyMetric


@dataclass(frozen=True, slots=True)
class Score:
    """One run of RatSLAM over a recording.

    A *return* enters an experience that existed before; it is *right* within 0.1 m and 25 degrees
    of where that experience was made. `earlier`: returns to experiences of earlier circuits.
    `closed_at`: the whisk of the first right return to an earlier circuit, None when there is
    none. `wrong_before`: wrong returns before it (in the whole run when there is none).
    arr, arcr: Experience Metric, base set = the first circuit by ground truth ("or" reading), None
    where not defined. `whisks`: energies of the poses of each whisk's experience in the final map;
    `experiences_made`: of each experience in the final map against the pose it was made at.
    """

    arr: float | None
    arcr: float | None
    returns: int
    right: int
    earlier: int
    earlier_right: int
    closed_at: int | None
    wrong_before: int
    templates: int
    experiences: int
    whisks: Energies
    experiences_made: Energies | None

    @property
    def closes_cleanly(self) -> bool:
        """The first loop closed, and no return before it was wrong."""
        return self.closed_at is not None and self.wrong_before == 0


@dataclass(frozen=True, slots=True)
class Trial:
    """A point of the grid with its score and those of the two controls."""

    point: Point
    touch: Score
    blind: Score
    shuffled: Score

    @property
    def touched(self) -> bool:
        """Touch finds more right returns to earlier circuits than either control."""
        return self.touch.earlier_right > max(self.blind.earlier_right, self.shuffled.earlier_right)


@dataclass(frozen=True, slots=True)
class Choice:
    """The trial that was chosen, how good it is (one of STAGES), and a sentence why."""

    trial: Trial
    stage: str
    reason: str


def grid_points(grid: Mapping[str, Sequence[Value]]) -> list[Point]:
    """All points of a grid, the first axis varying slowest, values in ascending order.

    Raises TuningError for an unknown parameter or an axis without values.
    """
    known = {field.name for field in fields(RatSlamConfig)}
    for name, values in grid.items():
        if name not in known:
            raise TuningError(f"grid {name}: no such RatSLAM parameter")
        if len(values) == 0:
            raise TuningError(f"grid {name}: expected at least one value, found none")
    axes = [sorted(set(values)) for values in grid.values()]
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*axes)]


def configured(base: RatSlamConfig, point: Point) -> RatSlamConfig:
    """The parameters of a point. Raises TuningError for values out of range."""
    changes: dict[str, Any] = dict(point)
    try:
        return replace(base, **changes)
    except ConfigError as error:
        raise TuningError(f"grid {error}") from None


def blind_key(point: Point) -> tuple[Value, ...]:
    """Points with equal keys have equal blind runs: black images match at any threshold."""
    return tuple(value for name, value in point.items() if name != THRESHOLD)


def score(recording: Recording, config: RatSlamConfig, control: Control = "touch") -> Score:
    """Run RatSLAM over a recording, or one of its controls, and judge it."""
    slam = RatSlam(config)
    n = len(recording.images)
    ids = np.empty(n, dtype=np.int64)
    images = recording.controlled(control)
    for k, (v, w, dt) in enumerate(recording.odometry.tolist()):
        ids[k] = slam.step(images[k], Odometry(v, w, dt)).experience
    truth = recording.truth
    map_poses = slam.map().poses

    made = np.full(len(map_poses), -1, dtype=np.int64)
    for k in range(n - 1, -1, -1):
        made[ids[k]] = k
    made_at = made[ids]
    circuit = circuit_numbers(truth)
    entered = np.r_[True, ids[1:] != ids[:-1]] & (made_at < np.arange(n))
    right = _near(truth, truth[made_at])
    earlier = entered & (circuit[made_at] < circuit)
    closing = np.flatnonzero(earlier & right)
    end = int(closing[0]) if len(closing) else n
    metric = experience_metric(ids, truth, first_circuit(truth))
    known = made[made >= 0]
    return Score(
        arr=metric.arr,
        arcr=metric.arcr,
        returns=int(entered.sum()),
        right=int((entered & right).sum()),
        earlier=int(earlier.sum()),
        earlier_right=len(closing),
        closed_at=end if len(closing) else None,
        wrong_before=int((entered & ~right)[:end].sum()),
        templates=len(slam.local_view),
        experiences=len(map_poses),
        whisks=energies(map_poses[ids], truth),
        experiences_made=(
            energies(map_poses[made >= 0], truth[known]) if len(known) > INTERVAL else None
        ),
    )


def energies(estimate: ArrayLike, truth: ArrayLike) -> Energies:
    """Energy Metric of a trajectory float[n, 3], n > 20, in the three readings."""
    n = len(np.asarray(estimate))
    return Energies(
        energy_metric(estimate, truth, fixed_interval(n)),
        energy_metric(estimate, truth, fixed_interval(n, INTERVAL)),
        energy_metric(estimate, truth, all_pairs(n)),
    )


def dead_reckoning(odometry: Floats, start: Floats | None = None) -> Floats:
    """Poses float64[n, 3] after each step of odometry float64[n, 3] (v, w, dt), from `start`."""
    x, y, heading = (0.0, 0.0, 0.0) if start is None else start.tolist()
    poses = np.empty((len(odometry), 3), dtype=np.float64)
    for k, (v, w, dt) in enumerate(odometry.tolist()):
        heading = wrap_pi(heading + w * dt)
        x += v * dt * cos(heading)
        y += v * dt * sin(heading)
        poses[k] = x, y, heading
    return poses


def choose(trials: Sequence[Trial]) -> Choice:
    """Pick the parameters by the paper's rule, made well-defined.

    A trial *qualifies* when its first loop closes without a wrong re-localisation before, and it
    finds more right returns to earlier circuits than both controls. It is *stable* when its
    neighbours at the next lower and the next higher threshold qualify too; at either end of the
    grid nothing is known about one neighbour, so no trial there is stable. The largest threshold
    among stable trials is taken. Ties between trials of equal threshold go to the most right
    returns to earlier circuits, then to the lower injected energy, then to the first in the grid.

    Where no trial is stable, the next of these sets is used: `isolated` (qualify), `untouched`
    (close cleanly, but no better than a control), `wrong` (close, the fewest wrong before), `open`
    (never close: the most right returns).
    Raises TuningError when there are no trials.
    """
    if not trials:
        raise TuningError("choice: expected at least one trial, found none")
    by_key: dict[tuple[Value, ...], list[Trial]] = {}
    for trial in trials:
        by_key.setdefault(blind_key(trial.point), []).append(trial)

    def qualifies(trial: Trial) -> bool:
        return trial.touch.closes_cleanly and trial.touched

    def stable(trial: Trial) -> bool:
        line = sorted(by_key[blind_key(trial.point)], key=_threshold)
        at = next(i for i, other in enumerate(line) if other is trial)
        return 0 < at < len(line) - 1 and all(map(qualifies, line[at - 1 : at + 2]))

    closing = [t for t in trials if t.touch.closed_at is not None]
    fewest = min((t.touch.wrong_before for t in closing), default=0)
    sets = {
        "stable": [t for t in trials if stable(t)],
        "isolated": [t for t in trials if qualifies(t)],
        "untouched": [t for t in trials if t.touch.closes_cleanly],
        "wrong": [t for t in closing if t.touch.wrong_before == fewest],
        "open": list(trials),
    }
    stage = next(name for name in STAGES if sets[name])
    candidates = sets[stage]
    if stage == "open":
        most = max(t.touch.right for t in candidates)
        candidates = [t for t in candidates if t.touch.right == most]
    largest = max(_threshold(t) for t in candidates)
    tied = [t for t in candidates if _threshold(t) == largest]
    best = min(tied, key=lambda t: (-t.touch.earlier_right, t.point.get(ENERGY, 0.0)))
    return Choice(best, stage, _reason(best, stage, len(candidates), len(tied), len(trials)))


def _reason(best: Trial, stage: str, candidates: int, tied: int, total: int) -> str:
    found = best.touch
    why = {
        "stable": (
            f"largest threshold of the {candidates} of {total} points where, as at both"
            " neighbouring thresholds, the first loop closes without a wrong re-localisation and"
            " touch beats both controls"
        ),
        "isolated": (
            f"largest threshold of the {candidates} of {total} points where the first loop closes"
            " without a wrong re-localisation and touch beats both controls; the neighbouring"
            " thresholds do not agree or were not tried, so this point is not stable"
        ),
        "untouched": (
            f"no point where touch beats both controls; largest threshold of the {candidates} of"
            f" {total} points where the first loop closes without a wrong re-localisation"
        ),
        "wrong": (
            f"every point that closes a loop has wrong re-localisations before; largest threshold"
            f" of the {candidates} with the fewest, {found.wrong_before}"
        ),
        "open": (
            f"no point closes a loop; largest threshold of the {candidates} with the most right"
            f" returns, {found.right}"
        ),
    }[stage]
    tie = (
        f"; tied with {tied - 1} at this threshold, it has the most right returns to earlier"
        f" circuits ({found.earlier_right}), then the lowest energy"
        if tied > 1
        else ""
    )
    return why + tie


def _threshold(trial: Trial) -> float:
    return float(trial.point.get(THRESHOLD, 0.0))


def _near(here: Floats, there: Floats) -> NDArray[np.bool_]:
    away = np.hypot(*(here[:, :2] - there[:, :2]).T)
    turned = np.abs((here[:, 2] - there[:, 2] + math.pi) % (2.0 * math.pi) - math.pi)
    near: NDArray[np.bool_] = (away < POSITION_THRESHOLD) & (turned < ANGLE_THRESHOLD)
    return near
