"""What the devices of an experiment say when they are asked, without moving anything."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from vibrissa.processes.arm import make_path
from vibrissa.processes.arm_device import travelled
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.emulators import devices
from vibrissa.rig.devices.addresses import make_arm, make_head
from vibrissa.rig.devices.errors import DeviceLimit
from vibrissa.rig.devices.limits import Pose

LISTEN_S = 1.0


def probe(file: Path) -> dict[str, dict[str, Any]]:
    """Open head and arm, listen for a second, close. No command is sent.

    Raises RunError for the file and DeviceError for a device that can't be used.
    """
    experiment = load_experiment(file)
    with (
        tempfile.TemporaryDirectory(prefix="vibrissa-") as folder,
        devices(experiment, Path(folder)) as found,
    ):
        return {
            "head": probe_head(found.urls["head"]),
            "arm": probe_arm(found.urls["arm"], experiment),
        }


def probe_head(url: str) -> dict[str, Any]:
    """Who the head is, and what a second of its samples is like."""
    with make_head(url) as head:
        until = time.monotonic() + LISTEN_S
        largest = 0.0
        while time.monotonic() < until:
            reading = head.read(0.05)
            if reading is not None:
                largest = max(largest, float(abs(reading.y).max()))
        counters = head.counters
        return {
            "url": url,
            "is": head.info.describe(),
            "samples": f"{counters.samples} in {LISTEN_S:g} s, {counters.lost} lost, "
            f"{counters.crc_errors} frames damaged",
            "largest moment": f"{largest * 1e6:.0f} uN m",
        }


def probe_arm(url: str, experiment: Experiment) -> dict[str, Any]:
    """Who controls the arm, where it is, where the path begins, and whether it can be travelled."""
    path = make_path(experiment)
    begin = path.pose(0)
    with make_arm(url, start=begin) as arm:
        until = time.monotonic() + LISTEN_S
        while time.monotonic() < until:
            arm.read(0.05)
        try:
            arm.check(travelled(path, experiment.ticks, arm.info.period))
            fits = "within all limits"
        except DeviceLimit as error:
            fits = str(error)
        return {
            "url": url,
            "is": f"{arm.info.name}, controller {arm.info.version}",
            "states": f"{arm.counters.states} in {LISTEN_S:g} s, {arm.counters.gaps} gaps",
            "safety": arm.report.safety.value,
            "pose": _text(arm.report.pose),
            "path begins at": _text(begin),
            "path": fits,
        }


def _text(pose: Pose) -> str:
    x, y, z, yaw = pose
    return f"x {x:.4f} m, y {y:.4f} m, z {z:.4f} m, yaw {yaw:.4f} rad"
