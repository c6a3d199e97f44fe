"""Whisker recordings between logs and CSV files."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from vibrissa.messages.codec import CODECS, decode
from vibrissa.messages.log_format import LogError
from vibrissa.messages.types import TICK_HZ, TICK_NS, ArmReading, ArmState, HeadReading, HeadSample
from vibrissa.processes import provenance
from vibrissa.processes.config import load_experiment
from vibrissa.processes.framelog import FrameLog, frame_of
from vibrissa.processes.rebuild import open_log
from vibrissa.processes.results import RunError, UnusableLogError
from vibrissa.processes.simulate import make_directory
from vibrissa.rig.devices.csv import CsvError, Recording, read_csv, write_csv
from vibrissa.slam.angles import wrap_pi

YAW: Final = 3
"""Column of a pose x, y, z, yaw."""


def of_log(log: Path, csv: Path) -> int:
    """Write the samples of a log, poses between the arm's states interpolated; how many there are.

    Raises UnusableLogError, OSError.
    """
    samples: list[HeadSample | HeadReading] = []
    readings: list[HeadReading] = []
    states: list[ArmState | ArmReading] = []
    try:
        for record in open_log(log, allow_cut=True):
            if record.topic == "head.sample":
                samples.append(decode(frame_of(record)).body)
            elif record.topic == "rig.sample":
                readings.append(decode(frame_of(record)).body)
            elif record.topic == "rig.arm":
                states.append(decode(frame_of(record)).body)
    except LogError as error:
        raise UnusableLogError(str(error)) from None
    found = samples or readings
    if not found:
        raise UnusableLogError(f"{log}: there are no samples in it")
    found.sort(key=lambda sample: sample.tick)
    ticks = np.array([sample.tick for sample in found], np.float64)
    pose = None
    if states:
        states.sort(key=lambda state: state.tick)
        at = np.array([state.tick for state in states], np.float64)
        poses = np.stack([state.pose for state in states])
        poses[:, YAW] = np.unwrap(poses[:, YAW])  # the short way round from state to state
        pose = np.stack([np.interp(ticks, at, poses[:, k]) for k in range(4)], axis=1)
        pose[:, YAW] = [wrap_pi(yaw) for yaw in pose[:, YAW].tolist()]
    theta, x, y = (np.stack([getattr(s, name) for s in found]) for name in ("theta", "x", "y"))
    write_csv(csv, Recording(ticks / TICK_HZ, theta, x, y, pose))
    return len(found)


def to_log(csv: Path, out: Path) -> int:
    """Make out/run.mcap of a recording; how many samples it has.

    Times count from the first sample and are rounded to ticks. Raises CsvError, RunError.
    """
    try:
        recording = read_csv(csv)
    except OSError as error:
        raise RunError(f"{csv}: {error.strerror}") from None
    ticks = np.rint((recording.t - recording.t[0]) * TICK_HZ).astype(np.int64)
    same = np.flatnonzero(np.diff(ticks) < 1)
    if len(same):
        raise CsvError(
            f"{csv}: line {same[0] + 3}: t: expected at most one sample per "
            f"{1000 / TICK_HZ:g} ms, found {recording.t[same[0] + 1]!r} after "
            f"{recording.t[same[0]]!r}"
        )
    make_directory(out)
    text = load_experiment().model_dump_json()
    meta = provenance.metadata(text, "import") | {"nodes": "", "of": csv.name}
    run_id = f"import-{provenance.config_hash(csv.name)[:16]}"
    log = FrameLog(out / "run.mcap", run_id, meta)
    arm = 0
    for k, tick in enumerate(ticks.tolist()):
        theta, x, y = recording.theta[k], recording.x[k], recording.y[k]
        reading = HeadReading(tick, -1, theta, x, y)
        log.write(CODECS["rig.sample"].encode("head-device", 0, k, tick * TICK_NS, reading))
        if recording.pose is not None and tick >= 16 * arm:
            state = ArmReading(tick, recording.pose[k])
            log.write(CODECS["rig.arm"].encode("arm-device", 0, arm, tick * TICK_NS, state))
            arm += 1
    log.close("completed")
    return len(ticks)
