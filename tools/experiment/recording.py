"""One data set: the rig carried along its path with one control scheme, kept as tactile views.

Everything that determines a data set is in its `RigCase`; the sensors' noise and the path come from
streams of the same seed indexed by time, so that two control schemes with one seed share both.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.kinematics import WHISKERS, paper_head
from vibrissa.control.whisk_pattern import full_whisk
from vibrissa.messages.types import TICK_HZ, TICK_NS
from vibrissa.processes.config import LEAST_SLEW_LIMIT
from vibrissa.processes.controllers import BUILT_IN
from vibrissa.processes.cycle import Setup, WhiskLoop
from vibrissa.processes.views import views
from vibrissa.rig.maze import parse_maze
from vibrissa.rig.plant import HeadPlantParams
from vibrissa.rig.scene import wall_boxes
from vibrissa.tools.experiment.path import CircuitPath, PathParams

PERIOD_TICKS: Final = 2000
IMAGES: Final = ("max_angle_gated", "max_angle_ungated", "contact_angle")
"""Kinds of image in a recording, in the order they are stored."""


@dataclass(frozen=True)
class RigCase:
    """Everything a data set depends on; `taper` and `stiffness` are ratios to the head's own.

    taper: tip diameters over the usual ones (capped at a cylinder); servo: N m/rad, motor
    stiffness; noise: ratio of the deflection sensors' noise; gain: of RCP, in contact stiffnesses;
    speed: m/s of the head; wander: m; yaw: rad.
    """

    maze: str
    seed: int
    controller: str
    sequence: str
    speed: float = 0.01
    wander: float = 0.001
    servo: float = 0.3
    taper: float = 1.0
    noise: float = 1.0
    gain: float = 3.0
    calibration_cycles: int = 12
    yaw: float = 0.0

    def key(self) -> dict[str, Any]:
        """The case as plain values."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Recording:
    """The views of a data set, one row per whisk.

    images uint8[n, 3, 18] in the order of IMAGES; motion float64[n, 3]: exact v (m/s), w (rad/s),
    dt (s); truth float64[n, 3]: x, y (m), yaw (rad); circuit int64[n]; cycle int64[n]: number of
    the whisk cycle. impingement float64[n, 18] rad; slips int64[n, 18].
    """

    images: NDArray[np.uint8]
    motion: NDArray[np.float64]
    truth: NDArray[np.float64]
    circuit: NDArray[np.int64]
    cycle: NDArray[np.int64]
    impingement: NDArray[np.float64]
    slips: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.cycle)

    def chosen(self, rows: NDArray[np.bool_]) -> Recording:
        """The views of these rows alone."""
        return Recording(**{name: array[rows] for name, array in self.arrays().items()})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The fields by name, as they are stored."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def image(self, kind: str) -> NDArray[np.uint8]:
        """uint8[n, 3, 6] of one kind."""
        return self.images[:, IMAGES.index(kind)].reshape(-1, 3, 6)


def plant_params(case: RigCase) -> HeadPlantParams:
    """The simulated head of a case."""
    usual = HeadPlantParams()
    front, mid, rear = (
        min(tip * case.taper, base)
        for tip, base in zip(usual.shaft_tip_diameter, usual.shaft_base_diameter, strict=True)
    )
    return replace(
        usual,
        servo_stiffness=case.servo,
        shaft_tip_diameter=(front, mid, rear),
        sensor_noise=usual.sensor_noise * case.noise,
    )


def make_setup(case: RigCase) -> tuple[Setup, CircuitPath]:
    """The whisk loop's setup for a case, and the path in it."""
    maze = parse_maze(case.maze, "experiment")
    path = CircuitPath(
        maze, PathParams(case.sequence, case.speed, case.wander, case.yaw), case.seed
    )
    whisk = full_whisk(paper_head(), PERIOD_TICKS, LEAST_SLEW_LIMIT)
    parameters = {} if case.controller == "open_loop" else {"gain": case.gain}
    calibrating = case.calibration_cycles * PERIOD_TICKS
    cycles = -(-path.duration_ns // (TICK_NS * PERIOD_TICKS)) + 1
    ticks = calibrating + cycles * PERIOD_TICKS
    made = Setup(
        boxes=wall_boxes(maze),
        head=plant_params(case),
        seed=case.seed,
        controller=BUILT_IN[case.controller](whisk, **parameters),
        path=path,
        ticks=ticks,
        retract_tick=ticks,
        period_ticks=PERIOD_TICKS,
        calibration_cycles=case.calibration_cycles,
        slew_limit=LEAST_SLEW_LIMIT,
    )
    return made, path


def record(case: RigCase) -> Recording:
    """Run the rig and keep its views up to the end of the last circuit."""
    made, path = make_setup(case)
    departure = case.calibration_cycles * PERIOD_TICKS
    ends = path.ends_ns // TICK_NS + departure
    images, motion, truth, cycle, tick, impingement, slips = [], [], [], [], [], [], []
    for view in views(WhiskLoop(made)):
        if view.last_tick > ends[-1]:
            break
        seen = [getattr(view.images, kind).reshape(WHISKERS) for kind in IMAGES]
        images.append(np.stack(seen))
        motion.append((view.odometry.v, view.odometry.w, view.odometry.dt))
        truth.append(view.truth)
        cycle.append(view.cycle)
        tick.append(view.last_tick)
        impingement.append(view.impingement.copy())
        slips.append(view.slips.copy())
    return Recording(
        images=np.array(images, dtype=np.uint8),
        motion=np.array(motion),
        truth=np.array(truth),
        circuit=np.searchsorted(ends, np.array(tick, dtype=np.int64), side="left"),
        cycle=np.array(cycle, dtype=np.int64),
        impingement=np.array(impingement),
        slips=np.array(slips, dtype=np.int64),
    )


def duration(case: RigCase) -> float:
    """How long the head is on its way in a case, s."""
    return make_setup(case)[0].ticks / TICK_HZ
