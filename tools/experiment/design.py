"""What is run: data sets, conditions, controls, and what the paper reported of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import resources
from typing import Any, Final

from vibrissa.tools.experiment.mapping import MapCase
from vibrissa.tools.experiment.recording import IMAGES, RigCase
from vibrissa.tools.experiment.tasks import Work

MAZE: Final = "board7x5"
SEQUENCE: Final = "CCCAAACACA"
"""3 clockwise, 3 anticlockwise, 2 alternating pairs (Salman and Pearson, III C)."""
CONTROLLERS: Final = ("open_loop", "rcp")
MAX_ANGLE, UNGATED, CONTACT_ANGLE = IMAGES
"""Max angle of a whisker still touching near full protraction, as the paper describes it; of any
that stopped short of where it stops in air; angle at the moment of touch."""
NOISE: Final = "jit"
"""Odometry noise of the main comparison."""
NOISES: Final = ("none", "jit", "third", "full")
FIRST_SEED: Final = 100
TUNING_SEEDS: Final = (900, 901)
THRESHOLDS: Final = (0.001, 0.002, 0.004, 0.008, 0.016)
INJECTIONS: Final = (0.02, 0.05)
SENSITIVITY_SEEDS: Final = 2
SENSITIVITY_CIRCUITS: Final = 2

PAPER: Final = {
    ("open_loop", MAX_ANGLE): {"arr": 0.1765, "em": 0.1916},
    ("rcp", MAX_ANGLE): {"arr": 0.2257, "em": 0.1568},
}
"""The numbers that the paper prints; those of contact angle are in its Figure 7 only."""


@dataclass(frozen=True)
class Effect:
    """A comparison that the paper makes: score from condition `a` to `b`, +1 rises, -1 falls."""

    name: str
    score: str
    a: tuple[str, str]
    b: tuple[str, str]
    sign: int


OPEN_MAX, OPEN_CONTACT = ("open_loop", MAX_ANGLE), ("open_loop", CONTACT_ANGLE)
RCP_MAX, RCP_CONTACT = ("rcp", MAX_ANGLE), ("rcp", CONTACT_ANGLE)
EFFECTS: Final = (
    Effect("RCP instead of open loop, max angle", "arr", OPEN_MAX, RCP_MAX, +1),
    Effect("RCP instead of open loop, max angle", "em", OPEN_MAX, RCP_MAX, -1),
    Effect("RCP instead of open loop, contact angle", "arr", OPEN_CONTACT, RCP_CONTACT, +1),
    Effect("contact instead of max angle, open loop", "arr", OPEN_MAX, OPEN_CONTACT, +1),
    Effect("contact instead of max angle, open loop", "em", OPEN_MAX, OPEN_CONTACT, -1),
    Effect("contact instead of max angle, RCP", "em", RCP_MAX, RCP_CONTACT, +1),
)


@dataclass(frozen=True)
class Scale:
    """How much of it: seeds of the result, circuits, what the sensitivity table varies."""

    seeds: tuple[int, ...]
    sequence: str
    tuning_seeds: tuple[int, ...]
    tuning_circuits: int
    speed: float
    sensitivity_seeds: tuple[int, ...]
    noises: tuple[str, ...]

    @property
    def circuits(self) -> int:
        return len(self.sequence)


def scale(seeds: int, quick: bool) -> Scale:
    """The whole experiment, or a quick look at it: fewer circuits, a faster head, no claim."""
    own = tuple(range(FIRST_SEED, FIRST_SEED + seeds))
    if quick:
        return Scale(own, "CCAACA", TUNING_SEEDS[:1], 2, 0.04, (), (NOISE,))
    return Scale(own, SEQUENCE, TUNING_SEEDS, 3, 0.01, own[:SENSITIVITY_SEEDS], NOISES)


def maze_text() -> str:
    """The 7 x 5 board of the paper's size."""
    return (resources.files("vibrissa.rig") / "mazes" / f"{MAZE}.maze").read_text()


@dataclass(frozen=True)
class Point:
    """A working point: vt_match_threshold and pc_vt_inject_energy."""

    threshold: float
    inject: float

    def applied(self, case: MapCase) -> MapCase:
        return replace(case, threshold=self.threshold, inject=self.inject)


def main_rig(scale: Scale, seed: int, controller: str) -> RigCase:
    """The data set of a seed and a control scheme."""
    return RigCase(maze_text(), seed, controller, scale.sequence, scale.speed)


