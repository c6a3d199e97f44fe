"""Runs with devices on a wire: what a run does, says and logs when all is well and when not.

The devices are emulated; the head's process hosts the reflex loop, or does not. What is asserted
follows from the log, however slow this machine is: the time-outs are long. That they come after the
stated ticks is tested in `test_device_process`.
"""

from __future__ import annotations

import collections
import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import Recorded
from tests.processes.live import Schedule, wait_for
from tests.processes.logs import message
from vibrissa.messages.log_format import LogError
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.types import Event
from vibrissa.processes.arm import make_path
from vibrissa.processes.client import Client
from vibrissa.processes.config import Experiment, load_experiment
from vibrissa.processes.replay import what_if
from vibrissa.processes.results import Progress, RunError, UnusableLogError
from vibrissa.processes.simulate import simulate
from vibrissa.processes.supervisor import Supervisor
from vibrissa.processes.verify import verify
from vibrissa.rig.devices.emulation import EmulatorProcess
from vibrissa.tools.recording import of_log, to_log

pytestmark = pytest.mark.live

FILE = """\
[run]
duration = {duration}
together = {together}
[whisk]
period = 1.0
calibration_cycles = 1
[arm]
speed = 0.1
lift = 0.05
[rig]
head = "{head}"
arm = "{arm}"
emulate = {emulate}
{ticks}
"""
APART = [["sampler", "whisk"]]
JOINED = [["rig", "sampler", "whisk"]]
PATIENT = dict.fromkeys(("sample", "command", "news", "state", "setpoint"), 4000)
"""Ticks of the time-outs: the most there may be, so that no busy machine ends a run by itself."""


def experiment(
    folder: Path,
    duration: float,
    head: str = "serial:/dev/ttyACM0",
    arm: str = "rtde:192.168.0.10",
    emulate: str = "true",
    together: list[list[str]] = APART,
    **ticks: int,
) -> Experiment:
    path = folder / "devices.toml"
    limits = "\n".join(f"{name}_ticks = {n}" for name, n in (PATIENT | ticks).items())
    fields = {"duration": duration, "head": head, "arm": arm, "emulate": emulate}
    path.write_text(FILE.format(**fields, together=together, ticks=limits))
    return load_experiment(path)


def run(
    folder: Path, asked: Experiment, *orders: tuple[float, str, str]
) -> tuple[Recorded, list[tuple[str, Event]]]:
    """Run it, giving emulators ("head", "arm") orders at times, s; its rig.events, by process."""

    def order(device: str, text: str) -> Callable[[], None]:
        return lambda: supervisor.devices.emulators[device].ask(text) and None

    schedule = Schedule(*((at, order(device, text)) for at, device, text in orders))
    supervisor = Supervisor(asked, folder / "run", schedule)
    recorded = Recorded.of(folder / "run", supervisor.run())
    found = [(r.source, message(r).body) for r in recorded.records if r.topic == "rig.event"]
    verdict = verify(recorded.log)
    assert verdict.identical, verdict.first_difference
    assert any("recorded inputs" in note for note in verdict.notes)
    assert {r.source for r in recorded.records if r.topic == "rig.sample"} == {"head-device"}
    every_lost_sample_is_told(recorded)
    return recorded, found


def every_lost_sample_is_told(recorded: Recorded) -> None:
    """Samples follow each other, except where the log says that some were lost."""
    told = 0
    expected = 0
    for record in recorded.records:
        if record.topic == "rig.event" and record.source == "head-device":
            event = message(record).body
            if event.kind == "gap":
                told = int(event.cause.partition(": ")[2].split()[0])
        elif record.topic == "rig.sample":
            tick = message(record).body.tick
            assert tick - expected == told, f"{told} told lost before tick {tick}"
            assert record.t == tick * 500_000
            expected, told = tick + 1, 0


def setpoints_hold_after(recorded: Recorded, tick: int) -> bool:
    """Whether the arm was told to stay where it was, from some 20 ms after a tick on."""
    told = [message(r).body for r in recorded.records if r.topic == "arm.setpoint"]
    late = [s.pose for s in told if s.tick > tick + 40]
    return all((pose == late[0]).all() for pose in late)


