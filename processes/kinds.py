"""What can be loaded and swapped while a run goes on: whisk controllers and SLAMs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from vibrissa.processes import controllers, slams
from vibrissa.processes.config import Experiment
from vibrissa.processes.results import RunError
from vibrissa.processes.table import SLAM_SLOTS, SLOTS, Process


def scheduled_slots(experiment: Experiment) -> dict[str, str]:
    """slot -> controller for everything the experiment's schedule will load, in its order."""
    found: dict[str, str] = {}
    for node, slots, first in (
        ("whisk", SLOTS, experiment.whisk.controller),
        ("slam", SLAM_SLOTS, experiment.slam.algorithm),
    ):
        wanted = dict.fromkeys(swap.to for swap in experiment.swap if swap.node == node)
        wanted.pop(first, None)
        found |= dict(zip(slots, wanted, strict=False))
    return found


@dataclass
class Kind:
    """What can be swapped: whisk controllers, whose arbiter is the sampler, or SLAMs.

    slots: slot -> name, of everything that is active or in shadow; `owner` is the active one.
    """

    word: str
    arbiter: str
    places: Mapping[str, Process]
    available: Callable[[Experiment], dict[str, str]]
    slots: dict[str, str]
    owner: str
    installed: dict[str, str] = field(default_factory=dict)
    used: list[str] = field(default_factory=list)

    def free_slot(self) -> str:
        """A place nothing was loaded into in this run. Raises RunError."""
        for slot in self.places:
            if slot not in self.used:
                self.used.append(slot)
                return slot
        raise RunError(
            f"no free slot: {len(self.places)} {self.word}s were loaded in this run already"
        )


def of_controllers(experiment: Experiment) -> Kind:
    """Whisk controllers: the arbiter in the sampler owns the drives."""
    installed = controllers.available(experiment)
    slots = {"whisk": experiment.whisk.controller}
    return Kind("controller", "sampler", SLOTS, controllers.available, slots, "whisk", installed)


def of_slams(experiment: Experiment) -> Kind:
    """SLAMs: the front end names the one that is the run's."""
    installed = slams.available(experiment)
    slots = {"slam": experiment.slam.algorithm}
    return Kind("slam", "slam", SLAM_SLOTS, slams.available, slots, "slam", installed)
