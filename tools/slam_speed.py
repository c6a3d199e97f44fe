"""How fast the parts of RatSLAM are, how that grows with the work, and what they remember.

Peers: the plain NumPy formulas, run here and now, and the figures of OpenRatSLAM (C++, -O2) on
another machine of the same class, which are quoted.
"""

from __future__ import annotations

import functools
import gc
import math
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.slam.config import IRAT, ST_LUCIA, WHISKER, RatSlamConfig
from vibrissa.slam.experience_map import ExperienceMap
from vibrissa.slam.interface import Odometry
from vibrissa.slam.local_view import LocalView
from vibrissa.slam.optimum import optimise
from vibrissa.slam.pose_cells import PoseCells
from vibrissa.slam.ratslam import RatSlam
from vibrissa.tools import plain_ratslam as plain

Floats = NDArray[np.float64]
Row = dict[str, Any]

SEED: Final = 1
FAR_EVERY: Final = 20
"""An injection far from the packet comes every so many iterations."""
GROUP_S: Final = 0.001
"""Calls shorter than this are timed in groups of about this length: less than a turn of the
scheduler, so that on a shared machine most groups run undisturbed and the median is one of them."""
SMALL: Final = replace(WHISKER, vt_match_threshold=0.03)
"""Templates of 18 pixels, at the threshold OpenRatSLAM was timed with."""
LARGE: Final = replace(
    ST_LUCIA, image_crop_x_min=0, image_crop_x_max=-1, image_crop_y_min=0, image_crop_y_max=-1
)
"""Templates of 600 pixels, shifted up to 5 columns each way."""

OPENRATSLAM_US: Final = {
    "pose cells 11x11x36": 580.0,
    "pose cells 21x21x36": 1211.0,
    "pose cells 30x30x36": 1515.0,
    "step 11x11x36": 386.0,
    "18 pixels, 10000 templates, equal": 196.0,
    "18 pixels, 10000 templates, spread": 122.0,
    "600 pixels, 10000 templates, equal": 42_300.0,
    "600 pixels, 10000 templates, spread": 14_800.0,
}
"""OpenRatSLAM -O2, the lower end of what was measured, us."""
OPENRATSLAM_LINK_NS: Final = 22.0


@dataclass(frozen=True, slots=True)
class Sizes:
    """How much a bench measures: medians over `groups` groups of calls."""

    groups: int
    templates: tuple[int, ...]
    large_templates: int
    experiences: tuple[int, ...]
    steps: int


FULL: Final = Sizes(
    101, (1_000, 10_000, 100_000, 1_000_000), 10_000, (100, 1_000, 5_000, 10_000, 100_000), 2000
)
QUICK: Final = Sizes(3, (300, 3_000), 100, (100, 1_000), 60)


def median_us(call: Callable[[], object], groups: int) -> float:
    """Median time of a call, us, after three that are not counted."""
    once = math.inf
    for _ in range(3):
        start = time.perf_counter()
        call()
        once = min(once, time.perf_counter() - start)
    calls = max(1, min(10_000, int(GROUP_S / max(once, 1e-9))))
    found = []
    gc.disable()
    try:
        for _ in range(groups if once < 0.05 else min(groups, 3)):
            start = time.perf_counter()
            for _ in range(calls):
                call()
            found.append((time.perf_counter() - start) / calls)
    finally:
        gc.enable()
    return float(np.median(found)) * 1e6


def row(what: str, us: float, plain_us: float) -> Row:
    """A speed beside its peers; NaN where one was not measured."""
    original = OPENRATSLAM_US.get(what, math.nan)
    return {
        "what": what,
        "us": us,
        "plain NumPy us": plain_us,
        "times faster": plain_us / us,
        "OpenRatSLAM us": original,
        "times faster than it": original / us,
    }


# ------------------------------------------------------------------------------- pose cells


def pose_cell_rows(sizes: Sizes) -> list[Row]:
    """Iterations of the network on three grids, and whole steps of RatSLAM."""
    rows = []
    for n in (11, 21, 30):
        config = replace(IRAT, pc_dim_xy=n)
        us = median_us(wandering(config), sizes.groups)
        rows.append(row(f"pose cells {n}x{n}x36", us, plain_iteration_us(config, sizes.groups)))
    rows.append(row("step 11x11x36", step_us(sizes), math.nan))
    return rows


