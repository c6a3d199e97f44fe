"""The pose-cell network: a packet of activity on a torus of x, y and heading.

Source: OpenRatSLAM's PosecellNetwork. One iteration excites, inhibits, normalises and moves the
packet; the work is confined to the heading layers that hold activity. Positions are in cells:
x, y in [0, pc_dim_xy), heading in [0, pc_dim_th). Heading layer k moves along
(sin 2 pi k/T, cos 2 pi k/T): only distances between poses of this network have a meaning.

In faithful mode these defects of the original are reproduced, which are otherwise fixed:
- a step longer than one cell makes negative weights (fixed: it is split into several iterations);
- path integration loses the activity that leaves two corners of every layer;
- the newest ten templates never inject, except that all of them do while fewer than ten exist
  (fixed: the newest ten never inject);
- a read-out coordinate equal to the length of its axis is not wrapped to 0, and a view remembered
  there never injects;
- a view seen exactly on a cell injects there or one cell lower, as rounding has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled, cos, exp, sin
from vibrissa.slam.angles import TAU
from vibrissa.slam.config import RatSlamConfig
from vibrissa.slam.growing import grown
from vibrissa.slam.interface import (
    ACTION_CREATE_EDGE,
    ACTION_CREATE_NODE,
    ACTION_NONE,
    SlamInputError,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

RECENT_TEMPLATES: Final = 10
MAX_CELLS_PER_STEP: Final = 10_000.0
MAX_TURN_PER_STEP: Final = 1e6
READOUT_HALF_WIDTH: Final = 3
ON_A_CELL: Final = 1e-9


class PoseCellError(RuntimeError):
    """The activity died out: the grid is too small for its kernels and global inhibition."""


@dataclass(frozen=True, slots=True)
class Action:
    """What the network asks the experience map to do, between which experiences."""

    kind: int
    source: int = 0
    target: int = 0


class PoseCells:
    """Pose cells float64[pc_dim_th, pc_dim_xy, pc_dim_xy], their views and their experiences."""

    def __init__(self, config: RatSlamConfig) -> None:
        c = config
        t, n = c.pc_dim_th, c.pc_dim_xy
        self._config = c
        self._cells = np.zeros((t, n, n), dtype=np.float64)
        self._cells[t // 2, n // 2, n // 2] = 1.0
        self._alive = np.zeros(t, dtype=np.uint8)
        self._alive[t // 2] = 1
        self._excite = _kernel(c.pc_w_e_dim, c.pc_w_e_var)
        self._inhibit = _kernel(c.pc_w_i_dim, c.pc_w_i_var)
        self._work = np.zeros((2, t, n * n), dtype=np.float64)
        radius = max(c.pc_w_e_dim, c.pc_w_i_dim) // 2
        self._wrap = np.array([x % n for x in range(-radius, n + radius)], dtype=np.int64)
        self._wide = np.zeros((2, (n + 2 * radius) * (n + 2 * radius)), dtype=np.float64)
        self._angles_xy = _circle(n)
        self._angles_th = _circle(t)
        self._directions = np.array([k * TAU / t for k in range(t)], dtype=np.float64)
        self._best = np.array([n // 2, n // 2, t // 2], dtype=np.float64)
        self._shift = 0.0
        # views: pose (x, y, th) and habituation, first and last experience of each
        self._view_poses = np.empty((64, 3), dtype=np.float64)
        self._view_decay = np.empty(64, dtype=np.float64)
        self._view_first = np.empty(64, dtype=np.int64)
        self._view_last = np.empty(64, dtype=np.int64)
        self._habituated: list[int] = []
        self._views = 0
        self._view = 0
        self._previous_view = 0
        # experiences: pose (x, y, th) and the next experience with the same view
        self._experience_poses = np.empty((64, 3), dtype=np.float64)
        self._experience_views = np.empty(64, dtype=np.int32)
        self._next = np.empty(64, dtype=np.int64)
        self._experiences = 0
        self.current = 0
        self._odo_update = False
        self._view_update = False

    @property
    def cells(self) -> Floats:
        """Activity float64[heading, y, x] (a view)."""
        return self._cells

    @property
    def best(self) -> tuple[float, float, float]:
        """The packet's position: x, y, heading in cells."""
        x, y, th = self._best
        return float(x), float(y), float(th)

    @property
    def views(self) -> int:
        return self._views

    @property
    def experiences(self) -> int:
        return self._experiences

    @property
    def experience_views(self) -> NDArray[np.int32]:
        """int32[n]: the view each experience was created with (a view)."""
        return self._experience_views[: self._experiences]

    def check_odo(self, v: float, w: float, dt: float) -> None:
        """Raise SlamInputError unless the step can be integrated; changes nothing."""
        cells = abs(v * dt / self._config.pc_cell_x_size)
        if not cells <= MAX_CELLS_PER_STEP:
            raise SlamInputError(
                f"odometry v: expected at most {MAX_CELLS_PER_STEP:g} cells per step,"
                f" found {cells:g}"
            )
        if not abs(w * dt) <= MAX_TURN_PER_STEP:
            raise SlamInputError(
                f"odometry w: expected at most {MAX_TURN_PER_STEP:g} rad per step,"
                f" found {abs(w * dt):g}"
            )

    def on_view_template(self, view: int, relative_rad: float = 0.0) -> None:
        """See a view: remember where if it is new, else inject activity where it was first seen.

        view: id of the template; a new one must be the number of views seen so far.
        relative_rad: heading now minus heading stored (panoramic views), rad.
        Raises ValueError for an id out of order.
        """
        if not 0 <= view <= self._views:
            raise ValueError(f"view template: expected 0 to {self._views}, found {view}")
        c = self._config
        if view == self._views:
            self._view_poses = grown(self._view_poses, view + 1)
            self._view_decay = grown(self._view_decay, view + 1)
            self._view_first = grown(self._view_first, view + 1)
            self._view_last = grown(self._view_last, view + 1)
            self._view_poses[view] = self._best
            self._view_decay[view] = c.vt_active_decay
            self._view_first[view] = self._view_last[view] = -1
            self._views += 1
        elif self._may_inject(view):
            if view == self._view:
                self._view_decay[view] += c.vt_active_decay
                if view not in self._habituated:
                    self._habituated.append(view)
            habituation = exp(1.2 * float(self._view_decay[view]))
            energy = c.pc_vt_inject_energy * (30.0 - habituation) / 30.0
            if energy > 0.0:
                self._inject(view, relative_rad, energy)
        for habituated in self._habituated:
            left = self._view_decay[habituated] - c.pc_vt_restore
            self._view_decay[habituated] = max(left, c.vt_active_decay)
        self._habituated = [h for h in self._habituated if self._view_decay[h] > c.vt_active_decay]
        self._previous_view = self._view
        self._view = view
        self._view_update = True

    def on_odo(self, v: float, w: float, dt: float) -> None:
        """Iterate the network and move the packet: v in m/s, w in rad/s, dt in s.

        A step of more than one cell is split into iterations of at most one cell each.
        Raises SlamInputError for a step that cannot be integrated (nothing changes), and
        PoseCellError when no activity is left.
        """
        self.check_odo(v, w, dt)
        c = self._config
        step = v * dt / c.pc_cell_x_size
        spin = w * dt * c.pc_dim_th / TAU
        iterations = 1 if c.faithful else max(1, math.ceil(abs(step)))
        alive = _iterate(
            self._cells,
            self._alive,
            self._work,
            self._wide,
            self._wrap,
            self._excite,
            self._inhibit,
            float(c.pc_global_inhib),
            step / iterations,
            spin / iterations,
            iterations,
            c.faithful,
            self._directions,
            self._angles_xy,
            self._angles_th,
            self._best,
        )
        if not alive:
            raise PoseCellError(
                f"pose cells: no activity left on the {c.pc_dim_xy}x{c.pc_dim_xy}x{c.pc_dim_th}"
                f" grid with pc_global_inhib {c.pc_global_inhib:g}"
            )
        self._odo_update = True

    def get_action(self) -> Action:
        """Decide what happens to the experiences; none until view and odometry are both new."""
        if not (self._odo_update and self._view_update):
            return Action(ACTION_NONE)
        self._odo_update = self._view_update = False
        if self._views == 0:
            return Action(ACTION_NONE)
        source = self.current
        if self._experiences == 0 or self._view_first[self._view] < 0:
            return self._create(source)
        x, y, th = self._best
        target, distance, moved = _nearest(
            self._experience_poses,
            self._next,
            int(self._view_first[self._view]),
            source,
            float(x),
            float(y),
            float(th) - self._shift,
            self._config.pc_dim_xy,
            self._config.pc_dim_th,
        )
        threshold = self._config.exp_delta_pc_threshold
        if moved > threshold or self._view != self._previous_view:
            if distance < threshold:
                self.current = target
                return Action(ACTION_CREATE_EDGE, source, target)
            return self._create(source)
        return Action(ACTION_NONE)

    def _may_inject(self, view: int) -> bool:
        if self._config.faithful and self._views < RECENT_TEMPLATES:
            return True
        return view < self._views - RECENT_TEMPLATES

    def _inject(self, view: int, relative_rad: float, energy: float) -> None:
        t, n = self._config.pc_dim_th, self._config.pc_dim_xy
        self._shift = relative_rad / TAU * t
        x, y, th = self._view_poses[view]
        th += self._shift
        while th < 0.0:
            th += t
        while th > t:
            th -= t
        if not self._config.faithful:
            i, j, k = (int(a + ON_A_CELL) for a in (x, y, th))
            i, j, k = i % n, j % n, k % t
        else:
            i, j, k = int(x), int(y), int(th)
            if i >= n or j >= n or k >= t:
                return
        self._cells[k, j, i] += energy
        self._alive[k] = 1

    def _create(self, source: int) -> Action:
        new = self._experiences
        self._experience_poses = grown(self._experience_poses, new + 1)
        self._experience_views = grown(self._experience_views, new + 1)
        self._next = grown(self._next, new + 1)
        self._experience_poses[new] = self._best
        self._experience_views[new] = self._view
        self._next[new] = -1
        if self._view_first[self._view] < 0:
            self._view_first[self._view] = new
        else:
            self._next[self._view_last[self._view]] = new
        self._view_last[self._view] = new
        self._experiences += 1
        self.current = new
        return Action(ACTION_CREATE_NODE, source, new)


