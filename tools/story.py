"""What a log tells, gathered in one pass for a picture of the run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from vibrissa.messages.codec import Message, decode
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.types import WHISKERS, SlamMap, SlamPose, Telemetry, WhiskCalibration
from vibrissa.processes.config import Experiment
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.rebuild import experiment_of

BIN_TICKS: Final = 40
"""Contacts are kept in bins of 20 ms."""

WANTED: Final = frozenset(
    ("arm.state", "slam.pose", "slam.map", "whisk.calibration", "node.telemetry", "head.sample")
)


@dataclass
class Story:
    """What a log tells, in the amounts a picture needs: samples are kept as contacts only.

    truth: rows (t, x, y, z, yaw) in s, m and rad, maze frame; odometry: rows (v, w, dt) after the
    first SLAM step `first`; contacts: bin of BIN_TICKS -> bool[18], whiskers that touched in it.
    """

    experiment: Experiment
    truth: list[tuple[float, ...]] = field(default_factory=list)
    odometry: list[tuple[float, ...]] = field(default_factory=list)
    first: SlamPose | None = None
    map: SlamMap | None = None
    calibration: WhiskCalibration | None = None
    calibrated_s: float = 0.0
    contacts: dict[int, npt.NDArray[np.bool_]] = field(default_factory=dict)
    obeyed: int = 0
    """Samples at which the drives were obeying the answer to the sample before."""
    samples: int = 0
    telemetry: dict[str, list[Telemetry]] = field(default_factory=dict)

    def take(self, message: Message) -> None:
        """Add one message."""
        body = message.body
        match message.topic:
            case "arm.state":
                self.truth.append((message.t * 1e-9, *body.pose))
            case "slam.pose" if message.source == "slam":
                if self.first is None:
                    self.first = body
                else:
                    self.odometry.append(tuple(body.odometry))
            case "slam.map" if message.source == "slam":
                self.map = body
            case "whisk.calibration":
                self.calibration, self.calibrated_s = body, message.t * 1e-9
            case "node.telemetry":
                self.telemetry.setdefault(message.source, []).append(body)
            case "head.sample":
                self.samples += 1
                self.obeyed += body.answers == body.tick - 1
                if self.calibration is not None:
                    away = np.abs(body.y - self.calibration.mean_y)
                    touching = away > self.calibration.threshold_y
                    if touching.any():
                        row = self.contacts.setdefault(
                            body.tick // BIN_TICKS, np.zeros(WHISKERS, np.bool_)
                        )
                        row |= touching


def tell(reader: LogReader) -> Story:
    """The story of a log. Raises UnusableLogError when its experiment can't be read."""
    story = Story(experiment_of(reader))
    for message in messages(reader, WANTED):
        story.take(message)
    return story


def messages(reader: LogReader, topics: frozenset[str]) -> Iterator[Message]:
    """The decoded messages of some topics, in file order; damaged parts of a log are left out."""
    for record in reader.records(lambda damage: None):
        if record.topic in topics:
            yield decode(frame_of(record))