def wandering(config: RatSlamConfig) -> Callable[[], object]:
    """One iteration of a network that moves and is now and then called elsewhere."""
    rng = np.random.default_rng(SEED)
    network = PoseCells(config)
    for view in range(40):
        network.on_view_template(view)
        network.on_odo(0.9 * config.pc_cell_x_size, 0.2, 1.0)
    v = (rng.uniform(0.0, 1.0, 1000) * config.pc_cell_x_size).tolist()
    w = rng.normal(0.0, 0.1, 1000).tolist()
    count = 0

    def iterate() -> None:
        nonlocal count
        if count % FAR_EVERY == 0:
            network.on_view_template(count // FAR_EVERY % 30)
        network.on_odo(v[count % 1000], w[count % 1000], 1.0)
        count += 1

    return iterate


def plain_iteration_us(config: RatSlamConfig, groups: int) -> float:
    """The same iteration by the plain formulas."""
    network = PoseCells(config)
    for _ in range(50):
        network.on_odo(0.0, 0.0, 1.0)
    cells = network.cells.copy()

    def iterate() -> None:
        moved = plain.move(plain.stages(cells, config.pc_global_inhib)[3], 0.5, 0.1, corners=True)
        plain.read_out(moved)

    return median_us(iterate, min(groups, 3))


def step_us(sizes: Sizes) -> float:
    """A whole step of RatSLAM, iRat's network, 18-pixel images of a ring of places."""
    config = replace(
        SMALL, pc_dim_xy=11, pc_cell_x_size=0.05, pc_vt_inject_energy=0.05, exp_loops=20
    )
    images = np.random.default_rng(SEED).integers(0, 256, (60, 3, 6)).astype(np.uint8)
    slam = RatSlam(config)
    odometry = Odometry(0.04, 2.0 * math.pi / 60, 1.0)
    times = []
    for number in range(sizes.steps):
        image = images[number % 60]
        start = time.perf_counter()
        slam.step(image, odometry)
        times.append(time.perf_counter() - start)
    return float(np.median(times[len(times) // 4 :])) * 1e6


# -------------------------------------------------------------------------------- templates


def library(
    config: RatSlamConfig, count: int, equal: bool
) -> tuple[LocalView, NDArray[np.float64], NDArray[np.float64]]:
    """A local view of `count` templates, with unseen images and slightly changed seen ones.

    equal: all templates are permutations of one, so that no mean rules any out; else their pixels
    are drawn independently.
    """
    rng = np.random.default_rng(SEED)
    rows, columns = config.template_y_size, config.template_x_size
    one = rng.integers(0, 256, rows * columns).astype(np.uint8)

    def images(number: int) -> NDArray[np.uint8]:
        if equal:
            drawn = rng.permuted(np.tile(one, (number, 1)), axis=1)
        else:
            drawn = rng.integers(0, 256, (number, rows * columns), dtype=np.uint8)
        return drawn.reshape(number, rows, columns)

    view = LocalView(config)
    seen = []
    made = 0
    while made < count:
        batch = images(min(count - made, 20_000)) / 255.0
        for template in batch:
            view.add(template)
        seen += list(batch[:: max(1, len(batch) * count // (50 * count))][:50])
        made += len(batch)
    changed = np.clip(np.array(seen[:50]) + rng.integers(-1, 2, (1, rows, columns)) / 255.0, 0, 1)
    return view, images(50) / 255.0, changed


def match_us(view: LocalView, queries: NDArray[np.float64], groups: int) -> float:
    """Median time of a search, us, over a set of queries."""
    means = [float(query.mean()) for query in queries]

    def search() -> None:
        for query, mean in zip(queries, means, strict=True):
            view.nearest(query, mean)

    return median_us(search, groups) / len(queries)


def plain_match_us(config: RatSlamConfig, view: LocalView, query: Floats) -> float:
    """Exhaustive search by the plain formulas, from at most 1,000 templates."""
    templates = view.templates[:1000]
    used = median_us(
        lambda: plain.match(
            query,
            templates,
            config.vt_match_threshold + 0.005,
            config.vt_shift_match,
            config.vt_step_match,
            False,
        ),
        1,
    )
    return used * len(view) / len(templates)


def template_rows(sizes: Sizes) -> tuple[list[Row], list[Row]]:
    """Speeds beside the peers, and how they grow with the number of templates."""
    speeds, growth = [], []
    for equal in (False, True):
        kind = "equal" if equal else "spread"
        for count in sizes.templates:
            view, unseen, seen = library(SMALL, count, equal)
            us = match_us(view, unseen, sizes.groups)
            what = f"18 pixels, {count} templates, {kind}"
            speeds.append(row(what, us, plain_match_us(SMALL, view, unseen[0])))
            again = match_us(view, seen, sizes.groups)
            growth.append({"templates": count, "means": kind, "unseen us": us, "seen us": again})
        count = sizes.large_templates
        view, unseen, _ = library(LARGE, count, equal)
        what = f"600 pixels, {count} templates, {kind}"
        us = match_us(view, unseen[:5], min(sizes.groups, 3))
        speeds.append(row(what, us, plain_match_us(LARGE, view, unseen[0])))
    return speeds, growth


# -------------------------------------------------------------------------------- experiences


def wandered_map(count: int, loops: int = 20, seed: int = SEED) -> ExperienceMap:
    """A map of `count` experiences on a noisy ring, with a loop closure for every seventh."""
    rng = np.random.default_rng(seed)
    around = max(10, min(count // 3, 400))
    turns = 2.0 * math.pi / around + rng.normal(0.0, 0.02, count)
    heading = (np.cumsum(turns) + math.pi) % (2.0 * math.pi) - math.pi
    steps = 0.05 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    poses = np.column_stack([np.cumsum(steps, axis=0), heading])
    links = [(i, i + 1) for i in range(count - 1)]
    values = [(0.05, turn, turn, 1.0) for turn in turns[1:].tolist()]
    for late in range(around, count, 7):
        links.append((late - around, late))
        values.append((0.0, 0.0, 0.0, 1.0))
    order = np.argsort([a for a, _ in links], kind="stable")
    arrays: dict[str, NDArray[Any]] = {
        "poses": poses,
        "links": np.array(links, dtype=np.int32)[order],
        "link_values": np.array(values, dtype=np.float64)[order],
        "current": np.array(0),
        "agent": np.zeros(4),
    }
    return ExperienceMap.from_arrays(replace(IRAT, exp_loops=loops), arrays)


def relaxation_rows(sizes: Sizes) -> list[Row]:
    """Relaxation by the number of experiences: us per call of 20 sweeps, ns per link visit."""
    rows = []
    for count in sizes.experiences:
        emap = wandered_map(count)
        links = len(emap.links())
        us = median_us(emap.iterate, sizes.groups)
        arrays = emap.to_arrays()
        one = math.nan
        if count <= 10_000:
            state = arrays["poses"], arrays["links"], arrays["link_values"]
            one = median_us(functools.partial(plain.relax, *state, 1, 0.5), 1)
        optimum = math.nan
        if count <= 10_000:
            start = time.perf_counter()
            optimise(arrays["poses"], arrays["links"], arrays["link_values"])
            optimum = (time.perf_counter() - start) * 1e3
        rows.append(
            {
                "experiences": count,
                "links": links,
                "20 sweeps us": us,
                "ns per link visit": us * 1e3 / (20 * links),
                "plain NumPy ns": one * 1e3 / links,
                "OpenRatSLAM ns": OPENRATSLAM_LINK_NS,
                "exact optimum ms": optimum,
            }
        )
    return rows


# ------------------------------------------------------------------------------------- memory


def memory_rows(count: int) -> list[Row]:
    """Bytes that a template and an experience with its links take, room for growth included."""

    def templates() -> object:
        return library(SMALL, count, equal=False)[0]

    def experiences() -> object:
        slam = RatSlam(replace(SMALL, exp_loops=0))
        rng = np.random.default_rng(SEED)
        images = rng.integers(0, 256, (count, 3, 6)).astype(np.uint8)
        for image in images:
            slam.step(image, Odometry(0.1, 0.0, 1.0))
        return slam

    rows = []
    for what, make in (
        ("template, 18 pixels", templates),
        ("experience, its view and link", experiences),
    ):
        make()
        tracemalloc.start()
        kept = make()
        gc.collect()
        used, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        if isinstance(kept, RatSlam):
            used -= kept.local_view.nbytes
        rows.append({"what": what, "count": count, "bytes each": used / count})
        del kept
    return rows


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Slope of log time over log size, by least squares: 1 = linear."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
