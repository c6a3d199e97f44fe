"""Scores of a finished SLAM run against the truth, and of images without any SLAM.

Pure functions of logs with one row per whisk. Terms: a step *returns* when its experience was known
before and is not that of the step before; it returns *to an earlier circuit* when its experience
was made in one; it is *right* when the head is within 0.1 m and 25 degrees of where that
experience was made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled, cos, philox_uniform, sin
from vibrissa.slam.angles import wrap_pi
from vibrissa.slam.metrics import (
    ANGLE_THRESHOLD,
    POSITION_THRESHOLD,
    energy_metric,
    experience_metric,
    fixed_interval,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

INTERVAL: Final = 20
FAR_PAIRS: Final = 20_000
PAIR_SEED, PAIR_STREAM = 1, 0
SAME_PLACE: Final = 0.03
"""m: the nearest whisk of another circuit counts as the same place up to this distance ..."""
SAME_HEADING: Final = math.radians(15.0)
OTHER_PLACE: Final = 0.1
"""m: ... and whisks further away than this as other places."""
RELATIONS: Final = ("consecutive", "interval", "all")
"""Relation sets: neighbours; 20 apart; pairs drawn from all."""


@dataclass(frozen=True, eq=False)
class Trace:
    """What a SLAM run left: one row per whisk, and the final map.

    experience int64[n]; reckoned float64[n, 3]: dead reckoning by the same odometry; truth
    float64[n, 3]; circuit int64[n]; map_poses float64[e, 3]: final pose of every experience.
    """

    experience: Ints
    reckoned: Floats
    truth: Floats
    circuit: Ints
    map_poses: Floats
    templates: int


def first_seen(experience: Ints) -> Ints:
    """int64[e]: the step that made each experience; ids are numbered as they are made."""
    found = np.full(int(experience.max()) + 1, -1, dtype=np.int64)
    steps = np.arange(len(experience) - 1, -1, -1)
    found[experience[::-1]] = steps
    return found


def scores(trace: Trace) -> dict[str, Any]:
    """Every score of a run as a flat dictionary; None where one is not defined."""
    base = int((trace.circuit == 0).sum())
    or_, and_not = (
        experience_metric(trace.experience, trace.truth, base, variant=variant)
        for variant in ("or", "and-not")
    )
    found: dict[str, Any] = {
        "arr": or_.arr,
        "arcr": or_.arcr,
        "arcr_and_not": and_not.arcr,
        "templates": trace.templates,
        "experiences": len(trace.map_poses),
        "steps": len(trace.experience),
    }
    found |= returns(trace, base)
    found |= energies(trace)
    return found


def returns(trace: Trace, base: int) -> dict[str, float | None]:
    """Returns after the base set: all, to earlier circuits, and the share of each that is right.

    `earlier`: share of steps spent in an experience of an earlier circuit; `opposite`: of those,
    the share that was made facing the other way.
    """
    made = first_seen(trace.experience)[trace.experience]
    steps = np.arange(len(made))
    entered = np.r_[True, trace.experience[1:] != trace.experience[:-1]]
    away = np.hypot(*(trace.truth[:, :2] - trace.truth[made, :2]).T)
    turned = np.array([abs(wrap_pi(t)) for t in trace.truth[:, 2] - trace.truth[made, 2]])
    right = (away < POSITION_THRESHOLD) & (turned < ANGLE_THRESHOLD)
    later = steps >= base
    returning = later & entered & (made < steps)
    earlier = later & (trace.circuit[made] < trace.circuit)
    return {
        "returns": _share(returning, later),
        "right": _share(returning & right, returning),
        "earlier": _share(earlier, later),
        "earlier_right": _share(earlier & right, earlier),
        "opposite": _share(earlier & (turned > math.pi / 2), earlier),
    }


def energies(trace: Trace) -> dict[str, float]:
    """Energy Metric by whisk and by experience, of the map and of dead reckoning.

    Keys `em_<by>_<relations>`, `em_.._t` and `em_.._r` (its translation, m^2, and rotation, rad^2)
    and `odo_..` alike, where <by> is `whisk` (each whisk where its experience lies in the final
    map) or `experience` (each experience once, where it was made).
    """
    made = first_seen(trace.experience)
    found: dict[str, float] = {}
    for by, estimate, rows in (
        ("whisk", trace.map_poses[trace.experience], np.arange(len(trace.experience))),
        ("experience", trace.map_poses, made),
    ):
        for relations in RELATIONS:
            pairs = relation_pairs(relations, len(rows))
            if len(pairs) == 0:
                continue
            for name, poses in (("em", estimate), ("odo", trace.reckoned[rows])):
                energy = energy_metric(poses, trace.truth[rows], pairs)
                key = f"{name}_{by}_{relations}"
                found[key] = energy.total
                found[f"{key}_t"] = energy.translation
                found[f"{key}_r"] = energy.rotation
    return found


def relation_pairs(relations: str, n: int) -> NDArray[np.int32]:
    """The pairs int32[m, 2] of a relation set over n poses."""
    if relations == "all":
        return _far_pairs(n, FAR_PAIRS) if n > 1 else np.zeros((0, 2), dtype=np.int32)
    return fixed_interval(n, INTERVAL if relations == "interval" else 1)


@compiled
def _far_pairs(n: int, count: int) -> NDArray[np.int32]:
    pairs = np.empty((count, 2), dtype=np.int32)
    for k in range(count):
        i = int(philox_uniform(PAIR_SEED, PAIR_STREAM, 2 * k) * n)
        j = int(philox_uniform(PAIR_SEED, PAIR_STREAM, 2 * k + 1) * (n - 1))
        j += j >= i
        pairs[k, 0], pairs[k, 1] = min(i, j), max(i, j)
    return pairs


@compiled
def dead_reckoning(motion: Floats) -> Floats:
    """Poses float64[n, 3] after each step of odometry float64[n, 3]: v (m/s), w (rad/s), dt (s)."""
    poses = np.empty((motion.shape[0], 3))
    x = y = heading = 0.0
    for k in range(motion.shape[0]):
        heading = wrap_pi(heading + motion[k, 1] * motion[k, 2])
        x += motion[k, 0] * motion[k, 2] * cos(heading)
        y += motion[k, 0] * motion[k, 2] * sin(heading)
        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
    return poses


def recognition(images: NDArray[np.uint8], truth: Floats, circuit: Ints) -> dict[str, float | None]:
    """How well single images tell places apart, before any SLAM: circuits 1, 2 against circuit 0.

    auc: probability that the same place looks more alike than another one (0.5: blind); same:
    median mean absolute difference (0 to 1) at the same place; top1: share of whisks whose most
    similar whisk of circuit 0 is at the same place. images uint8[n, ..]; None without such places.
    """
    flat = images.reshape(len(images), -1).astype(np.int64)
    first, later = np.flatnonzero(circuit == 0), np.flatnonzero((circuit == 1) | (circuit == 2))
    alike, unlike, hits, placed = _compare(flat[first], truth[first], flat[later], truth[later])
    if alike.sum() == 0 or unlike.sum() == 0:
        return {"auc": None, "same": None, "top1": None}
    below = np.cumsum(unlike) - unlike
    # a pair counts half when both look equally alike
    more_alike = (alike * (unlike.sum() - below - unlike / 2.0)).sum()
    median = int(np.searchsorted(np.cumsum(alike), alike.sum() / 2.0))
    return {
        "auc": float(more_alike / alike.sum() / unlike.sum()),
        "same": median / (255.0 * flat.shape[1]),
        "top1": hits / placed,
    }


@compiled
def _compare(
    first: NDArray[np.int64], first_truth: Floats, later: NDArray[np.int64], later_truth: Floats
) -> tuple[Ints, Ints, int, int]:
    """Histograms of image differences at the same and at other places; right best matches."""
    pixels = first.shape[1]
    alike = np.zeros(255 * pixels + 1, dtype=np.int64)
    unlike = np.zeros(255 * pixels + 1, dtype=np.int64)
    hits = placed = 0
    for i in range(later.shape[0]):
        nearest, least = -1, np.inf
        best, best_cost = -1, 255 * pixels + 1
        for j in range(first.shape[0]):
            dx = later_truth[i, 0] - first_truth[j, 0]
            dy = later_truth[i, 1] - first_truth[j, 1]
            away = math.sqrt(dx * dx + dy * dy)
            cost = 0
            for p in range(pixels):
                cost += abs(later[i, p] - first[j, p])
            if away > OTHER_PLACE:
                unlike[cost] += 1
            turned = abs(wrap_pi(later_truth[i, 2] - first_truth[j, 2]))
            if away < least and turned < SAME_HEADING:
                nearest, least = j, away
            if cost < best_cost:
                best, best_cost = j, cost
        if nearest >= 0 and least <= SAME_PLACE:
            placed += 1
            cost = 0
            for p in range(pixels):
                cost += abs(later[i, p] - first[nearest, p])
            alike[cost] += 1
            dx = later_truth[i, 0] - first_truth[best, 0]
            dy = later_truth[i, 1] - first_truth[best, 1]
            turned = abs(wrap_pi(later_truth[i, 2] - first_truth[best, 2]))
            hits += math.sqrt(dx * dx + dy * dy) <= SAME_PLACE and turned < SAME_HEADING
    return alike, unlike, hits, placed


def touch_quality(impingement: Floats, slips: Ints) -> dict[str, float]:
    """Mean deepest impingement of the whiskers that were pushed back at all (degrees per whisk),
    and slips off a wall per whisk of the head."""
    pushed = impingement[impingement > math.radians(0.1)]
    return {
        "impingement_deg": math.degrees(float(pushed.mean())) if len(pushed) else 0.0,
        "slips": float(slips.sum() / len(slips)),
    }


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> float | None:
    return float(part.sum() / whole.sum()) if whole.any() else None
