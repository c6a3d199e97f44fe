"""Experiment files: TOML checked by a schema, resolved into everything a run depends on.

A resolved experiment holds the text of its maze, so that it alone (it travels in the log) rebuilds
every node of the run.
"""

from __future__ import annotations

import itertools
import math
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vibrissa.messages.types import TICK_HZ
from vibrissa.processes.calibration_file import VIRTUAL_HEAD, from_text
from vibrissa.processes.results import RunError
from vibrissa.rig.devices.limits import ARM, HEAD

DEFAULT_MAZE = "board7x5.maze"
RETRACT_S = 0.5
"""The last half second of a run: whiskers retract, the arm holds."""


class Section(BaseModel):
    """A table of an experiment file: unknown keys are refused, values can't change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Run(Section):
    """[run]"""

    duration: Annotated[float, Field(ge=1, le=86400 * 7, description="s, simulated or real")] = 30.0
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1
    together: Annotated[
        list[list[str]],
        Field(description="groups of nodes that share one process; rig: that of a real head, too"),
    ] = []
    realtime: Annotated[bool, Field(description="ask for SCHED_FIFO and locked memory")] = True
    transport: Annotated[Literal["ipc", "tcp"], Field(description="tcp: loopback only")] = "ipc"
    tcp_port: Annotated[
        int, Field(ge=1024, le=65000, description="first of the ports, one per process (19)")
    ] = 5790


class Maze(Section):
    """[maze]"""

    file: Annotated[str, Field(description="a micromouse maze file, or one that is shipped")] = (
        DEFAULT_MAZE
    )
    text: Annotated[str, Field(description="the file's content; filled in when it is read")] = ""


class Rig(Section):
    """[rig]: the devices, by URL."""

    head: Annotated[
        str,
        Field(
            min_length=1,
            max_length=200,
            description="virtual, serial:PORT or can:INTERFACE:CHANNEL",
        ),
    ] = "virtual"
    arm: Annotated[str, Field(min_length=1, max_length=200, description="virtual or rtde:HOST")] = (
        "virtual"
    )
    emulate: Annotated[
        bool, Field(description="play devices that are not virtual by emulators of this machine")
    ] = False
    sample_ticks: Annotated[
        int, Field(ge=80, le=4000, description="without a sample of the head after which it stops")
    ] = HEAD.silence_ticks
    command_ticks: Annotated[
        int, Field(ge=80, le=4000, description="without a command that answers a sample, likewise")
    ] = HEAD.overrun_ticks
    news_ticks: Annotated[
        int, Field(ge=200, le=4000, description="without news of the head at the arm, likewise")
    ] = ARM.blind_ticks
    state_ticks: Annotated[
        int, Field(ge=40, le=4000, description="without a state of the arm, likewise")
    ] = ARM.stale_ticks
    setpoint_ticks: Annotated[
        int, Field(ge=40, le=4000, description="without a set-point for the arm, likewise")
    ] = ARM.stale_setpoint_ticks

    @property
    def virtual(self) -> bool:
        """Whether the rig is simulated inside the run, so that a re-run can compute it."""
        return self.head == self.arm == "virtual"

    @property
    def real(self) -> bool:
        """Whether anything real moves, for which a person has to give the start."""
        return not (self.virtual or self.emulate)


class Head(Section):
    """[head]: the simulated head. Ranges are those the mechanics are tested in."""

    motor_stiffness: Annotated[float, Field(gt=0, le=100, description="N m/rad")] = 0.3
    motor_frequency: Annotated[float, Field(ge=1, le=100, description="Hz")] = 10.0
    moment_noise: Annotated[float, Field(ge=0, le=1e-3, description="N m, standard deviation")] = (
        1e-5
    )
    angle_noise: Annotated[float, Field(ge=0, le=0.1, description="rad, standard deviation")] = (
        0.1 * 3.141592653589793 / 180
    )


class Whisk(Section):
    """[whisk]"""

    controller: Annotated[str, Field(description="open_loop, rcp, or one that was added")] = "rcp"
    parameters: Annotated[
        dict[str, float | int | bool | str], Field(description="of a controller that was added")
    ] = {}
    period: Annotated[float, Field(ge=0.2, le=10, description="s per whisk cycle")] = 1.0
    calibration_cycles: Annotated[int, Field(ge=1, le=1000)] = 4
    rcp_gain: Annotated[float, Field(ge=0, le=1000, description="in contact stiffnesses")] = 3.0
    calibration: Annotated[
        str, Field(description="file of vibrissa calibrate, instead of calibrating")
    ] = ""
    calibration_text: Annotated[
        str, Field(description="the file's content; filled in when it is read")
    ] = ""
    rcp_window: Annotated[float, Field(ge=0.0005, le=1, description="s, averaging window")] = 0.01

    @property
    def calibrated_head(self) -> str:
        """Serial number of the head that the calibration file is of; empty without one."""
        if not self.calibration_text:
            return ""
        return from_text(self.calibration_text, self.calibration)[1]


class Arm(Section):
    """[arm]: the circuit through the outer cells of the maze."""

    sequence: Annotated[
        str, Field(pattern="^[CA]{1,100}$", description="C clockwise, A anticlockwise circuits")
    ] = "CCCAAACACA"
    speed: Annotated[float, Field(gt=0, le=0.25, description="m/s")] = 0.04
    unwind: Annotated[
        bool,
        Field(description="turn back between circuits: joints have ends"),
    ] = False
    lift: Annotated[
        float, Field(ge=0, le=0.3, description="m above the working height while calibrating")
    ] = 0.1


class Slam(Section):
    """[slam]"""

    algorithm: Annotated[str, Field(description="ratslam, sequence or one added")] = "ratslam"
    image: Annotated[
        Literal["max_angle_gated", "max_angle_ungated", "contact_angle"],
        Field(description="gated: still in contact near full protraction"),
    ] = "max_angle_gated"
    preset: Annotated[str, Field(description="named RatSLAM parameter set")] = "whisker"
    parameters: Annotated[
        dict[str, float | int | bool], Field(description="over the preset; sequence: docs/slam.md")
    ] = {}
    odometry_noise: Annotated[str, Field(description="named odometry noise model")] = "none"
    odometer: Annotated[
        str, Field(description="file of vibrissa calibrate odometry, for the sequence SLAM")
    ] = ""
    odometer_text: Annotated[
        str, Field(description="the file's content; filled in when it is read")
    ] = ""


class Swap(Section):
    """[[swap]]: a controller, SLAM or circuits that take over at the start of a whisk cycle."""

    node: Annotated[
        Literal["whisk", "slam", "arm"],
        Field(description="whose: whisk controller, SLAM, or the arm's circuits, e.g. to = 'CCA'"),
    ] = "whisk"
    at_cycle: Annotated[int, Field(ge=1, le=10**7)]
    to: Annotated[str, Field(min_length=1, max_length=100, description="name of a controller")]
    blend: Annotated[float, Field(ge=0, le=10, description="s, from old command to new")] = 0.0


class Experiment(Section):
    """A whole experiment file."""

    run: Run = Run()
    maze: Maze = Maze()
    rig: Rig = Rig()
    head: Head = Head()
    whisk: Whisk = Whisk()
    arm: Arm = Arm()
    slam: Slam = Slam()
    controllers: Annotated[
        dict[
            Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,39}$")],
            Annotated[str, Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")],
        ],
        Field(description='[controllers]: name = "module:Class"'),
    ] = {}
    slams: Annotated[
        dict[
            Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,39}$")],
            Annotated[str, Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")],
        ],
        Field(description='[slams]: name = "module:Class"'),
    ] = {}
    swap: list[Swap] = []

    @property
    def ticks(self) -> int:
        """Length of the run in ticks."""
        return round(self.run.duration * TICK_HZ)

    @property
    def retract_tick(self) -> int:
        """The tick at which whiskers start to retract for the end of the run."""
        return self.ticks - round(RETRACT_S * TICK_HZ)

    @property
    def period_ticks(self) -> int:
        """Length of a whisk cycle in ticks."""
        return round(self.whisk.period * TICK_HZ)

    @model_validator(mode="after")
    def _fits(self) -> Experiment:
        from vibrissa.processes.table import PROCESSES

        seen: set[str] = set()
        for group in self.run.together:
            for node in group:
                if node not in PROCESSES:
                    raise ValueError(f"run.together: {node!r} is none of {', '.join(PROCESSES)}")
                if node in seen:
                    raise ValueError(f"run.together: {node!r} is named twice")
                seen.add(node)
        for node in ("whisk", "slam", "arm"):
            cycles = [swap.at_cycle for swap in self.swap if swap.node == node]
            if any(later - earlier < 2 for earlier, later in itertools.pairwise(cycles)):
                raise ValueError(
                    f"swap: expected at_cycle of {node} to grow by at least 2 from entry to entry"
                )
        return self


LEAST_SLEW_LIMIT = 0.005
"""Largest change of a command per tick, rad, unless fast whisking itself needs more."""


def slew_limit(experiment: Experiment) -> float:
    """rad per tick: what no command may exceed, a fifth above the whisk's own steepest change."""
    from vibrissa.control.kinematics import paper_head

    swing = float(paper_head().swing.max())
    return max(LEAST_SLEW_LIMIT, 1.2 * swing * math.pi / experiment.period_ticks)