def test_a_run_over_can_fd_and_rtde_does_what_a_virtual_one_does_and_survives_small_faults(
    tmp_path: Path,
) -> None:
    asked = experiment(tmp_path, 3.0, head="can:socketcan:can0", together=JOINED)
    faults = [(0.3, "drop 0.02"), (0.6, "reset"), (0.9, "errors 2e-5"), (1.4, "normal")]
    recorded, found = run(tmp_path, asked, *((at, "head", order) for at, order in faults))
    kinds = collections.Counter((who, event.kind) for who, event in found)
    assert recorded.summary["cause"] == "completed"
    assert recorded.summary["ok"]
    assert kinds["head-device", "opened"] == kinds["arm-device", "enabled"] == 1
    assert kinds["head-device", "gap"] >= 3 and kinds["head-device", "reset"] == 1
    assert not kinds["head-device", "retract"] and not kinds["arm-device", "retract"]
    assert "VIB-EMU-1, firmware 1.0.0" in found[0][1].cause + found[1][1].cause
    counters = recorded.summary["counters"]
    assert counters["head-device"]["resets"] == 1
    assert "head-device+sampler+whisk" in recorded.summary["steps"]
    answered_in_memory(recorded)
    assert counters["arm-device"]["setpoints"] > 0 == counters["arm-device"]["refused"]
    clocks = [message(r).body for r in recorded.records if r.topic == "rig.clock"]
    assert {c.device for c in clocks} == {"head", "arm"}
    for device in ("head", "arm"):
        of_one = [c for c in clocks if c.device == device]
        assert all(b.device_ns >= a.device_ns and b.tick >= a.tick for a, b in pairwise(of_one))
        # device and host agree on how long it took, but for what delayed the estimate's messages
        took = (of_one[-1].device_ns - of_one[0].device_ns) * 1e-9
        assert abs((of_one[-1].host_ns - of_one[0].host_ns) * 1e-9 - took) < 0.5
    arm = [message(r).body.tick for r in recorded.records if r.topic == "rig.arm"]
    assert all(b > a for a, b in pairwise(arm)) and arm[-1] <= asked.ticks
    back_and_forth_as_csv(recorded, tmp_path)
    with pytest.raises(UnusableLogError, match="rig was no node in this run"):
        what_if(recorded.log, {"rig": "vibrissa.processes.rig:RigNode"}, tmp_path / "if")
    with pytest.raises(RunError, match="only a virtual rig can be simulated"):
        simulate(asked, tmp_path / "sim")