def _kernel(width: int, sigma: float) -> Floats:
    """One side of the normalised Gaussian, centre first: the 3-D kernel is its outer product."""
    radius = width // 2
    half = [float(exp(-(a * a) / (2.0 * sigma * sigma))) for a in range(radius + 1)]
    total = half[0] + 2.0 * sum(half[1:])
    return np.array([h / total for h in half], dtype=np.float64)


def _circle(length: int) -> Floats:
    """float64[2, length]: sine and cosine of (n + 1) 2 pi / length, for the population vector."""
    angles = [(n + 1) * TAU / length for n in range(length)]
    return np.array([[sin(a) for a in angles], [cos(a) for a in angles]], dtype=np.float64)


@compiled
def _wrapped(index: int, length: int) -> int:
    """index modulo length, without a division when it is less than one length outside."""
    if index < 0:
        index += length
    elif index >= length:
        index -= length
    if index < 0 or index >= length:
        index %= length
    return index


@compiled
def _blur_line(out: Floats, source: Floats, first: int, stride: int, weights: Floats) -> None:
    """out[x] = sum over taps t of weight |t| times source[first + x + t stride].

    Works on shifted slices: loops over plain indices are what the compiler vectorises.
    """
    m = out.shape[0]
    centre = source[first : first + m]
    w0 = weights[0]
    if weights.shape[0] == 4:
        w1, w2, w3 = weights[1], weights[2], weights[3]
        l1, r1 = source[first - stride :], source[first + stride :]
        l2, r2 = source[first - 2 * stride :], source[first + 2 * stride :]
        l3, r3 = source[first - 3 * stride :], source[first + 3 * stride :]
        for x in range(m):
            out[x] = (
                w0 * centre[x] + w1 * (l1[x] + r1[x]) + w2 * (l2[x] + r2[x]) + w3 * (l3[x] + r3[x])
            )
    elif weights.shape[0] == 3:
        w1, w2 = weights[1], weights[2]
        l1, r1 = source[first - stride :], source[first + stride :]
        l2, r2 = source[first - 2 * stride :], source[first + 2 * stride :]
        for x in range(m):
            out[x] = w0 * centre[x] + w1 * (l1[x] + r1[x]) + w2 * (l2[x] + r2[x])
    else:
        for x in range(m):
            out[x] = w0 * centre[x]
        for t in range(1, weights.shape[0]):
            w = weights[t]
            left, right = source[first - t * stride :], source[first + t * stride :]
            for x in range(m):
                out[x] += w * (left[x] + right[x])


