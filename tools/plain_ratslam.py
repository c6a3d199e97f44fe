"""RatSLAM and its metrics as plain NumPy formulas: slow, and independent of the compiled kernels.

What the tests compare every kernel with, and the peer that `vibrissa bench slam` measures.
Sources: OpenRatSLAM's behaviour; Salman & Pearson, Algorithm 1; Burgard et al., IROS 2009.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TAU = 2.0 * math.pi


def kernel(width: int, sigma: float) -> Floats:
    """Normalised isotropic Gaussian [th, y, x]."""
    a = np.arange(width) - width // 2
    squares = a[:, None, None] ** 2 + a[None, :, None] ** 2 + a[None, None, :] ** 2
    weights = np.exp(-squares / (2.0 * sigma**2))
    normalised: Floats = weights / weights.sum()
    return normalised


def convolve(cells: Floats, weights: Floats) -> Floats:
    """Circular convolution, tap by tap."""
    half = weights.shape[0] // 2
    result = np.zeros_like(cells)
    for k, j, i in np.ndindex(weights.shape):
        result += weights[k, j, i] * np.roll(cells, (k - half, j - half, i - half), (0, 1, 2))
    return result


def stages(cells: Floats, global_inhibition: float) -> list[Floats]:
    """Excitation, inhibition, global inhibition, normalisation."""
    excited = convolve(cells, kernel(7, 1))
    inhibited = excited - convolve(excited, kernel(5, 2))
    kept = np.where(inhibited >= global_inhibition, inhibited - global_inhibition, 0.0)
    return [excited, inhibited, kept, kept / kept.sum()]


def move(cells: Floats, step: float, angle: float, corners: bool) -> Floats:
    """Path integration by `step` cells and `angle` rad, on layers turned into the first quadrant.

    corners: True moves all activity, False loses it at two corners as OpenRatSLAM does.
    """
    layers, n, _ = cells.shape
    moved = np.empty_like(cells)
    for k in range(layers):
        direction = k * TAU / layers
        if step < 0.0:
            direction += math.pi
        quarter = math.floor(direction * 2.0 / math.pi)
        th = direction - quarter * math.pi / 2.0
        s = abs(step)
        layer = cells[k]
        for _ in range(quarter % 4):
            layer = layer[::-1].T
        sw = s * s * math.cos(th) * math.sin(th)
        se = s * math.sin(th) * (1.0 - s * math.cos(th))
        nw = s * math.cos(th) * (1.0 - s * math.sin(th))
        right, up = layer.copy(), layer.copy()
        if not corners:
            up[n - 1, 0] = 0.0
            right[0, n - 1] = 0.0
        layer = (
            (1.0 - sw - se - nw) * layer
            + se * np.roll(right, 1, 1)
            + nw * np.roll(up, 1, 0)
            + sw * np.roll(layer, (1, 1), (0, 1))
        )
        for _ in range((4 - quarter) % 4):
            layer = layer[::-1].T
        moved[k] = layer
    if angle == 0.0:
        return moved
    turns = abs(angle) * layers / TAU
    sign = 1 if angle > 0.0 else -1
    part = turns
    while part > 1.0:
        part -= 1.0
    if part == 0.0:
        part = 1.0
    low, high = sign * math.floor(turns), sign * math.ceil(turns)
    turned: Floats = (1.0 - part) * np.roll(moved, low, 0) + part * np.roll(moved, high, 0)
    return turned


def read_out(cells: Floats) -> tuple[float, float, float]:
    """x, y, heading of the packet around the largest cell."""
    peak = np.unravel_index(int(np.argmax(cells)), cells.shape)
    windows = [
        [(p + d) % length for d in range(-3, 4)]
        for p, length in zip(peak, cells.shape, strict=True)
    ]
    window = cells[np.ix_(*windows)]
    result = []
    for axis, others in ((2, (0, 1)), (1, (0, 2)), (0, (1, 2))):
        length = cells.shape[axis]
        angles = (np.array(windows[axis]) + 1) * TAU / length
        sums = window.sum(axis=others)
        value = math.atan2((np.sin(angles) * sums).sum(), (np.cos(angles) * sums).sum())
        result.append((value * length / TAU - 1.0) % length)
    return tuple(result)


def match(
    view: Floats,
    templates: Iterable[Floats],
    tolerance: float,
    margin: int,
    step: int,
    panoramic: bool,
) -> tuple[int, float, int]:
    """Exhaustive search: (id or -1, cost, shift); costs are summed one after the other."""
    best = (-1, math.inf, 0)
    columns = view.shape[1]
    for number, template in enumerate(templates):
        if abs(float(np.cumsum(view)[-1] - np.cumsum(template)[-1])) / view.size > tolerance:
            continue
        for offset in range(0, columns if panoramic else 2 * margin + 1, step):
            if panoramic:
                difference = np.abs(view - np.roll(template, -offset, 1))
            else:
                width = columns - 2 * margin
                difference = np.abs(
                    view[:, margin : margin + width] - template[:, offset : offset + width]
                )
            cost = float(np.cumsum(difference)[-1])
            if cost < best[1]:
                best = (number, cost, offset)
    return best


def relax(poses: Floats, links: Any, values: Any, loops: int, correction: float) -> Floats:
    """Relaxation of an experience map; links sorted as they are visited."""
    poses = poses.copy()
    for _ in range(loops):
        for (a, b), (distance, heading, facing, _) in zip(links, values, strict=True):
            towards = poses[a, 2] + heading
            error = (
                poses[b, :2]
                - poses[a, :2]
                - distance * np.array([math.cos(towards), math.sin(towards)])
            )
            poses[a, :2] += correction * error
            poses[b, :2] -= correction * error
            twist = correction * wrap(poses[b, 2] - poses[a, 2] - facing)
            poses[a, 2] = wrap(poses[a, 2] + twist)
            poses[b, 2] = wrap(poses[b, 2] - twist)
    return poses


def wrap(angle: float) -> float:
    return math.pi - (math.pi - angle) % TAU


def experience_metric(
    E: Sequence[int],
    P: Any,
    i_base: int,
    delta_p: float,
    delta_th: float,
    line_25: str,
    wrapped: bool = True,
) -> tuple[int, int]:
    """Algorithm 1 line by line, with lists and 1-based steps: (eta, eta_c)."""
    C = list(dict.fromkeys(E[:i_base]))
    R: list[int] = []
    Rc: list[int] = []
    eta = eta_c = 0
    rc = True
    for i in range(i_base + 1, len(E) + 1):
        before, now = E[i - 2], E[i - 1]
        past = E[: i - 1]
        kr1 = now in past
        kr2 = now == before and before not in R
        if kr1 and not kr2:
            R.append(now)
            eta += 1
        if now in R:
            j = max(p for p in range(1, i) if E[p - 1] == now)
            error_p = math.hypot(P[i - 1][0] - P[j - 1][0], P[i - 1][1] - P[j - 1][1])
            difference = P[i - 1][2] - P[j - 1][2]
            error_th = abs(wrap(difference) if wrapped else difference)
            kc1 = now in C and error_p < delta_p and error_th < delta_th
            kc2 = now == before and before in Rc
            if {"and": kc1 and kc2, "or": kc1 or kc2, "and-not": kc1 and not kc2}[line_25]:
                Rc.append(now)
                eta_c += 1
                rc = True
            else:
                rc = False
        if rc and before not in C:
            C.append(before)
    return eta, eta_c


def energy(estimate: Any, truth: Any, pairs: Any) -> tuple[float, float]:
    """Energy Metric from homogeneous matrices: (translation, rotation)."""

    def matrix(pose: Any) -> Floats:
        c, s = math.cos(pose[2]), math.sin(pose[2])
        return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])

    translation = rotation = 0.0
    for i, j in pairs:
        relation = np.linalg.inv(matrix(estimate[i])) @ matrix(estimate[j])
        true = np.linalg.inv(matrix(truth[i])) @ matrix(truth[j])
        error = np.linalg.inv(true) @ relation
        translation += error[0, 2] ** 2 + error[1, 2] ** 2
        rotation += math.atan2(error[1, 0], error[0, 0]) ** 2
    return translation / len(pairs), rotation / len(pairs)