def load_experiment(
    path: Path | None = None,
    *,
    duration: float | None = None,
    controller: str | None = None,
    seed: int | None = None,
) -> Experiment:
    """Read, check and resolve an experiment file; None gives the default experiment.

    The keyword arguments, where given, replace what the file says. Raises RunError with one line
    that names the file, the key, the value and what is allowed.
    """
    where = str(path) if path else "experiment"
    content: dict[str, Any] = {}
    if path is not None:
        try:
            content = tomllib.loads(path.read_text())
        except OSError as error:
            raise RunError(f"{path}: {error.strerror}") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise RunError(f"{path}: not a TOML file: {error}") from None
    overrides = {
        ("run", "duration"): duration,
        ("whisk", "controller"): controller,
        ("run", "seed"): seed,
    }
    for (section, key), value in overrides.items():
        if value is not None and isinstance(content.setdefault(section, {}), dict):
            content[section][key] = value
    try:
        experiment = Experiment.model_validate(content, strict=False)
    except ValidationError as error:
        raise RunError(f"{where}: " + "; ".join(_complaints(error))) from None
    if not experiment.maze.text:
        try:
            text = _maze_text(experiment.maze.file, path.parent if path else Path())
        except RunError as error:
            raise RunError(f"{where}: {error}") from None
        maze = experiment.maze.model_copy(update={"text": text})
        experiment = experiment.model_copy(update={"maze": maze})
    for section, key in (("whisk", "calibration"), ("slam", "odometer")):
        experiment = _with_text(experiment, section, key, path, where)
    _check_parts(experiment, where)
    return experiment