@compiled
def _blur_layer(layer: Floats, n: int, weights: Floats, wide: Floats, wrap: Ints) -> None:
    """Circular convolution of one n x n layer (flat) along x and y, in place."""
    r = weights.shape[0] - 1
    width = n + 2 * r
    skip = (wrap.shape[0] - width) // 2
    padded = wide[0]
    for j in range(n):
        row = layer[j * n : j * n + n]
        target = padded[j * width : j * width + width]
        for x in range(r):
            target[x] = row[wrap[skip + x]]
            target[r + n + x] = row[wrap[skip + r + n + x]]
        middle = target[r : r + n]
        for i in range(n):
            middle[i] = row[i]
    # along x, all rows at once; the 2 r cells at each joint of two rows are not used
    blurred = wide[1]
    _blur_line(blurred[: n * width - 2 * r], padded, r, 1, weights)
    for y in range(width):
        start = wrap[skip + y] * width
        row = blurred[start : start + n]
        target = padded[y * n : y * n + n]
        for i in range(n):
            target[i] = row[i]
    _blur_line(layer, padded, r * n, n, weights)


@compiled
def _blur_heading(out: Floats, source: Floats, alive: Bytes, k: int, weights: Floats) -> None:
    """One layer of the circular convolution along heading."""
    layers = source.shape[0]
    out[:] = 0.0
    r = weights.shape[0] - 1
    for t in range(-r, r + 1):
        neighbour = _wrapped(k + t, layers)
        if alive[neighbour]:
            w = weights[abs(t)]
            row = source[neighbour]
            for x in range(out.shape[0]):
                out[x] += w * row[x]