def answered_in_memory(recorded: Recorded) -> None:
    """In one process every sample is answered before the next one is said."""
    loop = ("rig.sample", "head.command")
    said = [r.topic for r in recorded.records if r.topic in loop]
    assert said == list(loop) * (len(said) // 2)


def back_and_forth_as_csv(recorded: Recorded, folder: Path) -> None:
    """A log's samples, exported, imported and exported again, are the same."""
    samples = sum(r.topic == "head.sample" for r in recorded.records)
    first, second = folder / "first.csv", folder / "second.csv"
    assert of_log(recorded.log, first) == samples
    assert to_log(first, folder / "imported") == samples
    assert of_log(folder / "imported" / "run.mcap", second) == samples
    one, two = (np.loadtxt(f, delimiter=",", skiprows=1) for f in (first, second))
    np.testing.assert_array_equal(one[:, 1:55], two[:, 1:55])
    np.testing.assert_allclose(one[:, 0] - one[0, 0], two[:, 0], atol=1e-9)
    # poses between the cycles; yaws of pi and -pi are the same
    np.testing.assert_allclose(one[:, 55:58], two[:, 55:58], atol=1e-3)
    assert np.abs(np.angle(np.exp(1j * (one[:, 58] - two[:, 58])))).max() < 1e-3


LIMIT = 1000
FAULTS = {
    "a head of which every frame is damaged": (
        ("head", "errors 0.01"),
        {"sample": LIMIT},
        ("head-device", f"no sample for {LIMIT} ticks"),
    ),
    "a protective stop": (("arm", "protective_stop"), {}, ("arm-device", "protective stop")),
    "a controller that stalls": (
        ("arm", "stall 3"),
        {"state": LIMIT},
        ("arm-device", f"no state for {LIMIT} ticks"),
    ),
    "a controller that reboots": (
        ("arm", "reboot 1"),
        {"state": LIMIT},
        ("arm-device", f"no state for {LIMIT} ticks|takes no set-points"),  # whichever is first
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_device_retracts_the_whiskers_stops_the_arm_and_ends_the_run(
    fault: str, tmp_path: Path
) -> None:
    order, ticks, (who, why) = FAULTS[fault]
    asked = experiment(tmp_path, 20.0, **ticks)
    if order[0] == "arm":
        asked = experiment(tmp_path, 20.0, "can:socketcan:can0", together=JOINED, **ticks)
    recorded, found = run(tmp_path, asked, (0.5, *order))
    retracts = [(source, event) for source, event in found if event.kind == "retract"]
    assert retracts, "the process of the device decided"
    source, event = retracts[0]
    assert recorded.summary["cause"] == f"{source}: {event.cause}"
    assert source == who and re.search(why, event.cause)
    assert not recorded.summary["ok"]
    assert recorded.summary["steps"]["arm"] > 0
    assert recorded.records[-1].t < 15_000_000_000, "it ended early"
    owners = [message(r).body.controller for r in recorded.records if r.topic == "head.owner"]
    assert owners[-1] == "retract"
    told = [r for r in recorded.records if r.topic == "run.event"]
    assert [message(r).body.kind for r in told] == ["start", "retract", "stop"]
    at = max(event.tick, 0)
    assert setpoints_hold_after(recorded, at + 2000)


@contextlib.contextmanager
def rig_of_emulators(folder: Path) -> Iterator[tuple[Experiment, EmulatorProcess]]:
    """A run whose head and arm look real to it, and the arm."""
    begin = make_path(experiment(folder, 60.0)).pose(0)
    pose = "--pose=" + ",".join(map(repr, begin))
    host = ["--host", "127.0.2.9"]
    with EmulatorProcess("serial", [pose]) as head, EmulatorProcess("rtde", [*host, pose]) as arm:
        yield experiment(folder, 60.0, head.url, arm.url, "false", JOINED), arm


def test_nothing_moves_before_the_operators_start_and_everything_stops_without_a_supervisor(
    tmp_path: Path,
) -> None:
    with rig_of_emulators(tmp_path) as (asked, arm):
        assert asked.rig.real
        out = tmp_path / "run"
        file = tmp_path / "devices.toml"
        code = "from vibrissa.tools.cli import main; main()"
        command = [sys.executable, "-c", code, "run", str(file), "--out", str(out)]
        popen = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            wait_for(lambda: _asked_to_wait(out), "a run that waits")
            assert arm.ask("travelled") == "0.0"
            with Client(out) as client:
                with pytest.raises(RunError, match="waits for its start"):
                    client.controllers()
                assert client.start() == "started"
                with pytest.raises(RunError, match="started already"):
                    client.start()
            wait_for(lambda: _says_enabled(out / "run.mcap"), "an arm that is enabled")
            os.kill(popen.pid, signal.SIGKILL)
            popen.wait()
            wait_for(lambda: _log_is_closed(out / "run.mcap"), "a log that is closed")
            still = arm.ask("travelled")
            wait_for(lambda: _same_twice(lambda: arm.ask("travelled")), "an arm at rest")
            assert float(still) < 10.0
        finally:
            popen.kill()
            popen.wait()
    recorded = Recorded.of(out, {})
    events = [message(r).body for r in recorded.records if r.topic == "rig.event"]
    kinds = [event.kind for event in events]
    assert "enabled" in kinds and "retract" in kinds[kinds.index("enabled") :]
    assert verify(recorded.log).identical


def _asked_to_wait(out: Path) -> bool:
    try:
        with Client(out) as client:
            client.controllers()
    except RunError as error:
        return "waits for its start" in str(error)
    return False


def _says_enabled(log: Path) -> bool:
    try:
        events = [message(r) for r in LogReader(log, allow_cut=True) if r.topic == "rig.event"]
    except (OSError, LogError):
        return False
    return any(event.body.kind == "enabled" for event in events)


def _log_is_closed(log: Path) -> bool:
    try:
        return sum(1 for _ in LogReader(log)) > 0
    except (OSError, LogError):
        return False


def _same_twice(ask: Callable[[], str]) -> bool:
    first = ask()
    return first == ask()


def test_a_busy_or_absent_device_is_one_line_before_anything_starts(tmp_path: Path) -> None:
    asked = experiment(tmp_path, 5.0, "serial:/dev/vibrissa-nowhere", "virtual", "false")
    with pytest.raises(RunError, match=r"serial:/dev/vibrissa-nowhere: can't be opened"):
        Supervisor(asked, tmp_path / "run", _ignore, start=True).run()
    assert not (tmp_path / "run").exists()


def _ignore(_progress: Progress) -> None:
    pass


@pytest.mark.parametrize(
    ("rig", "complaint"),
    [
        ({"head": "usb:0"}, "rig.head: expected one of virtual, serial, can"),
        ({"arm": "rtde:"}, "rig.arm: expected rtde:PLACE"),
        ({"head": "can:can0"}, "expected can:INTERFACE:CHANNEL"),
        ({"head": "can:socketcan:can0?data_bitrate=2000000"}, "bus load"),
        ({"head": "serial:/dev/x?baud=fast"}, "baud: expected 1200 to 20000000, found 'fast'"),
    ],
)
def test_a_rig_that_is_none_is_refused_when_the_file_is_read(
    rig: dict[str, Any], complaint: str, tmp_path: Path
) -> None:
    with pytest.raises(RunError) as refusal:
        experiment(tmp_path, 5.0, **rig)
    assert complaint in str(refusal.value) and "\n" not in str(refusal.value)