def _with_text(
    experiment: Experiment, section: str, key: str, path: Path | None, where: str
) -> Experiment:
    """The experiment with the content of the file that a key names. Raises RunError."""
    table: Section = getattr(experiment, section)
    named = getattr(table, key)
    if not named or getattr(table, f"{key}_text"):
        return experiment
    try:
        text = ((path.parent if path else Path()) / named).read_text()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise RunError(f"{where}: {section}.{key} {named!r}: {why}") from None
    return experiment.model_copy(update={section: table.model_copy(update={f"{key}_text": text})})


def _check_parts(experiment: Experiment, where: str) -> None:
    """What only the nodes' own modules can judge: maze, circuit, controller, RatSLAM parameters."""
    from vibrissa.processes import controllers, slams
    from vibrissa.processes.arm import make_path
    from vibrissa.processes.emulators import check

    known = {"whisk": controllers.available(experiment), "slam": slams.available(experiment)}
    named = [
        ("whisk", "whisk.controller", experiment.whisk.controller),
        ("slam", "slam.algorithm", experiment.slam.algorithm),
    ]
    named += [(swap.node, "swap.to", swap.to) for swap in experiment.swap if swap.node in known]
    for node, key, name in named:
        if name not in known[node]:
            raise RunError(f"{where}: {key} {name!r}: expected one of {', '.join(known[node])}")
    try:
        make_path(experiment)
        for swap in experiment.swap:
            if swap.node == "arm":
                make_path(experiment, swap.to)
        slams.check(experiment)
        check(experiment)
        of = experiment.whisk.calibrated_head
        if of not in ("", VIRTUAL_HEAD) and experiment.rig.head == "virtual":
            raise RunError(f"whisk.calibration is of head {of}, rig.head is virtual")
    except (ValueError, RunError) as error:
        raise RunError(f"{where}: {error}") from None


def _complaints(error: ValidationError) -> Iterator[str]:
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"]) or "experiment"
        if item["type"] == "extra_forbidden":
            yield f"{key}: unknown key (expected one of {', '.join(_siblings(item['loc']))})"
        else:
            found = item.get("input")
            shown = "" if isinstance(found, dict) else f", found {found!r}"
            yield f"{key}: {item['msg']}{shown}"


def _siblings(location: tuple[int | str, ...]) -> list[str]:
    model: Any = Experiment
    for part in location[:-1]:
        model = model.model_fields[part].annotation
    return list(model.model_fields)


def _maze_text(name: str, folder: Path) -> str:
    """The text of a maze file: relative to the experiment file, or one of those shipped."""
    candidates = [folder / name, Path(name)]
    for candidate in candidates:
        if candidate.is_file():
            try:
                return candidate.read_text()
            except (OSError, UnicodeDecodeError) as error:
                raise RunError(f"maze.file {candidate}: can't be read as text: {error}") from None
    shipped = resources.files("vibrissa.rig") / "mazes"
    if "/" not in name and (shipped / name).is_file():
        return (shipped / name).read_text()
    names = sorted(f.name for f in shipped.iterdir() if f.name.endswith(".maze"))
    raise RunError(
        f"maze.file {name!r}: no such file, here or beside the experiment "
        f"(shipped: {', '.join(names)})"
    )
