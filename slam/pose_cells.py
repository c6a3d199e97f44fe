"""The pose-cell network: a packet of activity on a torus of x, y and heading.

Source: OpenRatSLAM's PosecellNetwork. One iteration excites, inhibits, normalises and moves the
packet; the work is confined to the neighbourhood of the activity. Positions are in cells:
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

from vibrissa.numerics import compiled, exp
from vibrissa.slam.angles import TAU
from vibrissa.slam.attractor import iterate
from vibrissa.slam.blur import half_gaussian
from vibrissa.slam.config import RatSlamConfig
from vibrissa.slam.growing import grown
from vibrissa.slam.interface import (
    ACTION_CREATE_EDGE,
    ACTION_CREATE_NODE,
    ACTION_NONE,
    SlamInputError,
)
from vibrissa.slam.packet import (
    add,
    empty_box,
    margin_of,
    packet_reach,
    working_room,
    write_cells,
)
from vibrissa.slam.path_integration import motion_table
from vibrissa.slam.read_out import unit_circle

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

RECENT_TEMPLATES: Final = 10
MAX_CELLS_PER_STEP: Final = 10_000.0
MAX_TURN_PER_STEP: Final = 1e6
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
        self._excite = half_gaussian(c.pc_w_e_dim, c.pc_w_e_var)
        self._inhibit = half_gaussian(c.pc_w_i_dim, c.pc_w_i_var)
        self._margin = margin_of(self._excite, self._inhibit)
        self._work = working_room(n, t, self._excite, self._inhibit)
        self._box = empty_box(t)
        self._circle_xy = unit_circle(n)
        self._circle_th = unit_circle(t)
        self._motion = motion_table(t)
        self._add(t // 2, n // 2, n // 2, 1.0)
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
        """Activity float64[heading, y, x] (a copy)."""
        t, n = self._config.pc_dim_th, self._config.pc_dim_xy
        cells = np.zeros((t, n, n), dtype=np.float64)
        write_cells(cells, self._work, self._box, self._margin)
        return cells

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
        alive = iterate(
            self._work,
            self._box,
            self._excite,
            self._inhibit,
            self._motion,
            self._circle_xy,
            self._circle_th,
            self._best,
            float(c.pc_global_inhib),
            step / iterations,
            spin / iterations,
            iterations,
            c.faithful,
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
        self._add(k, j, i, energy)

    def _add(self, k: int, j: int, i: int, energy: float) -> None:
        c = self._config
        reach = packet_reach(self._excite, self._inhibit, c.faithful)
        add(self._work, self._box, (k, j, i), energy, self._margin, c.pc_dim_xy, reach)

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
