"""Run time against error for every approximation that RatSLAM makes."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.slam.config import WHISKER, RatSlamConfig
from vibrissa.slam.experience_map import ExperienceMap
from vibrissa.slam.optimum import Optimum, map_cost, optimise
from vibrissa.slam.pose_cells import PoseCells
from vibrissa.tools import plain_ratslam as plain
from vibrissa.tools.slam_speed import SEED, SMALL, Sizes, library, match_us, median_us, wandered_map

Floats = NDArray[np.float64]
Row = dict[str, Any]

TORUS: Final = 1.26
"""m: the torus is as wide on every grid."""
STEP: Final = 0.01
"""m per whisk of the path that is integrated."""
GRIDS: Final = (11, 15, 21, 31, 43, 63)
TRUNCATIONS: Final = (2e-7, 2e-6, 2e-5, 2e-4, 1e-3, 2e-3)
LOOPS: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500)


def grid_rows(steps: int) -> list[Row]:
    """The finer the grid, the nearer the packet follows the odometry."""
    rows = []
    for n in GRIDS:
        config = replace(WHISKER, pc_dim_xy=n, pc_cell_x_size=TORUS / n)
        error, us, _ = followed(config, steps)
        rows.append(
            {"grid": f"{n}x{n}x36", "cell mm": 1e3 * TORUS / n, "us": us, "error mm": error}
        )
    return rows


def truncation_rows(steps: int) -> list[Row]:
    """What global inhibition cuts off the packet saves work and changes how it moves."""
    rows = []
    for level in TRUNCATIONS:
        error, us, active = followed(replace(WHISKER, pc_global_inhib=level), steps)
        rows.append({"pc_global_inhib": level, "active cells": active, "us": us, "error mm": error})
    return rows


def precision_rows(steps: int) -> list[Row]:
    """The network in single precision against double, over the same motion."""
    networks = [PoseCells(WHISKER), PoseCells(WHISKER)]
    single = networks[1]
    for name in ("_work", "_excite", "_inhibit", "_best"):
        setattr(single, name, getattr(single, name).astype(np.float32))
    v, w = motion(steps)
    away = []
    for k in range(steps):
        for network in networks:
            network.on_odo(float(v[k]), float(w[k]), 1.0)
        (x0, y0, _), (x1, y1, _) = (network.best for network in networks)
        n = WHISKER.pc_dim_xy
        away.append(max(abs(apart(x0, x1, n)), abs(apart(y0, y1, n))))
    errors = (0.0, max(away) * WHISKER.pc_cell_x_size * 1e3)
    return [
        {
            "precision": name,
            "us": median_us(functools.partial(network.on_odo, STEP, 0.01, 1.0), 51),
            "error mm": error,
        }
        for name, network, error in zip(("double", "single"), networks, errors, strict=True)
    ]


def motion(steps: int) -> tuple[Floats, Floats]:
    """Speeds and turn rates of a wandering path."""
    rng = np.random.default_rng(SEED)
    return np.full(steps, STEP), 0.1 * np.sin(np.arange(steps) / 30.0) + rng.normal(0, 0.02, steps)


def apart(a: float, b: float, length: int) -> float:
    """Signed distance on a ring."""
    return (a - b + length / 2) % length - length / 2


def followed(config: RatSlamConfig, steps: int) -> tuple[float, float, float]:
    """(rms error mm per 0.1 m driven, us per step, active cells) of a packet along a path.

    The network's layer k moves along (sin, cos) of 2 pi k / T, which the path is integrated in.
    """
    network = PoseCells(config)
    for _ in range(30):
        network.on_odo(0.0, 0.0, 1.0)
    v, w = motion(steps)
    n, layers = config.pc_dim_xy, config.pc_dim_th
    every = round(0.1 / STEP)
    errors = []
    _, _, th = network.best
    x, y = 0.0, 0.0
    mark = network.best
    active = []
    for k in range(steps):
        _, _, th = network.best
        angle = th * 2.0 * math.pi / layers
        x += v[k] * math.sin(angle)
        y += v[k] * math.cos(angle)
        network.on_odo(float(v[k]), float(w[k]), 1.0)
        if (k + 1) % every == 0:
            here = network.best
            dx = apart(here[0], mark[0], n) * config.pc_cell_x_size - x
            dy = apart(here[1], mark[1], n) * config.pc_cell_x_size - y
            errors.append(dx * dx + dy * dy)
            x = y = 0.0
            mark = here
            active.append(np.count_nonzero(network.cells))
    rms = math.sqrt(float(np.mean(errors))) * 1e3
    us = median_us(lambda: network.on_odo(STEP, 0.01, 1.0), 51)
    return rms, us, float(np.mean(active))


def relaxation_front(experiences: int) -> list[Row]:
    """Sweeps against the least-squares optimum: cost, and distance of the poses, and time."""
    emap = wandered_map(experiences)
    arrays = emap.to_arrays()
    links, values = arrays["links"], arrays["link_values"]
    best = optimise(arrays["poses"], links, values)
    exact_us = median_us(lambda: optimise(arrays["poses"], links, values), 1)
    rows = []
    for loops in LOOPS:
        relaxed = ExperienceMap.from_arrays(
            replace(WHISKER, exp_loops=loops), {**arrays, "poses": arrays["poses"].copy()}
        )
        relaxed.iterate()
        rows.append(_front_row(f"{loops} sweeps", relaxed.poses, links, values, best))
        rows[-1]["us"] = median_us(relaxed.iterate, 51)
    rows.append(_front_row("exact", best.poses, links, values, best) | {"us": exact_us})
    return rows


def _front_row(what: str, poses: Floats, links: Any, values: Any, best: Optimum) -> Row:
    return {
        "relaxation": what,
        "us": math.nan,
        "cost over optimum": map_cost(poses, links, values) / best.cost,
        "rms distance mm": distance(poses, best.poses) * 1e3,
    }


def distance(poses: Floats, others: Floats) -> float:
    """Root mean square distance of positions after the best rigid alignment, m."""
    a = poses[:, :2] - poses[:, :2].mean(axis=0)
    b = others[:, :2] - others[:, :2].mean(axis=0)
    turn = math.atan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = math.cos(turn), math.sin(turn)
    turned = np.column_stack([c * a[:, 0] - s * a[:, 1], s * a[:, 0] + c * a[:, 1]])
    return float(np.sqrt(((turned - b) ** 2).sum(axis=1).mean()))


def pruning_rows(sizes: Sizes) -> list[Row]:
    """Searches that skip, against searches that compare everything: where do they differ?"""
    rows = []
    for equal in (False, True):
        count = min(sizes.templates[-1], 3000)
        view, unseen, seen = library(SMALL, count, equal)
        templates = view.templates.copy()
        wrong = 0
        queries = [*unseen[:15], *seen[:15]]
        for query in queries:
            found = view.nearest(query, float(query.mean()))
            number, cost, _ = plain.match(
                query, templates, SMALL.vt_match_threshold + 0.005, 0, 1, False
            )
            wrong += found[0] != number or (number >= 0 and found[1] != cost / query.size)
        rows.append(
            {
                "search": "equal means" if equal else "spread means",
                "templates": count,
                "queries": len(queries),
                "different ids or errors": wrong,
                "us": match_us(view, unseen, 3),
            }
        )
    return rows
