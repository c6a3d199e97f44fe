"""`vibrissa new-controller`: a package with a working control law, to be changed from there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Final

import typer

from vibrissa.tools.console import Json, note, print_json, stdout

PROJECT: Final = """\
[build-system]
requires = ["setuptools>=61"]
build-backend = "setuptools.build_meta"

[project]
name = "{package}"
version = "0.1.0"
description = "A whisk controller for vibrissa"
requires-python = ">=3.11"
dependencies = ["vibrissa"]

[project.entry-points."vibrissa.controllers"]
{name} = "{package}:{title}"

[tool.setuptools]
py-modules = ["{package}"]
"""

MODULE: Final = '''\
"""Whisks with a share of the full amplitude; a whisker that feels a touch goes no further out."""

from __future__ import annotations

import math

import numpy as np

from vibrissa.control.calibration import Calibration
from vibrissa.control.controller import LAST, LawController, slewed
from vibrissa.control.kinematics import Float32s, Float64s
from vibrissa.control.whisk_pattern import (
    AMPLITUDE,
    MINIMUM,
    PERIOD,
    SLEW,
    WHISK_ROWS,
    WhiskParams,
    desired_angle,
    protraction_at,
)
from vibrissa.numerics import compiled

# Rows of the parameter array after the whisk's own.
SHARE, MEAN, THRESHOLD = range(WHISK_ROWS, WHISK_ROWS + 3)


@compiled
def law(
    tick: int,
    theta: Float32s,
    x: Float32s,
    y: Float32s,
    parameters: Float64s,
    state: Float64s,
    command: Float32s,
) -> None:
    """The control law: it answers one sample, and is the only thing that runs at 2 kHz.

    It sees nothing but its arguments: no clock, no file, no global, or a recorded run could not be
    run again. theta (rad), x and y (N m) are what 18 whiskers measured; whisker i = ring * 6 + k.
    What it must remember it keeps in `state`, whose row LAST holds the last command and whose other
    rows are zero when it gets the drives. What it decides it writes into `command`, rad.
    """
    share = protraction_at(tick, int(parameters[PERIOD, 0]))
    for i in range(command.shape[0]):
        amplitude = parameters[SHARE, i] * parameters[AMPLITUDE, i]
        desired = desired_angle(parameters[MINIMUM, i], amplitude, share)
        if abs(y[i] - parameters[MEAN, i]) > parameters[THRESHOLD, i]:
            desired = min(desired, state[LAST, i])
        command[i] = slewed(desired, state[LAST, i], parameters[SLEW, i])
        state[LAST, i] = command[i]


class {title}(LawController):
    """The controller that runs and experiments know as "{name}".

    whisk is the experiment's; every other argument is a parameter of the controller, which comes
    from `--param` or from [whisk.parameters]. Raises ValueError for one that is out of range.
    """

    def __init__(self, whisk: WhiskParams, share: float = 0.5) -> None:
        parameters = np.zeros((WHISK_ROWS + 3, 18))
        parameters[:WHISK_ROWS] = whisk.rows()
        parameters[THRESHOLD] = math.inf  # feels nothing until it is calibrated
        super().__init__(law, parameters, state_rows=1)
        self.set_parameter("share", share)

    @property
    def needs_calibration(self) -> bool:
        return bool(self.parameters[THRESHOLD, 0] == math.inf)

    def calibrate(self, calibration: Calibration) -> None:
        """Take from free whisking what y is without a touch, and how far noise carries it."""
        self.parameters[MEAN] = calibration.mean_y
        self.parameters[THRESHOLD] = calibration.threshold_y

    def set_parameter(self, name: str, value: object) -> None:
        """What `vibrissa set {name}.share VALUE` calls. Raises ValueError."""
        if name != "share":
            raise ValueError(f"{{name}}: expected share, nothing else can be changed")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= 1:
            raise ValueError(f"share: found {{value!r}}, expected 0 to 1")
        self.parameters[SHARE] = value
'''

TEST: Final = '''\
"""What every controller has to keep, and what this one is for."""

import numpy as np
import pytest
from {package} import {title}

from vibrissa.control.controller import LAST
from vibrissa.control.kinematics import paper_head
from vibrissa.control.whisk_pattern import full_whisk

WHISK = full_whisk(paper_head())
NOTHING = np.zeros(18, np.float32)


def commands(controller, ticks=WHISK.period_ticks, first=0, y=NOTHING):
    theta = NOTHING
    given = []
    for tick in range(first, first + ticks):
        theta = controller.step(tick, theta, NOTHING, y)
        given.append(theta)
    return np.array(given)


def test_commands_stay_within_the_travel_and_the_slew_limit():
    given = commands({title}(WHISK))
    assert given.dtype == np.float32 and given.shape[1] == 18
    assert (given >= 0).all() and (given <= paper_head().swing).all()
    assert np.abs(np.diff(given, axis=0)).max() <= WHISK.slew_limit + 1e-6


def test_it_takes_over_from_what_the_drives_hold():
    controller = {title}(WHISK)
    held = np.full(18, 0.4, np.float32)
    controller.activate(700, held, held)
    assert np.array_equal(controller.state[LAST], held.astype(float))
    assert np.abs(commands(controller, 1, 700)[0] - held).max() <= WHISK.slew_limit + 1e-6


def test_it_whisks_with_half_the_amplitude():
    assert commands({title}(WHISK)).max(axis=0) == pytest.approx(paper_head().swing / 2)


def test_a_touched_whisker_goes_no_further_out():
    controller = {title}(WHISK)
    out = commands(controller, 500)[-1]
    controller.parameters[-1] = 1e-4
    touched = np.zeros(18, np.float32)
    touched[5] = 1e-3
    later = commands(controller, 100, 500, touched)[-1]
    assert later[5] == out[5]
    assert (np.delete(later, 5) > np.delete(out, 5)).all()


@pytest.mark.parametrize(("name", "value"), [("share", 1.5), ("share", "much"), ("gain", 1.0)])
def test_a_parameter_out_of_range_is_refused(name, value):
    with pytest.raises(ValueError, match=name):
        {title}(WHISK).set_parameter(name, value)
'''

FILES: Final = {"pyproject.toml": PROJECT, "{package}.py": MODULE, "test_{package}.py": TEST}


def new_controller(
    name: Annotated[str, typer.Argument(help="Its name: lower case, digits, underscores.")],
    out: Annotated[
        Path | None, typer.Option(help="New directory for it. Default: ./NAME_controller.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a package with a working controller and its test, to be changed from there."""
    from vibrissa.processes.controllers import BUILT_IN
    from vibrissa.processes.results import RunError

    if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", name):
        raise RunError(f"{name!r}: expected a lower-case name such as half_amplitude")
    if name in (*BUILT_IN, "retract", "whisk"):
        raise RunError(f"{name!r}: is built in, choose another name")
    folder = out or Path(f"{name}_controller")
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise RunError(f"{folder}: exists, and is left as it is") from None
    written = write(name, folder)
    if as_json:
        print_json({"controller": name, "files": written})
        return
    for path in written:
        stdout().print(str(path), markup=False)
    note(f"next: python -m pytest {folder}; pip install {folder}; vibrissa run --controller {name}")


def write(name: str, folder: Path) -> list[Path]:
    """The files of a controller package in an existing directory."""
    package = f"{name}_controller"
    title = "".join(part.capitalize() for part in name.split("_"))
    written = []
    for path, text in FILES.items():
        file = folder / path.format(package=package)
        file.write_text(text.format(name=name, package=package, title=title))
        written.append(file)
    return written


VERBS = ((new_controller, "vibrissa new-controller half_amplitude"),)