@compiled
def _dilate(alive: Bytes, radius: int) -> Bytes:
    layers = alive.shape[0]
    result = np.zeros(layers, dtype=np.uint8)
    for k in range(layers):
        if alive[k]:
            for t in range(-radius, radius + 1):
                result[_wrapped(k + t, layers)] = 1
    return result


@compiled
def _iterate(
    cells: Floats,
    alive: Bytes,
    work: Floats,
    wide: Floats,
    wrap: Ints,
    excite: Floats,
    inhibit: Floats,
    global_inhibition: float,
    step: float,
    spin: float,
    iterations: int,
    faithful: bool,
    directions: Floats,
    circle_xy: Floats,
    circle_th: Floats,
    best: Floats,
) -> bool:
    """Iterations of the network with motion `step` (cells) and `spin` (heading cells) each."""
    layers = cells.shape[0]
    n = cells.shape[1]
    flat = cells.reshape(layers, n * n)
    excited = work[0]
    rest = work[1]
    column = np.empty(n * n)
    for _ in range(iterations):
        for k in range(layers):
            if alive[k]:
                _blur_layer(flat[k], n, excite, wide, wrap)
        raised = _dilate(alive, excite.shape[0] - 1)
        for k in range(layers):
            if raised[k]:
                _blur_heading(excited[k], flat, alive, k, excite)
        # Without negative activity nothing survives where excitation did not reach.
        kept = _dilate(raised, inhibit.shape[0] - 1) if faithful else raised
        column[:] = 0.0
        for k in range(layers):
            if alive[k]:
                flat[k] = 0.0
            if kept[k]:
                _blur_heading(rest[k], excited, raised, k, inhibit)
                _blur_layer(rest[k], n, inhibit, wide, wrap)
                for x in range(n * n):
                    value = -rest[k, x]
                    if raised[k]:
                        value += excited[k, x]
                    value = value - global_inhibition if value >= global_inhibition else 0.0
                    rest[k, x] = value
                    column[x] += value
        total = 0.0
        for x in range(n * n):
            total += column[x]
        if not total > 0.0:
            return False
        for k in range(layers):
            alive[k] = 0
        _integrate(cells, alive, rest, kept, 1.0 / total, step, spin, faithful, directions)
    return _read_out(cells, alive, faithful, circle_xy, circle_th, best)


@compiled
def _integrate(
    cells: Floats,
    alive: Bytes,
    source: Floats,
    kept: Bytes,
    scale: float,
    step: float,
    spin: float,
    faithful: bool,
    directions: Floats,
) -> None:
    """Add `source` times `scale`, moved by step and spin, to the empty `cells`."""
    layers = cells.shape[0]
    n = cells.shape[1]
    speed = abs(step)
    sign = 1 if spin > 0.0 else -1
    turns = abs(spin)
    low = math.floor(turns)
    high = math.ceil(turns)
    far = turns - (high - 1) if spin != 0.0 else 0.0
    for k in range(layers):
        if not kept[k]:
            continue
        direction = directions[k]
        if step < 0.0:
            direction += math.pi
        quarter = math.floor(direction * 2.0 / math.pi)
        angle = direction - quarter * (math.pi / 2.0)
        quarter &= 3
        up = speed * cos(angle)
        right = speed * sin(angle)
        both = up * right
        to_right = right * (1.0 - up)
        to_up = up * (1.0 - right)
        stay = 1.0 - both - to_right - to_up
        # `up` and `right` in the frame turned by `quarter` quarter turns
        if quarter == 0:
            up_j, up_i, right_j, right_i = 1, 0, 0, 1
        elif quarter == 1:
            up_j, up_i, right_j, right_i = 0, 1, -1, 0
        elif quarter == 2:
            up_j, up_i, right_j, right_i = -1, 0, 0, -1
        else:
            up_j, up_i, right_j, right_i = 0, -1, 1, 0
        first = (k + sign * low) % layers
        second = (k + sign * high) % layers
        for j in range(n):
            for i in range(n):
                value = source[k, j * n + i]
                if value == 0.0:
                    continue
                value *= scale
                lost_up = 1.0
                lost_right = 1.0
                if faithful:
                    if quarter == 0:
                        r, c = j, i
                    elif quarter == 1:
                        r, c = i, n - 1 - j
                    elif quarter == 2:
                        r, c = n - 1 - j, n - 1 - i
                    else:
                        r, c = n - 1 - i, j
                    if r == n - 1 and c == 0:
                        lost_up = 0.0
                    if c == n - 1 and r == 0:
                        lost_right = 0.0
                j_up = _wrapped(j + up_j, n)
                i_up = _wrapped(i + up_i, n)
                j_right = _wrapped(j + right_j, n)
                i_right = _wrapped(i + right_i, n)
                j_both = _wrapped(j_up + right_j, n)
                i_both = _wrapped(i_up + right_i, n)
                for part in range(2):
                    weight = (1.0 - far if part == 0 else far) * value
                    if weight == 0.0:
                        continue
                    layer = first if part == 0 else second
                    alive[layer] = 1
                    cells[layer, j, i] += weight * stay
                    cells[layer, j_up, i_up] += weight * to_up * lost_up
                    cells[layer, j_right, i_right] += weight * to_right * lost_right
                    cells[layer, j_both, i_both] += weight * both


