"""What a run or a benchmark ran on: hardware, kernel, versions, privileges, load."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from vibrissa.processes.config import Experiment

LIBRARIES: Final = (
    "numpy",
    "numba",
    "llvmlite",
    "scipy",
    "pyzmq",
    "msgpack",
    "mcap",
    "lz4",
    "pydantic",
    "matplotlib",
    "pyserial",
    "python-can",
    "ur-rtde",
)


ROOMY: Final = 4
"""Cores from which on nodes of a live run, newcomers and emulators have room in processes of their
own."""


def with_room(experiment: Experiment, together: list[list[str]]) -> Experiment:
    """The experiment, these nodes sharing processes on a machine of fewer than ROOMY cores."""
    if len(os.sched_getaffinity(0)) >= ROOMY:
        return experiment
    run = experiment.run.model_copy(update={"together": together})
    return experiment.model_copy(update={"run": run})


def machine() -> dict[str, Any]:
    """CPU, cores, kernel, Python and library versions, privileges granted, load at this moment."""
    import zmq

    from vibrissa import __version__
    from vibrissa.processes.realtime import privileges

    return {
        "cpu": cpu(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "kernel": f"{platform.system()} {platform.release()}",
        "preemption": preemption(),
        "governor": governor(),
        "load": round(os.getloadavg()[0], 2),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "versions": {"vibrissa": __version__, "libzmq": zmq.zmq_version(), **libraries()},
        "privileges": {name: granted for name, (granted, _) in privileges().items()},
    }


def cpu() -> str:
    """The processor's name."""
    for line in _read("/proc/cpuinfo").splitlines():
        key, _, value = line.partition(":")
        if key.strip() == "model name":
            return value.strip()
    return platform.processor() or platform.machine()


def preemption() -> str:
    """The kernel's preemption model, as far as its build text or sysfs tells."""
    if _read("/sys/kernel/realtime").strip() == "1":
        return "realtime"
    text = platform.version().split()
    return next((word for word in text if word.startswith("PREEMPT")), "unknown")


def governor() -> str:
    """The frequency governor of the first core."""
    path = "/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"
    return _read(path).strip() or "none visible"


def libraries() -> dict[str, str]:
    """Installed versions of what the project depends on; "missing" where one is not there."""
    found = {}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found


def advice() -> list[str]:
    """What could be better here, a line each; empty when nothing is known to hinder a run."""
    from vibrissa.processes.realtime import privileges

    lines = [
        f"{name} is not granted: {what_to_do}"
        for name, (granted, what_to_do) in privileges().items()
        if not granted
    ]
    cores = len(os.sched_getaffinity(0))
    if cores < 2:
        lines.append(f"{cores} core: a live run wants two")
    elif cores < ROOMY:
        lines.append(
            f'{cores} cores: [run] together = [["rig", "sampler", "whisk"], ["arm", "slam"]] '
            "leaves more of them to others (docs/architecture.md)"
        )
    if os.getloadavg()[0] > 0.5 * cores:
        lines.append(f"load {os.getloadavg()[0]:.1f}: other work will make ticks late")
    if governor() not in ("performance", "none visible"):
        lines.append(f"frequency governor {governor()}: 'performance' keeps wake-ups short")
    if sys.version_info >= (3, 13):
        lines.append("Python 3.13 or later: there is no ur-rtde for it, so no UR arm driver")
    lines += [f"{name} is not installed" for name, v in libraries().items() if v == "missing"]
    return lines


def _read(path: str) -> str:
    try:
        return Path(path).read_text(errors="replace")
    except OSError:
        return ""
