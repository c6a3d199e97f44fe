"""Exact nearest-template search: the same id and error as comparing with every template.

The error of a template is the sum of absolute differences to the view at its best horizontal
shift; the smallest wins, the lowest id among equals. What cannot win is skipped by lower bounds:

1. Templates are kept in buckets of equal mean. When nothing is shifted out of the image, the
   difference of the means bounds the error; the search walks outwards while it can still win.
2. Within a bucket, blocks of templates lie cell by cell side by side as bytes. A cell is a pixel,
   or the mean of a column piece of a large template. The differences of the bytes, less what
   rounding to bytes can have done, are computed for a whole block at once, and given up as soon as
   all of them are too large.
3. For large templates, the difference of all pixels in single precision.

What is left is compared in double precision, summed in row order.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.slam.growing import grown
from vibrissa.slam.template_bounds import (
    MOST,
    TOGETHER,
    UNROLLED,
    best_shift,
    cell_bounds,
    pixel_bounds,
    quantise,
)

BUCKETS: Final = 256
FINE_CELLS: Final = 64
"""Templates of at most so many pixels have a cell per pixel."""
LANES_SMALL: Final = 128
LANES_LARGE: Final = 64
"""Templates per block: few of many pixels, and enough for loops over bytes to be vectors."""
MOST_LEVELS: Final = 255 // TOGETHER
"""Differences of so many levels, TOGETHER of them added up, fit a byte."""
FEW: Final = 4
"""Candidates of a block from which on the single-precision costs are worth computing."""
SINGLE_EPSILON: Final = 1.2e-7

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Places = NDArray[np.uint64]


class TemplateIndex:
    """Templates float64[rows, columns], values in [0, 1], found by least absolute difference.

    margin: largest shift, columns; step: between shifts; panoramic: shifts wrap around.
    """

    def __init__(self, rows: int, columns: int, margin: int, step: int, panoramic: bool) -> None:
        self._margin = 0 if panoramic else margin
        self._step, self._panoramic = step, panoramic
        self._templates = np.zeros((64, rows, columns), dtype=np.float64)
        self._means = np.zeros(64, dtype=np.float64)
        self._count = 0
        small = rows * columns <= FINE_CELLS
        lanes = LANES_SMALL if small else LANES_LARGE
        self._rows_per_cell = next(
            r
            for r in range(1, rows + 1)
            if r == rows or rows // r * columns <= FINE_CELLS
            if rows % r == 0
        )
        groups = rows // self._rows_per_cell
        compared = columns - 2 * self._margin
        shifts = range(0, columns if panoramic else 2 * self._margin + 1, step)
        x, group = np.arange(compared), np.arange(groups)[:, None]
        used = min(groups * max(compared, 0), MOST)
        padded = -(-used // UNROLLED) * UNROLLED
        # which cell of a template lies under each compared cell of the view, for every shift;
        # the padding compares the view's 0 with the cell behind the last one, which stays 0
        self._mine = (group * columns + self._margin + x).ravel()[:used]
        self._under = np.full((len(shifts), padded), groups * columns, dtype=np.uint64)
        for row, shift in zip(self._under, shifts, strict=True):
            row[:used] = (group * columns + (x + shift) % columns).ravel()[:used]
        self._levels = min(MOST_LEVELS, MOST // max(used, 1))
        self._rounding = 0.0
        self._scratch = np.zeros(groups * columns, dtype=np.uint8)
        # blocks of templates of one bucket, chained from `first` to `tail`
        self._first = np.full(BUCKETS, -1, dtype=np.int64)
        self._tail = np.full(BUCKETS, -1, dtype=np.int64)
        self._next = np.full(16, -1, dtype=np.int64)
        self._filled = np.zeros(16, dtype=np.int64)
        self._ids = np.zeros((16, lanes), dtype=np.int64)
        self._cells = np.zeros((16, groups * columns + 1, lanes), dtype=np.uint8)
        fine = (0, 0, 0) if small else (rows, columns, lanes)
        self._pixels = np.zeros((16, *fine), dtype=np.float32)
        self._blocks = 0

    def __len__(self) -> int:
        return self._count

    @property
    def templates(self) -> Floats:
        """float64[n, rows, columns] in order of creation (a view)."""
        return self._templates[: self._count]

    @property
    def means(self) -> Floats:
        """float64[n] (a view)."""
        return self._means[: self._count]

    @property
    def nbytes(self) -> int:
        """Memory held, bytes."""
        arrays = (self._templates, self._means, self._next, self._filled, self._ids, self._cells)
        return sum(a.nbytes for a in (*arrays, self._pixels, self._first, self._tail))

    def add(self, template: Floats, mean: float) -> int:
        """Keep a template float64[rows, columns] with its mean; return its id."""
        new = self._count
        self._templates = grown(self._templates, new + 1)
        self._means = grown(self._means, new + 1)
        self._templates[new] = template
        self._means[new] = mean
        self._count += 1
        bucket = _bucket(mean)
        block = int(self._tail[bucket])
        if block < 0 or self._filled[block] == self._ids.shape[1]:
            block = self._new_block(bucket)
        lane = int(self._filled[block])
        self._ids[block, lane] = new
        rounding = quantise(template, self._rows_per_cell, self._levels, self._scratch)
        # unused lanes repeat a template, so that they never bound the sums of a block
        self._cells[block, :-1, lane:] = self._scratch[:, np.newaxis]
        self._rounding = max(self._rounding, rounding)
        if self._pixels.size:
            self._pixels[block, :, :, lane] = template
        self._filled[block] += 1
        return new

    def nearest(
        self, template: Floats, mean: float, tolerance: float, hint: int = -1
    ) -> tuple[int, float, int]:
        """(id, cost, shift) of the (cost, id)-smallest template with a mean within `tolerance`.

        (-1, inf, 0) when there is none. hint: a template to look at first, -1 for none.
        """
        return _search(
            template,
            mean,
            self._mine,
            self._templates,
            self._means,
            self._first,
            self._next,
            self._filled,
            self._ids,
            self._cells,
            self._pixels,
            self._under,
            tolerance,
            self._rows_per_cell,
            self._levels,
            self._rounding,
            self._margin,
            self._step,
            self._panoramic,
            hint,
        )

    def _new_block(self, bucket: int) -> int:
        block = self._blocks
        self._blocks += 1
        self._next = grown(self._next, block + 1)
        self._filled = grown(self._filled, block + 1)
        self._ids = grown(self._ids, block + 1)
        self._cells = grown(self._cells, block + 1)
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
def _search(
    view: Floats,
    mean: float,
    compared: Ints,
    templates: Floats,
    means: Floats,
    first: Ints,
    following: Ints,
    filled: Ints,
    ids: Ints,
    cells: Bytes,
    pixels: Floats32,
    under: Places,
    tolerance: float,
    rows_per_cell: int,
    levels: int,
    rounding: float,
    margin: int,
    step: int,
    panoramic: bool,
    hint: int,
) -> tuple[int, float, int]:
    """See TemplateIndex.nearest."""
    size = view.size
    lanes = ids.shape[1]
    whole = panoramic or margin == 0
    large = pixels.size > 0
    mine = np.zeros(under.shape[1], dtype=np.uint8)
    quantised = np.empty(cells.shape[1] - 1, dtype=np.uint8)
    rounding += quantise(view, rows_per_cell, levels, quantised)
    for p in range(compared.shape[0]):
        mine[p] = quantised[compared[p]]
    # a template of cost c has cell sums up to c levels_per_cost + doubt
    levels_per_cost = levels / rows_per_cell
    doubt = compared.shape[0] * rounding
    slack = (size + 4) * SINGLE_EPSILON
    view32 = view.astype(np.float32) if large else np.empty((0, 0), dtype=np.float32)
    found, least, shift = -1, np.inf, 0
    if hint >= 0 and abs(mean - means[hint]) <= tolerance:
        least, shift = best_shift(view, templates[hint], margin, step, panoramic, np.inf)
        found = hint
    limit = _limit(least, levels_per_cost, doubt)
    partial = np.empty(lanes, dtype=np.uint16)
    bound = np.empty(lanes, dtype=np.uint16)
    fine_partial = np.empty(lanes, dtype=np.float32)
    fine = np.zeros(lanes, dtype=np.float32)
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
            if cell_bounds(mine, under, cells[block], limit, partial, bound) <= limit:
                nearest = 0
                survivors = 0
                for lane in range(used):
                    survivors += bound[lane] <= limit
                    if bound[lane] < bound[nearest]:
                        nearest = lane
                compared_fine = large and survivors > FEW
                if compared_fine:
                    most = least * (1.0 + slack) + slack
                    pixel_bounds(
                        view32,
                        pixels[block],
                        used,
                        margin,
                        step,
                        panoramic,
                        most,
                        fine_partial,
                        fine,
                    )
                    for lane in range(used):
                        if fine[lane] < fine[nearest]:
                            nearest = lane
                for turn in range(-1, used):
                    lane = nearest if turn < 0 else turn
                    if turn == nearest or bound[lane] > limit:
                        continue
                    if compared_fine and fine[lane] > least * (1.0 + slack) + slack:
                        continue
                    candidate = ids[block, lane]
                    if candidate == hint or abs(mean - means[candidate]) > tolerance:
                        continue
                    cost, at = best_shift(
                        view, templates[candidate], margin, step, panoramic, least
                    )
                    if cost < least or (cost == least and candidate < found):
                        found, least, shift = candidate, cost, at
                        limit = _limit(least, levels_per_cost, doubt)
            block = following[block]
    return found, least, shift


@compiled
def _limit(cost: float, levels_per_cost: float, doubt: float) -> int:
    """The largest cell sum of a template whose cost is at most `cost`."""
    return int(min(cost * levels_per_cost * (1.0 + 1e-12) + doubt + 1e-6, float(MOST)))
