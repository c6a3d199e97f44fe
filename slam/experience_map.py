"""The experience map: a graph of experiences, relaxed towards the odometry of its links.

Source: OpenRatSLAM's ExperienceMap. In faithful mode two of its defects are reproduced, which are
otherwise fixed: a link's duration counts from the start of the run instead of from the last
experience; and the first experience never becomes "entered", so that the odometry before it is
counted again in the first link. With a relative heading (panoramic views) the original also turns
the arrival at a link the wrong way; everywhere else the relative heading is heading now minus
heading stored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled, cos, sin
from vibrissa.slam.angles import PI, turn, wrap_pi
from vibrissa.slam.config import RatSlamConfig
from vibrissa.slam.growing import grown

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


class ExperienceMapError(ValueError):
    """An experience does not exist, or a stored map does not fit."""


class ExperienceMap:
    """Experiences (poses in m, m, rad) and directed links between them.

    `facing` is the heading of the agent and (`offset_x`, `offset_y`) its displacement since it
    entered the current experience.
    """

    def __init__(self, config: RatSlamConfig) -> None:
        self._config = config
        self._poses = np.empty((64, 3), dtype=np.float64)
        self._from = np.empty(64, dtype=np.int32)
        self._to = np.empty(64, dtype=np.int32)
        self._values = np.empty((64, 4), dtype=np.float64)
        self._created = np.empty(64, dtype=np.int32)
        self._joined: set[tuple[int, int]] = set()
        self._count = 0
        self._links = 0
        self.current = 0 if config.faithful else -1
        self.facing = wrap_pi(config.exp_initial_em_deg * PI / 180.0)
        self.offset_x = 0.0
        self.offset_y = 0.0
        self._elapsed = 0.0

    def __len__(self) -> int:
        return self._count

    @property
    def poses(self) -> Floats:
        """float64[n, 3]: x, y, heading of every experience (a view)."""
        return self._poses[: self._count]

    @property
    def pose(self) -> tuple[float, float, float]:
        """Where the agent is: the current experience plus the odometry since, heading `facing`."""
        if self._count == 0:
            return self.offset_x, self.offset_y, self.facing
        x, y, _ = self._poses[self.current]
        return float(x) + self.offset_x, float(y) + self.offset_y, self.facing

    def links(self) -> Ints:
        """int32[m, 2]: from and to of every link in order of creation."""
        order = np.argsort(self._created[: self._links])
        return np.stack([self._from[order], self._to[order]], axis=1)

    def link_values(self) -> Floats:
        """float64[m, 4]: distance (m), heading, facing (rad) and duration (s), by creation."""
        order = np.argsort(self._created[: self._links])
        return self._values[order]

    def on_odo(self, v: float, w: float, dt: float) -> None:
        """Turn by w dt, then move by v dt along the new heading."""
        self.facing = wrap_pi(self.facing + w * dt)
        self.offset_x += v * dt * cos(self.facing)
        self.offset_y += v * dt * sin(self.facing)
        self._elapsed += dt

    def create(self) -> int:
        """Create an experience at the agent's pose, link it to the current one and enter it."""
        new = self._count
        self._poses = grown(self._poses, new + 1)
        self._poses[new] = self.pose
        self._count += 1
        if new > 0:
            self.link(self.current, new)
        self.enter(new)
        return new

    def link(self, source: int, target: int, relative_rad: float = 0.0) -> bool:
        """Link two experiences by the odometry since the first was entered.

        Refused (False) when the two are already linked in either direction.
        Raises ExperienceMapError for an experience that does not exist.
        """
        self._check(source)
        self._check(target)
        if (source, target) in self._joined or (target, source) in self._joined:
            return False
        heading = float(self._poses[source, 2])
        dx, dy = self.offset_x, self.offset_y
        arrival = relative_rad if self._config.faithful else -relative_rad
        values = (
            math.sqrt(dx * dx + dy * dy),
            turn(heading, atan2(dy, dx)),
            turn(heading, wrap_pi(self.facing + arrival)),
            self._elapsed,
        )
        self._insert_link(source, target, values)
        return True

    def enter(self, experience: int, relative_rad: float = 0.0) -> None:
        """Make an experience the current one; nothing when it is already.

        Raises ExperienceMapError for an experience that does not exist.
        """
        self._check(experience)
        if experience == self.current:
            return
        self.current = experience
        self.offset_x = self.offset_y = 0.0
        self.facing = wrap_pi(float(self._poses[experience, 2]) + relative_rad)
        if not self._config.faithful:
            self._elapsed = 0.0

    def iterate(self) -> None:
        """Relax the map: `exp_loops` sweeps over all links, in place."""
        m = self._links
        _relax(
            self._poses,
            self._from[:m],
            self._to[:m],
            self._values[:m],
            self._config.exp_loops,
            float(self._config.exp_correction),
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The whole state as plain arrays (copies)."""
        state = (self.facing, self.offset_x, self.offset_y, self._elapsed)
        return {
            "poses": self.poses.copy(),
            "links": self.links(),
            "link_values": self.link_values(),
            "current": np.array(self.current, dtype=np.int64),
            "agent": np.array(state, dtype=np.float64),
        }

    @classmethod
    def from_arrays(
        cls, config: RatSlamConfig, arrays: Mapping[str, NDArray[Any]]
    ) -> ExperienceMap:
        """The map that `to_arrays` described.

        Raises ExperienceMapError for a missing array, a wrong shape, or links to nowhere.
        """
        expected = {"poses": (-1, 3), "links": (-1, 2), "link_values": (-1, 4), "agent": (4,)}
        for name, shape in {**expected, "current": ()}.items():
            if name not in arrays:
                raise ExperienceMapError(f"stored map: expected an array {name!r}, found none")
            found = arrays[name].shape
            if len(found) != len(shape) or any(
                e not in (-1, f) for e, f in zip(shape, found, strict=True)
            ):
                raise ExperienceMapError(f"stored map {name}: expected {shape}, found {found}")
        if len(arrays["links"]) != len(arrays["link_values"]):
            raise ExperienceMapError(
                f"stored map: {len(arrays['links'])} links but {len(arrays['link_values'])} values"
            )
        result = cls(config)
        count = len(arrays["poses"])
        result._poses = grown(result._poses, count)
        result._poses[:count] = arrays["poses"]
        result._count = count
        current = int(arrays["current"])
        if count > 0:
            result._check(current)
        for (source, target), values in zip(
            arrays["links"].tolist(), arrays["link_values"].tolist(), strict=True
        ):
            result._check(source)
            result._check(target)
            result._insert_link(source, target, tuple(values))
        result.current = current
        agent = arrays["agent"].tolist()
        result.facing, result.offset_x, result.offset_y, result._elapsed = agent
        return result

    def _insert_link(self, source: int, target: int, values: tuple[float, ...]) -> None:
        """Links stay sorted by `from`, then creation: the order in which relaxation visits."""
        m = self._links
        self._from = grown(self._from, m + 1)
        self._to = grown(self._to, m + 1)
        self._values = grown(self._values, m + 1)
        self._created = grown(self._created, m + 1)
        at = int(np.searchsorted(self._from[:m], source, side="right"))
        for array, value in (
            (self._from, source),
            (self._to, target),
            (self._values, values),
            (self._created, m),
        ):
            array[at + 1 : m + 1] = array[at:m]
            array[at] = value
        self._links += 1
        self._joined.add((source, target))

    def _check(self, experience: int) -> None:
        if not 0 <= experience < self._count:
            raise ExperienceMapError(
                f"experience: expected 0 to {self._count - 1}, found {experience}"
            )


@compiled
def _relax(
    poses: Floats, source: Ints, target: Ints, values: Floats, loops: int, correction: float
) -> None:
    """Sweeps over the links, each correcting its two ends at once (Gauss-Seidel).

    Headings do not depend on positions. A sweep therefore corrects all headings first, keeps the
    direction in which each link was found, and takes the sines and cosines of all of them together.
    """
    links = source.shape[0]
    distance = values[:, 0].copy()
    heading = values[:, 1].copy()
    facing = values[:, 2].copy()
    x = poses[:, 0].copy()
    y = poses[:, 1].copy()
    th = poses[:, 2].copy()
    direction = np.empty(links)
    ahead_x = np.empty(links)
    ahead_y = np.empty(links)
    for _ in range(loops):
        for link in range(links):
            a = source[link]
            b = target[link]
            direction[link] = th[a] + heading[link]
            twist = turn(th[a] + facing[link], th[b]) * correction
            th[a] = wrap_pi(th[a] + twist)
            th[b] = wrap_pi(th[b] - twist)
        for link in range(links):
            ahead_x[link] = distance[link] * cos(direction[link])
        for link in range(links):
            ahead_y[link] = distance[link] * sin(direction[link])
        for link in range(links):
            a = source[link]
            b = target[link]
            dx = (x[b] - x[a] - ahead_x[link]) * correction
            dy = (y[b] - y[a] - ahead_y[link]) * correction
            x[a] += dx
            y[a] += dy
            x[b] -= dx
            y[b] -= dy
    poses[:, 0] = x
    poses[:, 1] = y
    poses[:, 2] = th
