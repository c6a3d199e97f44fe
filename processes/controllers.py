"""Which whisk controllers there are: built in, installed as entry points, or named by the user.

Third parties add controllers in two ways: as an entry point of the group `vibrissa.controllers`, or
as "module:Class" under [controllers] in the experiment file. Only these names can be asked for
while a run goes on; nothing that comes over a socket is ever imported.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
from collections.abc import Callable
from typing import Any, Final

from vibrissa.control.controller import Controller
from vibrissa.control.kinematics import paper_head
from vibrissa.control.open_loop import OpenLoop
from vibrissa.control.rcp import Rcp, RcpParams, normalised_gain
from vibrissa.control.social import contralateral_protraction, mimc, spread_reduction
from vibrissa.control.whisk_pattern import WhiskParams, full_whisk
from vibrissa.messages.types import TICK_HZ
from vibrissa.processes.config import Experiment, slew_limit
from vibrissa.processes.results import RunError

ENTRY_POINTS: Final = "vibrissa.controllers"

Maker = Callable[..., Controller]
"""(whisk: WhiskParams, **parameters) -> Controller"""


def _open_loop(whisk: WhiskParams) -> Controller:
    return OpenLoop(whisk)


def _rcp(whisk: WhiskParams, gain: float = 3.0, window: float = 0.01) -> Controller:
    ticks = max(round(window * TICK_HZ), 1)
    return Rcp(RcpParams(whisk, normalised_gain(gain), ticks))


BUILT_IN: Final[dict[str, Maker]] = {
    "open_loop": _open_loop,
    "rcp": _rcp,
    "spread_reduction": spread_reduction,
    "contralateral_protraction": contralateral_protraction,
    "mimc": mimc,
}


def available(experiment: Experiment) -> dict[str, str]:
    """name -> where it comes from, of every controller that can be asked for in this experiment."""
    found = dict.fromkeys(BUILT_IN, "built in")
    for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
        found.setdefault(point.name, f"{point.value} (installed)")
    found.update(experiment.controllers)
    return found


def make_controller(name: str, experiment: Experiment, parameters: str = "") -> Controller:
    """A controller by name, with parameters as a JSON object on top of the experiment's own.

    Raises RunError that says what is wrong with the name, its class or its parameters.
    """
    whisk = full_whisk(paper_head(), experiment.period_ticks, slew_limit(experiment))
    try:
        extra = json.loads(parameters or "{}")
    except ValueError:
        extra = None
    if not isinstance(extra, dict):
        raise RunError(f"controller {name}: expected parameters as a JSON object")
    chosen: dict[str, Any] = dict(experiment.whisk.parameters)
    if name == "rcp":
        chosen = {"gain": experiment.whisk.rcp_gain, "window": experiment.whisk.rcp_window}
    elif name != experiment.whisk.controller:
        chosen = {}
    maker = _maker(name, experiment)
    try:
        made = maker(whisk, **(chosen | extra))
    except (TypeError, ValueError) as error:
        raise RunError(f"controller {name}: {error}") from None
    for method in ("activate", "calibrate", "step"):
        if not callable(getattr(made, method, None)):
            raise RunError(f"controller {name}: {type(made).__name__} has no method {method}")
    return made


def _maker(name: str, experiment: Experiment) -> Maker:
    if name in experiment.controllers:
        return imported("controller", name, experiment.controllers[name])
    if name in BUILT_IN:
        return BUILT_IN[name]
    points = importlib.metadata.entry_points(group=ENTRY_POINTS, name=name)
    for point in points:
        return imported("controller", name, point.value)
    raise RunError(
        f"controller {name} is not installed; installed are {', '.join(available(experiment))}"
    )


def imported(what: str, name: str, target: str) -> Callable[..., Any]:
    """The class that "module:Class" names. Raises RunError that says `what` `name` is."""
    module, _, attribute = target.partition(":")
    try:
        maker: Callable[..., Any] = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever a stranger's module raises on import
        raise RunError(f"{what} {name} ({target}): {type(error).__name__}: {error}") from None
    return maker