def straight_rig(scale: Scale, seed: int) -> RigCase:
    """Clockwise circuits only, half as many as the whole: what reversals are compared with."""
    return replace(main_rig(scale, seed, "rcp"), sequence="C" * (scale.circuits // 2))


def tuning_works(scale: Scale) -> list[Work]:
    """The grid of working points, on seeds that the result does not use."""
    works = []
    for seed in scale.tuning_seeds:
        for controller in CONTROLLERS:
            rig = replace(main_rig(scale, seed, controller), sequence="C" * scale.tuning_circuits)
            works.append(Work(rig, tuple(tuning_maps(seed))))
    return works


def tuning_maps(seed: int) -> list[MapCase]:
    """The grid over thresholds and injections, for every kind of image."""
    return [
        MapCase(image, seed, NOISE, threshold=threshold, inject=inject)
        for image in IMAGES
        for threshold in THRESHOLDS
        for inject in INJECTIONS
    ]


def main_maps(seed: int, points: dict[str, Point], noises: tuple[str, ...]) -> list[MapCase]:
    """Every kind of image with its controls under the main noise, fewer under the others."""
    found = []
    for noise in noises:
        for image in IMAGES:
            if noise != NOISE and image == UNGATED:
                continue
            case = points[image].applied(MapCase(image, seed, noise))
            found.append(case)
            if noise == NOISE:
                found.append(replace(case, control="shuffled"))
            if image == MAX_ANGLE or (noise == NOISE and image == CONTACT_ANGLE):
                found.append(replace(case, control="blind"))
    return found


def figure4_maps(
    scale: Scale, seed: int, points: dict[str, Point]
) -> dict[str, dict[str, MapCase]]:
    """image -> behaviour -> SLAM run of figure 4; `reverse` runs over the main data set."""
    half = scale.circuits // 2
    once = ((half - 1, 0.9, 1.2),)
    often = tuple((circuit, 0.4 + 0.5 * circuit, 0.6) for circuit in range(1, half))
    found = {}
    for image in (MAX_ANGLE, CONTACT_ANGLE):
        plain = points[image].applied(MapCase(image, seed, NOISE, circuits=half))
        found[image] = {
            "plain": plain,
            "kidnapped once": replace(plain, skips=once),
            "kidnapped often": replace(plain, skips=often),
            "reversed": plain,
        }
    return found


@dataclass(frozen=True)
class Variant:
    """One row of the sensitivity table: what is changed of the rig, or of the SLAM's threshold."""

    what: str
    value: str
    rig: tuple[tuple[str, Any], ...] = ()
    threshold_factor: float = 1.0
    controllers: tuple[str, ...] = CONTROLLERS


def variants() -> list[Variant]:
    """The rows of the sensitivity table."""
    found = [Variant("(as in the main comparison)", "")]
    for servo in (0.01, 0.03, 0.1, 1.0):
        found.append(Variant("motor stiffness, N m/rad", f"{servo:g}", (("servo", servo),)))
    found.append(Variant("taper", "cylinder", (("taper", 10.0),)))
    for noise in (0.2, 5.0):
        found.append(Variant("sensor noise", f"x {noise:g}", (("noise", noise),)))
    for gain in (1.0, 10.0):
        found.append(Variant("RCP gain", f"{gain:g}", (("gain", gain),), 1.0, ("rcp",)))
    for speed in (0.02, 0.04):
        found.append(Variant("head speed, mm per whisk", f"{1e3 * speed:g}", (("speed", speed),)))
    for wander in (0.0, 0.004):
        found.append(Variant("path jitter, mm", f"{1e3 * wander:g}", (("wander", wander),)))
    for factor in (0.5, 2.0):
        found.append(Variant("match threshold", f"x {factor:g}", (), factor))
    for name in ("spread_reduction", "contralateral_protraction", "mimc"):
        change = (("controller", name),)
        found.append(Variant("control", name.replace("_", " "), change, 1.0, ("rcp",)))
    return found


def variant_work(
    scale: Scale, variant: Variant, seed: int, controller: str, points: dict[str, Point]
) -> Work:
    """The data set and the SLAM runs of a row for one seed and control scheme."""
    rig = main_rig(scale, seed, controller)
    if variant.rig:
        rig = replace(rig, sequence="C" * SENSITIVITY_CIRCUITS, **dict(variant.rig))
    maps = [
        replace(
            points[image].applied(MapCase(image, seed, NOISE, circuits=SENSITIVITY_CIRCUITS)),
            threshold=points[image].threshold * variant.threshold_factor,
        )
        for image in IMAGES
    ]
    return Work(rig, tuple(maps))


def before_alternation(scale: Scale, seed: int, points: dict[str, Point]) -> MapCase:
    """The SLAM run of figure 5, left: up to the end of the anticlockwise circuits."""
    steady = scale.sequence.rfind("AA") + 2
    return points[MAX_ANGLE].applied(MapCase(MAX_ANGLE, seed, NOISE, circuits=steady))


def result_works(scale: Scale, points: dict[str, Point]) -> list[Work]:
    """All data sets and SLAM runs of the result."""
    works = []
    for seed in scale.seeds:
        behaviours = figure4_maps(scale, seed, points).values()
        for controller in CONTROLLERS:
            maps = main_maps(seed, points, scale.noises)
            if controller == "rcp":
                maps += [cases["reversed"] for cases in behaviours]
            if seed == scale.seeds[0] and controller == "open_loop":
                maps.append(before_alternation(scale, seed, points))
            works.append(Work(main_rig(scale, seed, controller), tuple(maps)))
        straight = [case for cases in behaviours for case in cases.values()]
        works.append(Work(straight_rig(scale, seed), tuple(dict.fromkeys(straight))))
    for seed in scale.sensitivity_seeds:
        for variant in variants():
            works += [
                variant_work(scale, variant, seed, controller, points)
                for controller in variant.controllers
            ]
    return works
