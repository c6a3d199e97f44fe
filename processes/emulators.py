"""The emulated devices of a run: started before its processes, ended after them."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from vibrissa.processes.arm import make_path
from vibrissa.processes.config import Experiment
from vibrissa.processes.realtime import Cores, choose_cores
from vibrissa.processes.results import RunError
from vibrissa.processes.rig import head_settings
from vibrissa.processes.table import PROCESSES
from vibrissa.rig.devices.addresses import make_arm, make_head, parse
from vibrissa.rig.devices.emulation import EmulatorProcess
from vibrissa.rig.devices.errors import DeviceError
from vibrissa.rig.devices.rtde_wire import DASHBOARD_PORT, RTDE_PORT, SCRIPT_PORT

PRIORITY: Final = 60
"""SCHED_FIFO of an emulator, where it is granted: a device does not wait for our processes."""


@dataclass
class Devices:
    """What a run opens: URLs, and the emulators behind them."""

    urls: dict[str, str]
    """ "head", "arm"; "tell": port at which an emulated head takes its pose from our arm."""
    emulators: dict[str, EmulatorProcess] = field(default_factory=dict)


@contextlib.contextmanager
def devices(experiment: Experiment, folder: Path) -> Iterator[Devices]:
    """The devices of an experiment, emulated ones running. Raises RunError or DeviceError."""
    rig = experiment.rig
    found = Devices({"head": rig.head, "arm": rig.arm})
    if not rig.emulate or rig.virtual:
        yield found
        return
    with contextlib.ExitStack() as stack:

        def start(what: str, kind: str, arguments: list[str]) -> EmulatorProcess:
            emulator = stack.enter_context(EmulatorProcess(kind, arguments))
            found.emulators[what] = emulator
            if experiment.run.realtime:
                _favour(emulator.pid, head_cores(experiment) if what == "head" else "any")
            return emulator

        pose = ",".join(map(repr, make_path(experiment).pose(0)))
        hear = 0
        if rig.head != "virtual":
            kind, wire, options = _head_wire(rig.head, folder)
            maze = folder / "maze"
            maze.write_text(experiment.maze.text)
            arguments = ["--maze", str(maze), "--seed", str(experiment.run.seed), "--hear", "0"]
            arguments += [f"--pose={pose}", "--plant", json.dumps(head_settings(experiment))]
            emulator = start("head", kind, wire + arguments)
            found.urls["head"] = emulator.url + options
            hear = emulator.hear
        if rig.arm != "virtual":
            arguments = ["--host", _free_address(), f"--pose={pose}"]
            emulator = start("arm", "rtde", arguments + (["--tell", str(hear)] if hear else []))
            found.urls["arm"] = emulator.url
        elif hear:
            found.urls["tell"] = str(hear)
        yield found


def head_cores(experiment: Experiment) -> Cores:
    """Where an emulated head disturbs least on two cores.

    Who runs first is never moved. Beside a reflex loop in processes of its own that is the loop's
    core: the one works while the other waits. The process of the head's device that hosts the loop
    goes on without a break: beside that, the scheduler finds the emulator room.
    """
    shared = next((group for group in experiment.run.together if "rig" in group), [])
    return "any" if any(PROCESSES[n].cores == "reflex" for n in shared) else "reflex"


def _favour(pid: int, cores: Cores) -> None:
    """Have an emulator run before everybody else; on two cores, on these."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(PRIORITY))
        available = os.sched_getaffinity(0)
        if len(available) == 2:
            os.sched_setaffinity(pid, choose_cores(available, cores))


def _head_wire(url: str, folder: Path) -> tuple[str, list[str], str]:
    """(kind, arguments, options of the URL) of the emulator that plays the head of a URL."""
    address = parse(url, "rig.head", ("serial", "can"))
    _, query, options = url.partition("?")
    if address.scheme == "serial":
        return "serial", ["--link", str(folder / "head")], query + options
    interface, _, channel = address.place.partition(":")
    bus = f"udp_multicast:{channel}"
    if interface != "udp_multicast":  # it may be a bus that other things hang on
        bus = f"loopback:{_free_port()}"
    return "can", ["--bus", bus], query + options


def _free_port() -> int:
    """A port of the loopback broadcast address that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.255.255.255", 0))
        port: int = probe.getsockname()[1]
        return port


def _free_address() -> str:
    """An address of this machine at which no controller answers. Raises RunError."""
    for number in range(os.getpid() % 200, os.getpid() % 200 + 200):
        host = f"127.0.1.{1 + number % 250}"
        with contextlib.ExitStack() as stack:
            try:
                for port in (RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT):
                    probe = stack.enter_context(socket.socket())
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    probe.bind((host, port))
            except OSError:
                continue
            return host
    raise RunError("rig.emulate: no address of 127.0.1.0/24 is free for an emulated arm")


def check(experiment: Experiment) -> None:
    """Refuse what names no device. Raises RunError."""
    rig = experiment.rig
    try:
        if rig.head != "virtual":
            make_head(rig.head)
        if rig.arm != "virtual":
            make_arm(rig.arm)
    except DeviceError as error:
        raise RunError(str(error)) from None
