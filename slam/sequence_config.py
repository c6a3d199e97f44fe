"""Parameters of the sequence SLAM."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final

from vibrissa.slam.config import ConfigError
from vibrissa.slam.interface import SlamInputError
from vibrissa.slam.odometer import OdometerNoise

BATCH: Final = -1
"""`lag` that decides nothing before the map is asked for, and then from the whole run."""


@dataclass(frozen=True, slots=True)
class SequenceConfig:
    """Parameters of the sequence SLAM, by name.

    lag: whisks after which at the latest it is decided whether a whisk repeats an earlier one; 0 =
        at once, from the past alone; -1 = batch, in the map alone.
    decide_every: whisks decided in one go, at most, and at most a quarter of the lag; the last of
        them has that much less foresight.
    evidence: factor on the learnt weights; far below 1, since whiskers and successive whisks tell
        nearly the same again and again.
    gap: whisks that must lie between a whisk and one it repeats, >= 2.
    stay, skip: chance to advance no whisk, and two; one otherwise.
    enter, leave: chance from new to known and from known to new, per whisk.
    certain: probability of a group of states at one place that makes a loop.
    reach: how far apart the places of a group may be, whisks.
    share: least probability of a member that gets a loop, relative to the best.
    most_loops: members of a group that get a loop, at most.
    gate: standard deviations by which a loop's heading, and its place, may differ from what
        odometry alone says.
    memory: whisks remembered; when full, half of them are forgotten (see sequence_memory).
    window: whisks whose poses are estimated anew with every loop; older ones change in the map
        alone.
    lateral: m, standard deviation of sideways motion per whisk.
    loop_place, loop_heading: m and rad, standard deviation of a loop.
    robust: chi^2 (3 degrees of freedom) at which a loop's pull is a quarter.
    doubt: rad, by how much the heading of a loop must surprise for its whole turns to be tried the
        other way too when the map is solved.
    compass: correct the turn of every step by the walls that are touched (see compass); the image
        has to be that of contact angles.
    compass_wall: rad, standard deviation of a wall's direction.
    odometer: what a step of odometry is worth.

    Raises ConfigError on construction when a value is out of range.
    """

    lag: int = 100
    decide_every: int = 10
    evidence: float = 0.05
    gap: int = 30
    stay: float = 0.1
    skip: float = 0.1
    enter: float = 0.001
    leave: float = 0.001
    certain: float = 0.9
    reach: int = 4
    share: float = 0.1
    most_loops: int = 16
    gate: float = 4.0
    memory: int = 8192
    window: int = 400
    lateral: float = 0.0015
    loop_place: float = 0.015
    loop_heading: float = 0.1
    robust: float = 9.0
    doubt: float = 1.0
    compass: bool = False
    compass_wall: float = 0.01
    odometer: OdometerNoise = field(default_factory=OdometerNoise)

    def __post_init__(self) -> None:
        for parameter in fields(self):
            name = parameter.name
            value: Any = getattr(self, name)
            if name == "compass" and not isinstance(value, bool):
                raise ConfigError(f"{name}: expected true or false, found {value!r}")
            if name in ("compass", "odometer"):
                continue
            whole = str(parameter.type) == "int"
            if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
                raise ConfigError(f"{name}: expected {parameter.type}, found {value!r}")
            low, high = _RANGES[name]
            if not (math.isfinite(value) and low <= value <= high):
                raise ConfigError(f"{name}: expected {low:g} to {high:g}, found {value}")
        if self.stay + self.skip >= 1.0:
            raise ConfigError(
                f"stay and skip: expected a sum below 1, found {self.stay + self.skip:g}"
            )
        if not isinstance(self.odometer, OdometerNoise):
            raise ConfigError(f"odometer: expected OdometerNoise, found {self.odometer!r}")

    @property
    def advance(self) -> tuple[float, float, float]:
        """Chances to advance 0, 1 and 2 whisks."""
        return self.stay, 1.0 - self.stay - self.skip, self.skip


_CHANCE: Final = (1e-9, 0.5)
_RANGES: Final[dict[str, tuple[float, float]]] = {
    "lag": (BATCH, 10_000),
    "decide_every": (1, 10_000),
    "evidence": (0.0, 10.0),
    "gap": (2, 100_000),
    "stay": (0.0, 0.99),
    "skip": (0.0, 0.99),
    "enter": _CHANCE,
    "leave": _CHANCE,
    "certain": (0.51, 1.0),
    "reach": (0, 1000),
    "share": (1e-6, 1.0),
    "most_loops": (1, 64),
    "gate": (0.1, 1e6),
    "memory": (64, 1_000_000),
    "window": (2, 100_000),
    "lateral": (1e-6, 10.0),
    "loop_place": (1e-6, 10.0),
    "loop_heading": (1e-6, 10.0),
    "robust": (1e-3, 1e6),
    "doubt": (0.1, 10.0),
    "compass_wall": (1e-4, 10.0),
}
ODOMETER: Final = "odometer_"
"""Prefix of the fields of `odometer` where parameters are plain names and numbers."""


def sequence_config(parameters: Mapping[str, Any]) -> SequenceConfig:
    """A configuration from plain names and numbers: lag=30, odometer_turn=0.05.

    Raises ConfigError for an unknown name and a value out of range.
    """
    own = {f.name for f in fields(SequenceConfig)} - {"odometer"}
    noise = {ODOMETER + f.name: f.name for f in fields(OdometerNoise)}
    for name, value in parameters.items():
        if name not in own and name not in noise:
            known = ", ".join(sorted([*own, *noise]))
            raise ConfigError(f"{name}: no such parameter of the sequence SLAM; there are {known}")
        if name in noise and (isinstance(value, bool) or not isinstance(value, (int, float))):
            raise ConfigError(f"{name}: expected a number, found {value!r}")
    try:
        odometer = OdometerNoise(**{noise[k]: v for k, v in parameters.items() if k in noise})
    except SlamInputError as error:
        raise ConfigError(str(error).replace("odometer ", ODOMETER, 1)) from None
    changes: dict[str, Any] = {k: v for k, v in parameters.items() if k in own}
    return SequenceConfig(**changes, odometer=odometer)