@compiled
def _read_out(
    cells: Floats,
    alive: Bytes,
    faithful: bool,
    circle_xy: Floats,
    circle_th: Floats,
    best: Floats,
) -> bool:
    """Population vector of the 7 x 7 x 7 cells around the largest one, into best (x, y, th)."""
    layers = cells.shape[0]
    n = cells.shape[1]
    largest = 0.0
    at_k, at_j, at_i = -1, -1, -1
    for k in range(layers):
        if alive[k]:
            for j in range(n):
                for i in range(n):
                    if cells[k, j, i] > largest:
                        largest = cells[k, j, i]
                        at_k, at_j, at_i = k, j, i
    if at_k < 0:
        return False
    half = READOUT_HALF_WIDTH
    sum_x = np.zeros(n)
    sum_y = np.zeros(n)
    sum_th = np.zeros(layers)
    for dk in range(-half, half + 1):
        k = _wrapped(at_k + dk, layers)
        if not alive[k]:
            continue
        for dj in range(-half, half + 1):
            j = _wrapped(at_j + dj, n)
            for di in range(-half, half + 1):
                i = _wrapped(at_i + di, n)
                sum_x[i] += cells[k, j, i]
                sum_y[j] += cells[k, j, i]
                sum_th[k] += cells[k, j, i]
    best[0] = _population_vector(sum_x, circle_xy, faithful)
    best[1] = _population_vector(sum_y, circle_xy, faithful)
    best[2] = _population_vector(sum_th, circle_th, faithful)
    return True


@compiled
def _population_vector(sums: Floats, circle: Floats, faithful: bool) -> float:
    """Circular mean of the cell numbers 0 .. n-1 weighted by `sums`, in [0, n)."""
    length = float(sums.shape[0])
    y = 0.0
    x = 0.0
    for i in range(sums.shape[0]):
        y += circle[0, i] * sums[i]
        x += circle[1, i] * sums[i]
    value = atan2(y, x) * length / TAU - 1.0
    while value < 0.0:
        value += length
    while value > length:
        value -= length
    if value == length and not faithful:
        value = 0.0
    return value


@compiled
def _nearest(
    poses: Floats,
    following: Ints,
    first: int,
    current: int,
    x: float,
    y: float,
    th: float,
    n: int,
    layers: int,
) -> tuple[int, float, float]:
    """Nearest experience in a view's list except the current one; its distance; the current's."""
    target = -1
    least = np.inf
    candidate = first
    while candidate >= 0:
        if candidate != current:
            distance = _distance(poses[candidate], x, y, th, n, layers)
            if distance < least:
                least = distance
                target = candidate
        candidate = following[candidate]
    return target, least, _distance(poses[current], x, y, th, n, layers)


@compiled
def _distance(pose: Floats, x: float, y: float, th: float, n: int, layers: int) -> float:
    """Distance on the torus, cells of x and y and of heading counted alike."""
    dx = abs(pose[0] - x)
    dy = abs(pose[1] - y)
    dth = abs(pose[2] - th)
    dx = min(dx, n - dx)
    dy = min(dy, n - dy)
    dth = min(dth, layers - dth)
    return math.sqrt(dx * dx + dy * dy + dth * dth)
