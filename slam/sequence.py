"""The sequence SLAM: contact masks, a hidden chain over past whisks, and a robust pose graph.

One image says little about where the head is: corridors look alike. A sequence of them does. What
every whisk felt, as 18 bits, is compared with all remembered whisks in both directions of travel
(`sequence_chain`); where a place is certain (`sequence_accept`) the pose graph gets loops
(`graph`). Where nothing is recognised there is no loop, and the poses are those of the odometry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.slam.angles import wrap_pi
from vibrissa.slam.compass import Compass, HeadShape
from vibrissa.slam.config import ConfigError
from vibrissa.slam.graph import GraphParams
from vibrissa.slam.graph_start import reckon
from vibrissa.slam.graph_winding import solve_unwound
from vibrissa.slam.graph_window import refine
from vibrissa.slam.growing import grown
from vibrissa.slam.interface import (
    ACTION_CREATE_EDGE,
    ACTION_CREATE_NODE,
    ACTION_NONE,
    Odometry,
    SlamInputError,
    SlamMap,
    SlamStep,
)
from vibrissa.slam.sequence_accept import find_members
from vibrissa.slam.sequence_config import BATCH, SequenceConfig
from vibrissa.slam.sequence_filter import Belief, SequenceFilter
from vibrissa.slam.sequence_gate import Reckoning
from vibrissa.slam.sequence_memory import WhiskMemory
from vibrissa.slam.sequence_table import PER_RING, RINGS, WHISKERS, Floats, Ints
from vibrissa.slam.sequence_trust import Trust

LARGEST_STEP: Final = 1e3
"""m and rad of one odometry step; beyond it something is broken."""
BIT_VALUES: Final = 1 << np.arange(WHISKERS, dtype=np.int64)


@dataclass(eq=False)
class Loops:
    """Loops so far: ends int64[m, 2] (later, earlier whisk), facing int8[m] (1: the other way); and
    of every whisk the place label and the facing there."""

    count: int
    ends: Ints
    facing: NDArray[np.int8]
    label: Ints
    label_facing: NDArray[np.int8]

    def copied(self) -> Loops:
        return Loops(
            self.count,
            self.ends.copy(),
            self.facing.copy(),
            self.label.copy(),
            self.label_facing.copy(),
        )

    def add(self, whisk: int, found: NDArray[np.int32], remembered: Ints) -> None:
        """A whisk repeats the members int32[m, 2] (state, direction) of a group, the best first."""
        best, direction = int(remembered[found[0, 0]]), int(found[0, 1])
        self.label[whisk] = self.label[best]
        self.label_facing[whisk] = self.label_facing[best] ^ direction
        self.ends = grown(self.ends, self.count + len(found))
        self.facing = grown(self.facing, self.count + len(found))
        for state, row in found:
            if remembered[state] > 0:  # before whisk 0 there is no pose to take the middle with
                self.ends[self.count] = whisk, remembered[state]
                self.facing[self.count] = row
                self.count += 1


class SequenceSlam:
    """The sequence SLAM behind the `Slam` interface; see `SequenceConfig`.

    head: where its whiskers are, for the compass alone. Raises ConfigError for a compass without.

    An experience is a whisk, its id the number of the whisk; a place seen again has that of the
    first. A template is a contact mask. `SlamMap.links` are the odometry steps and the loops.
    There are no pose cells: pc_x, pc_y, pc_th are 0.
    """

    def __init__(self, config: SequenceConfig, head: HeadShape | None = None) -> None:
        if config.compass and head is None:
            raise ConfigError("compass: expected the shape of the head with it")
        self.config = config
        self._compass = Compass(head, config.compass_wall) if config.compass and head else None
        self._graph = GraphParams(
            config.lateral, config.loop_place, config.loop_heading, config.robust
        )
        self._memory = WhiskMemory(config.memory)
        self._filter = SequenceFilter(config, self._memory)
        self._belief = self._filter.begin()
        self._undecided: list[Belief] = []
        self._at_once = max(1, min(config.decide_every, config.lag // 4))
        self._poses = np.zeros((256, 3))
        self._steps = np.zeros((256, 4))
        self._by_wall = np.zeros(256, dtype=np.bool_)
        self._reckoning = Reckoning()
        self._trust = Trust()
        self._loops = Loops(
            0,
            np.zeros((256, 2), dtype=np.int64),
            np.zeros(256, dtype=np.int8),
            np.zeros(256, dtype=np.int64),
            np.zeros(256, dtype=np.int8),
        )
        self._members = np.empty((config.most_loops, 2), dtype=np.int32)
        self._experience = -1
        self._map: SlamMap | None = None

    def step(self, image: NDArray[np.uint8], odometry: Odometry) -> SlamStep:
        """Take the image seen at the end of an odometry step; return the new estimate.

        image: uint8[3, 6], a pixel that is not 0 is a whisker in contact.
        Raises SlamInputError, before any state changes, for an image of another shape or type and
        for a step of more than 1000 m or rad.
        """
        mask = _mask(image)
        distance, turn = _motion(odometry)
        self._map = None
        whisk = self._memory.count
        new_template = self._memory.feel(mask)
        self._append(whisk, image, distance, turn)
        match = self._recognise(whisk, mask)
        known = match >= 0
        pose = self._poses[whisk]
        action = ACTION_NONE
        experience = int(self._loops.label[match]) if known else whisk
        if not known:
            action = ACTION_CREATE_NODE
        elif experience != self._experience:
            action = ACTION_CREATE_EDGE
        self._experience = experience
        return SlamStep(
            template=int(self._memory.kind_of[whisk]),
            new_template=new_template,
            match_error=(mask ^ self._memory.mask(match)).bit_count() / WHISKERS
            if known
            else math.inf,
            experience=experience,
            action=action,
            x=float(pose[0]),
            y=float(pose[1]),
            heading=wrap_pi(float(pose[2])),
            pc_x=0.0,
            pc_y=0.0,
            pc_th=0.0,
            experiences=whisk + 1,
            templates=len(self._memory.kinds),
        )

    def map(self) -> SlamMap:
        """The map from all there is: every whisk decided, every pose estimated.

        Does not change what later steps say. float64[n, 3] poses of all n whisks.
        """
        if self._map is None:
            self._map = self._solved()
        found = self._map
        return SlamMap(found.poses.copy(), found.links.copy(), found.templates.copy())

    @property
    def trajectory(self) -> Floats:
        """Poses float64[n, 3] as estimated so far, headings not wrapped: a window of new ones
        follows the loops, older ones stay. Not those of the map."""
        return self._poses[: self._memory.count].copy()

    @property
    def loops(self) -> Ints:
        """Loops decided so far, int64[m, 3]: later whisk, earlier whisk, 1 for the other way."""
        m = self._loops.count
        return np.concatenate([self._loops.ends[:m], self._loops.facing[:m, None]], axis=1)

    def _append(self, whisk: int, image: NDArray[np.uint8], distance: float, turn: float) -> None:
        self._poses = grown(self._poses, whisk + 1)
        self._steps = grown(self._steps, whisk + 1)
        self._poses[whisk] = self._poses[whisk - 1] if whisk else 0.0
        step = self._steps[whisk]
        step[:] = distance, turn, *self.config.odometer.sigmas(distance, turn)
        self._reckoning.add(whisk, step)
        self._by_wall = grown(self._by_wall, whisk + 1)
        if self._compass:
            sigma = float(step[3])
            step[1], step[3] = self._compass.turned(image, turn, sigma)
            self._by_wall[whisk] = step[3] < sigma
        reckon(self._poses[whisk], distance, float(step[1]))
        loops = self._loops
        loops.label = grown(loops.label, whisk + 1)
        loops.label[whisk] = whisk
        loops.label_facing = grown(loops.label_facing, whisk + 1)

    def _recognise(self, whisk: int, mask: int) -> int:
        """Take the chain one whisk on and decide what is due; the remembered whisk that the past
        alone says this one repeats, -1 for none."""
        memory, config = self._memory, self.config
        if whisk >= config.gap:
            if memory.remembered == memory.capacity and config.lag != BATCH:
                self._forget()
            if memory.remembered < memory.capacity:
                memory.remember(whisk - config.gap)
        if config.lag == BATCH:
            return -1
        self._belief = self._filter.forward(self._belief, mask, memory.remembered, memory.table)
        self._undecided.append(self._belief)
        found = self._find(whisk, self._belief.known, self._loops)
        match = int(memory.whisk[found[0, 0]]) if len(found) else -1
        if len(self._undecided) > config.lag:
            self._decide(whisk - config.lag)
        return match

    def _decide(self, first: int) -> None:
        """Decide the oldest undecided whisks, of which `first` is the first."""
        before = self._loops.count
        for k, posterior in enumerate(self._filter.smooth(self._undecided, self._at_once)):
            found = self._find(first + k, posterior, self._loops)
            if len(found):
                self._loops.add(first + k, found, self._memory.whisk)
        del self._undecided[: self._at_once]
        if self._loops.count > before:
            n = self._memory.count
            oldest = max(n - 1 - self.config.window, 0)
            ends, facing = self._ordered(self._loops)
            self._trust.look_at(ends, facing, self._reckoning.travelled)
            steps = self._trusted(self._trust, oldest)
            refine(self._poses[:n], oldest, steps, ends, facing, self._graph)

    def _find(self, whisk: int, posterior: Floats, loops: Loops) -> NDArray[np.int32]:
        count = find_members(
            posterior,
            posterior.shape[1],
            self._memory.whisk,
            loops.label,
            loops.label_facing,
            self.config.reach,
            self.config.certain,
            self.config.share,
            self._members,
        )
        if count and not self._can_be(whisk, *self._members[0]):
            count = 0
        return self._members[:count]

    def _can_be(self, whisk: int, state: int, direction: int) -> bool:
        """Whether odometry lets a whisk have the heading and the place of the one it repeats."""
        config, earlier = self.config, int(self._memory.whisk[state])
        apart, variance = self._reckoning.heading_apart(whisk, earlier, int(direction))
        limit = config.gate * config.gate
        if apart * apart > limit * (variance + config.loop_heading * config.loop_heading):
            return False
        chi2 = self._reckoning.place_chi2(whisk, earlier, config.loop_place, config.lateral)
        return chi2 <= limit

    def _forget(self) -> None:
        """Make room in the memory; what is forgotten counts as new from now on."""
        kept = self._memory.forget(self._loops.label)
        last = self._undecided[-1] if self._undecided else None
        for belief in self._undecided if last is self._belief else [*self._undecided, self._belief]:
            chosen = kept[kept < belief.states]
            known = np.ascontiguousarray(belief.known[:, chosen])
            belief.new = max(1.0 - float(known.sum()), 0.0)
            belief.known = known

    def pose_graph(self) -> tuple[Floats, Ints, NDArray[np.int8]]:
        """What the map of at least one whisk is solved from, every whisk decided: steps
        float64[n - 1, 4], loops int64[m, 2] and facing int8[m] as in `graph_start.start_values`."""
        loops = self._all_loops()
        ends, facing = self._ordered(loops)
        trust = self._trust.copied()
        trust.look_at(ends, facing, self._reckoning.travelled)
        return self._trusted(trust, 0), ends, facing

    def _all_loops(self) -> Loops:
        n = self._memory.count
        loops = self._loops.copied()
        if self.config.lag == BATCH:
            self._decide_all(loops)
        elif self._undecided:
            first = n - len(self._undecided)
            for k, posterior in enumerate(
                self._filter.smooth(self._undecided, len(self._undecided))
            ):
                found = self._find(first + k, posterior, loops)
                if len(found):
                    loops.add(first + k, found, self._memory.whisk)
        return loops

    def _solved(self) -> SlamMap:
        n = self._memory.count
        if n == 0:
            none = np.zeros((0, 2), dtype=np.int32)
            return SlamMap(np.zeros((0, 3)), none, self._memory.kind_of.copy())
        steps, ends, facing = self.pose_graph()
        poses = solve_unwound(
            self._poses[0], steps, ends, facing, self._graph, self.config.doubt
        ).poses
        for pose in poses:
            pose[2] = wrap_pi(float(pose[2]))
        chain = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
        links = np.concatenate([chain, ends]).astype(np.int32)
        return SlamMap(poses, links, self._memory.kind_of.copy())

    def _decide_all(self, loops: Loops) -> None:
        memory = self._memory
        if memory.remembered == 0:
            return
        n = memory.count
        states = np.clip(np.arange(n) - self.config.gap + 1, 0, memory.capacity)
        masks = memory.kinds[memory.kind_of]
        for whisk, posterior in enumerate(self._filter.smooth_run(masks, states)):
            found = self._find(whisk, posterior, loops)
            if len(found):
                loops.add(whisk, found, memory.whisk)

    def _trusted(self, trust: Trust, first: int) -> Floats:
        """The steps float64[n - 1, 4], from `first` on with what is to be believed of them."""
        steps = self._steps[1 : self._memory.count]
        factors = trust.factors
        if (factors < 1.0).any():
            steps = steps.copy()
            steps[first:, 2] *= factors[0]
            by_odometry_alone = ~self._by_wall[first + 1 : self._memory.count]
            steps[first:, 3][by_odometry_alone] *= factors[1]
        return steps

    @staticmethod
    def _ordered(loops: Loops) -> tuple[Ints, NDArray[np.int8]]:
        return loops.ends[: loops.count], loops.facing[: loops.count]


def _mask(image: NDArray[np.uint8]) -> int:
    """The contact mask of an image. Raises SlamInputError."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        found = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise SlamInputError(f"image: expected an array of uint8, found {found}")
    if image.shape != (RINGS, PER_RING):
        raise SlamInputError(f"image: expected shape ({RINGS}, {PER_RING}), found {image.shape}")
    return int(BIT_VALUES[image.ravel() > 0].sum())


def _motion(odometry: Odometry) -> tuple[float, float]:
    """Distance (m) and turn (rad) of a step. Raises SlamInputError."""
    motion = odometry.v * odometry.dt, odometry.w * odometry.dt
    for name, value, unit in zip(("distance", "turn"), motion, ("m", "rad"), strict=True):
        if not abs(value) <= LARGEST_STEP:
            raise SlamInputError(
                f"odometry {name}: expected at most {LARGEST_STEP:g} {unit} per step,"
                f" found {value:g}"
            )
    return motion
