"""The local view: recognise an image among the templates seen before, or make a new one.

Source: OpenRatSLAM's LocalViewMatch. The error of a template is the mean absolute difference to
the view at its best horizontal shift; the smallest error wins, the lowest id among equals. As in
the original, templates whose mean differs by more than the threshold + 0.005 are not looked at.

The search is exact and skips what cannot win: templates are kept in buckets of equal mean, from
which the search walks outwards while the difference of the means (a lower bound of the error when
nothing is shifted out of the image) can still win. Within a bucket, blocks of templates lie pixel
by pixel side by side: the difference of the column sums is a second lower bound and the difference
in single precision a third, each computed for the whole block at once.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.slam.angles import PI, TAU
from vibrissa.slam.config import RatSlamConfig
from vibrissa.slam.growing import grown
from vibrissa.slam.template import Image, Template, TemplateBuilder, mean_value

MEAN_TOLERANCE: Final = 0.005
BUCKETS: Final = 1024
SMALL_TEMPLATE: Final = 64
LANES_SMALL: Final = 64
LANES_LARGE: Final = 16
"""Templates per block: many of few pixels, few of many."""
FEW: Final = 4
"""Candidates of a block from which on the single-precision costs are worth computing."""

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class View:
    """The outcome for one image.

    `error` is the mean absolute difference (0 to 1) of the best template, and a huge number when
    no template was compared. `relative_rad`: heading now minus heading stored (panoramic only).
    """

    template: int
    new: bool
    error: float
    relative_rad: float
    mean: float


class LocalView:
    """Templates and their search. Every image gets the id of a template, a known or a new one."""

    def __init__(self, config: RatSlamConfig) -> None:
        self._config = config
        self._builder = TemplateBuilder(config)
        rows, columns = config.template_y_size, config.template_x_size
        self._templates = np.zeros((64, rows, columns), dtype=np.float64)
        self._means = np.zeros(64, dtype=np.float64)
        self._count = 0
        self._last = -1
        self._lanes = LANES_SMALL if rows * columns <= SMALL_TEMPLATE else LANES_LARGE
        # blocks of templates of one bucket, chained from `first` to `last`
        self._first = np.full(BUCKETS, -1, dtype=np.int64)
        self._tail = np.full(BUCKETS, -1, dtype=np.int64)
        self._next = np.full(16, -1, dtype=np.int64)
        self._filled = np.zeros(16, dtype=np.int64)
        self._ids = np.zeros((16, self._lanes), dtype=np.int64)
        self._sums = np.zeros((16, columns, self._lanes), dtype=np.float32)
        self._pixels = np.zeros((16, rows, columns, self._lanes), dtype=np.float32)
        self._blocks = 0

    def __len__(self) -> int:
        return self._count

    @property
    def templates(self) -> NDArray[np.float64]:
        """float64[n, rows, columns] in order of creation (a view)."""
        return self._templates[: self._count]

    def check(self, image: Image) -> None:
        """Raise SlamInputError unless the image can be used; changes nothing."""
        self._builder.check(image)

    def on_image(self, image: Image) -> View:
        """Match one image; a template is added when none is within the threshold.

        Raises SlamInputError for an image of the wrong type or shape; nothing changes then.
        """
        template = self._builder.build(image)
        mean = float(mean_value(template))
        found, error, shift = self._search(template, mean)
        if error <= self._config.vt_match_threshold:
            self._last = found
            return View(found, False, error, self._relative_heading(shift), mean)
        self._add(template, mean)
        self._last = self._count - 1
        return View(self._last, True, error, 0.0, mean)

    def _search(self, template: Template, mean: float) -> tuple[int, float, int]:
        """Best template, its error and shift."""
        c = self._config
        if self._count == 0:
            return -1, sys.float_info.max, 0
        compared = c.columns_compared * c.template_y_size
        tolerance = c.vt_match_threshold + MEAN_TOLERANCE
        if compared <= 0:
            # OpenRatSLAM compares no columns here: cost 0 over a negative count, always a match
            close = abs(mean - float(self._means[0])) <= tolerance
            nothing = np.float64(0.0 if close else sys.float_info.max)
            with np.errstate(divide="ignore", invalid="ignore"):
                return 0, float(nothing / np.float64(compared)), 0
        found, cost, shift = _search(
            template,
            mean,
            self._templates,
            self._means,
            self._first,
            self._next,
            self._filled,
            self._ids,
            self._sums,
            self._pixels,
            tolerance,
            0 if c.vt_panoramic else c.vt_shift_match,
            c.vt_step_match,
            c.vt_panoramic,
            self._last,
        )
        return found, (cost if found >= 0 else sys.float_info.max) / compared, shift

    def _relative_heading(self, shift: int) -> float:
        if not self._config.vt_panoramic:
            return 0.0
        angle = shift / self._config.template_x_size * TAU
        return angle - TAU if angle > PI else angle

    def _add(self, template: Template, mean: float) -> None:
        new = self._count
        self._templates = grown(self._templates, new + 1)
        self._means = grown(self._means, new + 1)
        self._templates[new] = template
        self._means[new] = mean
        self._count += 1
        bucket = _bucket(mean)
        block = int(self._tail[bucket])
        if block < 0 or self._filled[block] == self._lanes:
            block = self._new_block(bucket)
        lane = int(self._filled[block])
        self._ids[block, lane] = new
        self._sums[block, :, lane] = template.sum(axis=0)
        self._pixels[block, :, :, lane] = template
        self._filled[block] += 1

    def _new_block(self, bucket: int) -> int:
        block = self._blocks
        self._blocks += 1
        self._next = grown(self._next, block + 1)
        self._filled = grown(self._filled, block + 1)
        self._ids = grown(self._ids, block + 1)
        self._sums = grown(self._sums, block + 1)
        self._pixels = grown(self._pixels, block + 1)
        self._next[block] = -1
        self._filled[block] = 0
        tail = int(self._tail[bucket])
        if tail < 0:
            self._first[bucket] = block
        else:
            self._next[tail] = block
        self._tail[bucket] = block
        return block


@compiled
def _bucket(mean: float) -> int:
    return min(max(int(mean * BUCKETS), 0), BUCKETS - 1)


@compiled
def _cost(
    view: Template,
    template: Template,
    margin: int,
    offset: int,
    panoramic: bool,
    limit: float,
) -> float:
    """Sum of absolute differences at one shift, in row order; given up when above `limit`."""
    rows, columns = view.shape
    cost = 0.0
    for y in range(rows):
        if panoramic:
            for x in range(columns):
                cost += abs(view[y, x] - template[y, (x + offset) % columns])
        else:
            for x in range(columns - 2 * margin):
                cost += abs(view[y, margin + x] - template[y, offset + x])
        if cost > limit:
            break
    return cost


@compiled
def _best_shift(
    view: Template, template: Template, margin: int, step: int, panoramic: bool, limit: float
) -> tuple[float, int]:
    """Least cost over all shifts (the first among equals), or something above `limit`."""
    shifts = view.shape[1] if panoramic else 2 * margin + 1
    least = np.inf
    at = 0
    for offset in range(0, shifts, step):
        cost = _cost(view, template, margin, offset, panoramic, min(limit, least))
        if cost < least:
            least = cost
            at = offset
    return least, at


@compiled
def _column_bounds(
    view_sums: Floats32,
    sums: Floats32,
    used: int,
    margin: int,
    step: int,
    panoramic: bool,
    partial: Floats32,
    bound: Floats32,
) -> None:
    """Difference of the column sums at the best shift, for every lane of a block."""
    columns = view_sums.shape[0]
    compared = columns if panoramic else columns - 2 * margin
    shifts = columns if panoramic else 2 * margin + 1
    bound[:used] = np.float32(np.inf)
    for offset in range(0, shifts, step):
        partial[:used] = np.float32(0.0)
        for x in range(compared):
            mine = view_sums[margin + x]
            theirs = sums[(x + offset) % columns]
            for lane in range(used):
                partial[lane] += abs(mine - theirs[lane])
        for lane in range(used):
            bound[lane] = min(bound[lane], partial[lane])


@compiled
def _pixel_bounds(
    view: Floats32,
    pixels: Floats32,
    used: int,
    margin: int,
    step: int,
    panoramic: bool,
    limit: float,
    partial: Floats32,
    bound: Floats32,
) -> None:
    """Cost in single precision at the best shift, for every lane; given up above `limit`."""
    rows, columns = view.shape
    compared = columns if panoramic else columns - 2 * margin
    shifts = columns if panoramic else 2 * margin + 1
    bound[:used] = np.float32(np.inf)
    for offset in range(0, shifts, step):
        partial[:used] = np.float32(0.0)
        for y in range(rows):
            for x in range(compared):
                mine = view[y, margin + x]
                theirs = pixels[y, (x + offset) % columns]
                for lane in range(used):
                    partial[lane] += abs(mine - theirs[lane])
            least = np.float32(np.inf)
            for lane in range(used):
                least = min(least, partial[lane])
            if least > limit:
                break
        for lane in range(used):
            bound[lane] = min(bound[lane], partial[lane])


@compiled
def _search(
    view: Template,
    mean: float,
    templates: NDArray[np.float64],
    means: Floats,
    first: Ints,
    following: Ints,
    filled: Ints,
    ids: NDArray[np.int64],
    sums: NDArray[np.float32],
    pixels: NDArray[np.float32],
    tolerance: float,
    margin: int,
    step: int,
    panoramic: bool,
    hint: int,
) -> tuple[int, float, int]:
    """The (cost, id)-smallest template with a mean within tolerance; -1 when there is none."""
    rows, columns = view.shape
    size = rows * columns
    whole = panoramic or margin == 0
    # what rounding in single precision can add to the lower bounds
    column_slack = (columns + 4) * size * 1.2e-7
    pixel_slack = (size + 4) * 1.2e-7
    view32 = view.astype(np.float32)
    view_sums = np.zeros(columns, dtype=np.float32)
    for x in range(columns):
        total = 0.0
        for y in range(rows):
            total += view[y, x]
        view_sums[x] = total
    found, least, shift = -1, np.inf, 0
    if hint >= 0 and abs(mean - means[hint]) <= tolerance:
        least, shift = _best_shift(view, templates[hint], margin, step, panoramic, np.inf)
        found = hint
    bound = np.empty(ids.shape[1], dtype=np.float32)
    partial = np.empty(ids.shape[1], dtype=np.float32)
    home = _bucket(mean)
    low = _bucket(mean - tolerance - 1e-9)
    high = _bucket(mean + tolerance + 1e-9)
    for ring in range(2 * max(home - low, high - home) + 1):
        away = (ring + 1) // 2
        bucket = home + away if ring % 2 == 0 else home - away
        if bucket < low or bucket > high or first[bucket] < 0:
            continue
        if whole and away > 0:
            gap = bucket / BUCKETS - mean if bucket > home else mean - (bucket + 1) / BUCKETS
            if (gap - 1e-9) * size > least:
                continue
        block = first[bucket]
        while block >= 0:
            used = filled[block]
            _column_bounds(view_sums, sums[block], used, margin, step, panoramic, partial, bound)
            slack, growth = column_slack, 0.0
            survivors = 0
            for lane in range(used):
                survivors += bound[lane] <= least + slack
            if survivors > FEW:
                slack, growth = pixel_slack, pixel_slack
                _pixel_bounds(
                    view32,
                    pixels[block],
                    used,
                    margin,
                    step,
                    panoramic,
                    least * (1.0 + growth) + slack,
                    partial,
                    bound,
                )
            nearest = 0
            for lane in range(1, used):
                if bound[lane] < bound[nearest]:
                    nearest = lane
            for turn in range(-1, used):
                lane = nearest if turn < 0 else turn
                if turn == nearest or bound[lane] > least * (1.0 + growth) + slack:
                    continue
                candidate = ids[block, lane]
                if candidate == hint or abs(mean - means[candidate]) > tolerance:
                    continue
                cost, at = _best_shift(view, templates[candidate], margin, step, panoramic, least)
                if cost < least or (cost == least and candidate < found):
                    found, least, shift = candidate, cost, at
            block = following[block]
    return found, least, shift
