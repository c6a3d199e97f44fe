"""Which SLAMs there are: built in, installed as entry points, or named by the user.

The rule is that of whisk controllers: an entry point of the group `vibrissa.slams`, or
"module:Class" under [slams] in the experiment file, made as `Class(**parameters)` and used through
`vibrissa.slam.interface.Slam`. Nothing that comes over a socket is ever imported.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
from collections.abc import Callable, Mapping
from typing import Any, Final

from vibrissa.control.kinematics import NOSE_HEIGHT, paper_head
from vibrissa.processes.config import Experiment
from vibrissa.processes.controllers import imported
from vibrissa.processes.odometer_file import from_text
from vibrissa.processes.results import RunError
from vibrissa.slam.compass import HeadShape
from vibrissa.slam.config import PRESETS, ConfigError, RatSlamConfig
from vibrissa.slam.interface import Slam
from vibrissa.slam.odometry import NOISE_MODELS
from vibrissa.slam.ratslam import RatSlam
from vibrissa.slam.sequence import SequenceSlam
from vibrissa.slam.sequence_config import ODOMETER, SequenceConfig, sequence_config
from vibrissa.slam.sequence_rehearsal import rehearse

ENTRY_POINTS: Final = "vibrissa.slams"
COMPASS_IMAGE: Final = "contact_angle"
"""The image that tells where a tip was when it touched."""


def make_slam_config(
    experiment: Experiment, parameters: Mapping[str, Any] | None = None
) -> RatSlamConfig:
    """The RatSLAM parameters of an experiment, others over them. Raises RunError for a bad one.

    With another `preset` among the parameters, the experiment's own no longer count.
    """
    settings = experiment.slam
    changes: dict[str, Any] = dict(parameters or {})
    own = {} if "preset" in changes else _section(experiment, "ratslam")
    preset = changes.pop("preset", settings.preset)
    if preset not in PRESETS:
        raise RunError(f"slam.preset: {preset!r}, expected one of {', '.join(PRESETS)}")
    if settings.odometry_noise not in NOISE_MODELS:
        raise RunError(
            f"slam.odometry_noise: {settings.odometry_noise!r}, "
            f"expected one of {', '.join(NOISE_MODELS)}"
        )
    known = {f.name for f in dataclasses.fields(RatSlamConfig)}
    for name in own | changes:
        if name not in known:
            raise RunError(f"slam.parameters.{name}: no such RatSLAM parameter")
    try:
        return dataclasses.replace(PRESETS[preset], **(own | changes))
    except ConfigError as error:
        raise RunError(f"slam.parameters.{error}") from None


def make_sequence_config(
    experiment: Experiment, parameters: Mapping[str, Any] | None = None
) -> SequenceConfig:
    """The sequence SLAM's parameters of an experiment, others over them. Raises RunError.

    What an odometer file says holds for every SLAM of the run; parameters go before it.
    """
    own = _odometer(experiment) | _section(experiment, "sequence")
    try:
        made = sequence_config(own | dict(parameters or {}))
    except ValueError as error:
        raise RunError(f"slam.parameters.{error}") from None
    if made.compass and experiment.slam.image != COMPASS_IMAGE:
        raise RunError(
            f"slam.parameters.compass: expected slam.image {COMPASS_IMAGE!r} with it,"
            f" found {experiment.slam.image!r}"
        )
    return made


def head_shape() -> HeadShape:
    """Where the whiskers of the head are while it travels."""
    head = paper_head()
    return HeadShape(head.pivot_height + NOSE_HEIGHT, head.pivot_radius, head.length, head.azimuth)


def _section(experiment: Experiment, name: str) -> dict[str, Any]:
    """What `slam.parameters` says to a built-in SLAM: to `sequence` where that is the algorithm,
    to RatSLAM else."""
    meant = "sequence" if experiment.slam.algorithm == "sequence" else "ratslam"
    return dict(experiment.slam.parameters) if name == meant else {}


def _odometer(experiment: Experiment) -> dict[str, Any]:
    """What the odometer file of an experiment says, as parameters. Raises RunError."""
    settings = experiment.slam
    if not settings.odometer_text:
        return {}
    noise, model = from_text(settings.odometer_text, f"slam.odometer {settings.odometer}")
    if model != settings.odometry_noise:
        raise RunError(
            f"slam.odometer {settings.odometer} is of odometry_noise {model!r},"
            f" slam.odometry_noise is {settings.odometry_noise!r}"
        )
    return {ODOMETER + name: value for name, value in dataclasses.asdict(noise).items()}


def check(experiment: Experiment) -> None:
    """Judge an experiment's [slam] section. Raises RunError."""
    make_slam_config(experiment)
    make_sequence_config(experiment)


def _ratslam(experiment: Experiment, parameters: dict[str, Any]) -> Slam:
    return RatSlam(make_slam_config(experiment, parameters))


def _sequence(experiment: Experiment, parameters: dict[str, Any]) -> Slam:
    return SequenceSlam(make_sequence_config(experiment, parameters), head_shape())


BUILT_IN: Final[dict[str, Callable[[Experiment, dict[str, Any]], Slam]]] = {
    "ratslam": _ratslam,
    "sequence": _sequence,
}


COMPILED_LATE: Final[dict[str, Callable[[], object]]] = {"sequence": rehearse}
"""Built-in SLAMs of which a few steps do not compile everything, and what does."""


def warm(name: str, experiment: Experiment) -> None:
    """Compile what a SLAM would otherwise compile in the middle of a run."""
    if name not in experiment.slams and name in COMPILED_LATE:
        COMPILED_LATE[name]()


def available(experiment: Experiment) -> dict[str, str]:
    """name -> where it comes from, of every SLAM that can be asked for in this experiment."""
    found = dict.fromkeys(BUILT_IN, "built in")
    for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
        found.setdefault(point.name, f"{point.value} (installed)")
    found.update(experiment.slams)
    return found


def make_slam(name: str, experiment: Experiment, parameters: str = "") -> Slam:
    """A SLAM by name; parameters: a JSON object. Raises RunError that says what is wrong."""
    try:
        chosen = json.loads(parameters or "{}")
    except ValueError:
        chosen = None
    if not isinstance(chosen, dict):
        raise RunError(f"slam {name}: expected parameters as a JSON object")
    if name not in experiment.slams and name in BUILT_IN:
        return BUILT_IN[name](experiment, chosen)
    try:
        made: Slam = imported("slam", name, _target(name, experiment))(**chosen)
    except (TypeError, ValueError) as error:
        raise RunError(f"slam {name}: {error}") from None
    for method in ("step", "map"):
        if not callable(getattr(made, method, None)):
            raise RunError(f"slam {name}: {type(made).__name__} has no method {method}")
    return made


def _target(name: str, experiment: Experiment) -> str:
    if name in experiment.slams:
        return experiment.slams[name]
    for point in importlib.metadata.entry_points(group=ENTRY_POINTS, name=name):
        return point.value
    known = ", ".join(available(experiment))
    raise RunError(f"slam {name} is not installed; installed are {known}")
