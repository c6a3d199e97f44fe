"""Experience Metric and Energy Metric, and the export of trajectories.

Sources: Salman & Pearson, "Advancing whisker based navigation through the implementation of
Bio-Inspired whisking strategies", Algorithm 1 and equations (1), (2); Burgard et al., "A comparison
of SLAM algorithms based on a graph of relations", IROS 2009.
Poses are float64[n, 3]: x (m), y (m), heading (rad).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import compiled, cos, sin
from vibrissa.slam.angles import wrap_pi

Floats = NDArray[np.float64]
Pairs = NDArray[np.int32]
Variant = Literal["or", "and", "and-not"]

POSITION_THRESHOLD: Final = 0.1
ANGLE_THRESHOLD: Final = math.radians(25.0)


class MetricError(ValueError):
    """The logs handed to a metric do not fit together."""


@dataclass(frozen=True, slots=True)
class ExperienceMetric:
    """Re-localisations (`relocalised`, eta) and correct ones (`correct`, eta_c) in `steps` steps
    after the base set.

    `arr` = relocalised / steps, None when the log ends with the base set;
    `arcr` = correct / relocalised, None when there was no re-localisation.
    `variant` names the reading of line 25 of Algorithm 1 that was used.
    """

    arr: float | None
    arcr: float | None
    relocalised: int
    correct: int
    steps: int
    variant: Variant


def experience_metric(
    experiences: ArrayLike,
    poses: ArrayLike,
    base: int,
    position_threshold: float = POSITION_THRESHOLD,
    angle_threshold: float = ANGLE_THRESHOLD,
    variant: Variant = "or",
) -> ExperienceMetric:
    """Algorithm 1 on a log of one experience id and one true pose per step.

    experiences: int[n]; poses: float[n, 3], true; base: length of the base set (the first loop),
    1 <= base <= n. Angle differences are wrapped, which the printed algorithm forgets.
    `variant` reads line 25 ("correct when kc1 and kc2", which can never be true):
    "or", the default: a step is correct when its pose agrees, or when the agent stays in a
    correctly re-localised experience; "and": as printed; "and-not": each correct entry once.

    A step is compared with the last earlier step in the same experience, so that staying in an
    experience compares with the step before; both rates therefore weigh long stays more, and only
    logs of equal step rate compare.

    Raises MetricError for logs of different length, an unknown variant or an impossible base.
    """
    verdicts = relocalisations(
        experiences, poses, base, position_threshold, angle_threshold, variant
    )
    steps = len(verdicts) - base
    eta = int(np.count_nonzero(verdicts))
    eta_c = int((verdicts > 0).sum())
    return ExperienceMetric(
        arr=eta / steps if steps else None,
        arcr=eta_c / eta if eta else None,
        relocalised=eta,
        correct=eta_c,
        steps=steps,
        variant=variant,
    )


def relocalisations(
    experiences: ArrayLike,
    poses: ArrayLike,
    base: int,
    position_threshold: float = POSITION_THRESHOLD,
    angle_threshold: float = ANGLE_THRESHOLD,
    variant: Variant = "or",
) -> NDArray[np.int8]:
    """int8[n]: 1 where a step is a correct re-localisation, -1 an incorrect one, 0 elsewhere.

    Arguments and errors as for `experience_metric`.
    """
    ids = np.asarray(experiences, dtype=np.int64)
    truth = _poses(poses, "poses")
    if ids.ndim != 1 or len(ids) != len(truth):
        raise MetricError(
            f"experience metric: expected one experience per pose ({len(truth)}),"
            f" found shape {ids.shape}"
        )
    if variant not in ("or", "and", "and-not"):
        raise MetricError(
            f"experience metric variant: expected 'or', 'and' or 'and-not', found {variant!r}"
        )
    n = len(ids)
    if not 1 <= base <= n:
        raise MetricError(f"experience metric base: expected 1 to {n}, found {base}")

    log: list[int] = ids.tolist()
    last_seen = {e: i for i, e in enumerate(log[:base])}
    valid = set(log[:base])
    relocalised: set[int] = set()
    correctly: set[int] = set()
    verdicts = np.zeros(n, dtype=np.int8)
    trusted = True
    for i in range(base, n):
        previous, now = log[i - 1], log[i]
        if now in last_seen and not (now == previous and previous not in relocalised):
            relocalised.add(now)
        if now in relocalised:
            dx, dy, dth = truth[i] - truth[last_seen[now]]
            near = math.hypot(dx, dy) < position_threshold and abs(wrap_pi(dth)) < angle_threshold
            agrees = now in valid and near
            stays = now == previous and previous in correctly
            trusted = {
                "or": agrees or stays,
                "and": agrees and stays,
                "and-not": agrees and not stays,
            }[variant]
            if trusted:
                correctly.add(now)
            verdicts[i] = 1 if trusted else -1
        if trusted:
            valid.add(previous)
        last_seen[now] = i
    return verdicts


def first_loop_closure(experiences: ArrayLike, absent: int = 1) -> int:
    """Length of the base set: the steps before the first return to an earlier experience.

    A return needs at least `absent` steps spent elsewhere; raise it to pass over returns between
    neighbouring experiences that look alike. The length of the log when there is no return.
    """
    log: list[int] = np.asarray(experiences, dtype=np.int64).tolist()
    last_seen: dict[int, int] = {}
    for i, experience in enumerate(log):
        if experience in last_seen and i - last_seen[experience] > absent:
            return i
        last_seen[experience] = i
    return len(log)


def first_circuit(poses: ArrayLike, near: float = POSITION_THRESHOLD) -> int:
    """Length of the base set by ground truth: the steps up to the first return to the start.

    The agent must have been further than twice `near` (m) from its first pose. The length of the
    log when it never returns.
    """
    truth = _poses(poses, "poses")
    away = False
    for i in range(len(truth)):
        distance = math.hypot(truth[i, 0] - truth[0, 0], truth[i, 1] - truth[0, 1])
        if away and distance < near:
            return i
        away = away or distance > 2.0 * near
    return len(truth)


@dataclass(frozen=True, slots=True)
class EnergyMetric:
    """Mean squared error of `relations` relative poses: translation (m^2) and rotation (rad^2).

    The Energy Metric of the paper is the sum of the two, in mixed units.
    """

    translation: float
    rotation: float
    relations: int

    @property
    def total(self) -> float:
        return self.translation + self.rotation


def energy_metric(estimate: ArrayLike, truth: ArrayLike, pairs: ArrayLike) -> EnergyMetric:
    """Energy of the relations (i, j) of `pairs`, int[m, 2], between estimated and true poses.

    Relations are relative poses x_i^-1 x_j, so no alignment is needed. Which relations to take is
    the experimenter's choice and decides the result: neighbours test local accuracy, far pairs the
    map as a whole. See `fixed_interval` (1 = consecutive) and `all_pairs`.

    Raises MetricError for logs of different length, poses that are not finite, no pair, or a pair
    outside the log.
    """
    est = _poses(estimate, "estimate")
    tru = _poses(truth, "truth")
    if len(est) != len(tru):
        raise MetricError(
            f"energy metric: expected as many estimates as true poses ({len(tru)}),"
            f" found {len(est)}"
        )
    relations = np.ascontiguousarray(pairs, dtype=np.int32)
    if relations.ndim != 2 or relations.shape[1] != 2 or len(relations) == 0:
        raise MetricError(
            f"energy metric pairs: expected shape (m, 2) with m > 0, found {relations.shape}"
        )
    if relations.min() < 0 or relations.max() >= len(est):
        raise MetricError(
            f"energy metric pairs: expected 0 to {len(est) - 1},"
            f" found {relations.min()} to {relations.max()}"
        )
    translation, rotation = _energy(est, tru, relations)
    count = len(relations)
    return EnergyMetric(translation / count, rotation / count, count)


def fixed_interval(n: int, interval: int = 1) -> Pairs:
    """The pairs (i, i + interval) of n poses, int32[n - interval, 2]; 1 = consecutive."""
    if interval < 1:
        raise MetricError(f"relation interval: expected >= 1, found {interval}")
    start = np.arange(max(n - interval, 0), dtype=np.int32)
    return np.stack([start, start + np.int32(interval)], axis=1)


def all_pairs(n: int) -> Pairs:
    """Every pair i < j of n poses, int32[n (n - 1) / 2, 2]."""
    return _all_pairs(n)


def to_tum(times: ArrayLike, poses: ArrayLike, height: float = 0.0) -> str:
    """A trajectory as text, one line `time x y z qx qy qz qw` per pose (the TUM RGB-D format).

    times: float[n], s; poses: float[n, 3]; height: z, m.
    Raises MetricError when the lengths differ.
    """
    stamps = np.asarray(times, dtype=np.float64)
    trajectory = _poses(poses, "poses")
    if stamps.shape != (len(trajectory),):
        raise MetricError(
            f"TUM export: expected {len(trajectory)} times, found shape {stamps.shape}"
        )
    return "".join(
        f"{t:.9f} {x:.9f} {y:.9f} {height:.9f} 0.000000000 0.000000000"
        f" {math.sin(0.5 * th):.9f} {math.cos(0.5 * th):.9f}\n"
        for t, (x, y, th) in zip(stamps.tolist(), trajectory.tolist(), strict=True)
    )


def _poses(poses: ArrayLike, name: str) -> Floats:
    array = np.ascontiguousarray(poses, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise MetricError(f"{name}: expected shape (n, 3) with n > 0, found {array.shape}")
    if not np.isfinite(array).all():
        raise MetricError(f"{name}: expected finite numbers, found NaN or infinity")
    return array


@compiled
def _all_pairs(n: int) -> Pairs:
    pairs = np.empty((n * (n - 1) // 2, 2), dtype=np.int32)
    p = 0
    for i in range(n):
        for j in range(i + 1, n):
            pairs[p, 0] = i
            pairs[p, 1] = j
            p += 1
    return pairs


@compiled
def _energy(estimate: Floats, truth: Floats, pairs: Pairs) -> tuple[float, float]:
    """Sums of squared translation and rotation of (true relation)^-1 (estimated relation)."""
    n = estimate.shape[0]
    frames = np.empty((n, 4))
    for i in range(n):
        frames[i, 0] = cos(estimate[i, 2])
        frames[i, 1] = sin(estimate[i, 2])
        frames[i, 2] = cos(truth[i, 2])
        frames[i, 3] = sin(truth[i, 2])
    translation = 0.0
    rotation = 0.0
    for p in range(pairs.shape[0]):
        i = pairs[p, 0]
        j = pairs[p, 1]
        dx = estimate[j, 0] - estimate[i, 0]
        dy = estimate[j, 1] - estimate[i, 1]
        tx = truth[j, 0] - truth[i, 0]
        ty = truth[j, 1] - truth[i, 1]
        ex = (frames[i, 0] * dx + frames[i, 1] * dy) - (frames[i, 2] * tx + frames[i, 3] * ty)
        ey = (frames[i, 0] * dy - frames[i, 1] * dx) - (frames[i, 2] * ty - frames[i, 3] * tx)
        turned = estimate[j, 2] - estimate[i, 2] - truth[j, 2] + truth[i, 2]
        turned = wrap_pi(turned)
        translation += ex * ex + ey * ey
        rotation += turned * turned
    return translation, rotation
