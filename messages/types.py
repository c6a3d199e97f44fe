"""The message types: what travels, field by field, with units and limits.

Every field is annotated with its limits (`messages/fields.py`); the codec is derived from these
annotations, so this page is the protocol. A change of a type changes its version number.

Arrays of 18 follow whisker index i = ring*6 + k: ring 0 front (50 mm), 1 mid (110 mm), 2 rear
(160 mm); whisker k sits at azimuth 30+60k degrees counterclockwise from the head's forward
direction. theta is protraction from the start angle. Deflections are base bending moments. Poses:
(x, y, z, yaw) in the maze frame: x east, y north, z up from the floor, z of the nose plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final

import numpy as np
import numpy.typing as npt

from vibrissa.messages.fields import TICK_LIMIT, Array, Int, Real, Text, f32, f64

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
U32 = npt.NDArray[np.uint32]
I32 = npt.NDArray[np.int32]

WHISKERS = 18
TICK_NS = 500_000
"""Nanoseconds per tick: the 2 kHz of the paper."""
TICK_HZ = 2000

Tick = Annotated[int, Int(0, TICK_LIMIT, "tick of 0.5 ms")]
TickOrNone = Annotated[int, Int(-1, TICK_LIMIT, "tick of 0.5 ms, -1 for none")]
Angles = Annotated[F32, f32(WHISKERS, limit=6.3, unit="rad")]
Moments = Annotated[F32, f32(WHISKERS, limit=10.0, unit="N m")]
Pose = Annotated[F64, f64(4, limit=1e3, unit="m, m, m, rad")]
Pixels = Annotated[U8, Array("|u1", (WHISKERS,), unit="tip height code, 0 = no contact")]


@dataclass(slots=True, eq=False)
class TimerTick:
    """A tick of the host's timer; never published, rebuilt from receipts in a re-run."""

    version: ClassVar[int] = 1
    tick: Tick


@dataclass(slots=True, eq=False)
class HeadReading:
    """What the head device measured at a tick, and which command it was obeying meanwhile."""

    version: ClassVar[int] = 1
    tick: Tick
    answers: TickOrNone
    """Tick whose command drove the whiskers during the interval that ended here."""
    theta: Angles
    x: Moments
    y: Moments


@dataclass(slots=True, eq=False)
class HeadSample:
    """A reading as the system uses it, with the command that was applied while it was taken."""

    version: ClassVar[int] = 1
    tick: Tick
    answers: TickOrNone
    theta: Angles
    x: Moments
    y: Moments
    command: Angles


@dataclass(slots=True, eq=False)
class WhiskCommand:
    """Desired protraction of every whisker, answering the sample of `tick`."""

    version: ClassVar[int] = 1
    tick: Tick
    command: Angles


@dataclass(slots=True, eq=False)
class HeadCommand:
    """The one command per tick that the arbiter lets through to the drives."""

    version: ClassVar[int] = 1
    tick: Tick
    controller: Annotated[str, Text(40)]
    command: Angles


@dataclass(slots=True, eq=False)
class WhiskCycle:
    """A completed whisk cycle: samples first_tick .. last_tick, both included."""

    version: ClassVar[int] = 1
    cycle: Annotated[int, Int(0, 2**31)]
    first_tick: Tick
    last_tick: Tick
    calibrating: Annotated[int, Int(0, 1, "1 while the head is held free for calibration")]
    protraction: Angles
    """Largest desired protraction of the cycle."""


@dataclass(slots=True, eq=False)
class WhiskCalibration:
    """Free-whisking statistics per whisker (mean, sigma) and the contact thresholds from them."""

    version: ClassVar[int] = 1
    samples: Annotated[int, Int(1, TICK_LIMIT)]
    mean_y: Moments
    sigma_y: Moments
    threshold_y: Moments
    """20 sigma above the mean counts as contact (paper, section III E)."""
    mean_dy: Annotated[F32, f32(WHISKERS, limit=10.0, unit="N m, difference of two low-passes")]
    threshold_dy: Annotated[F32, f32(WHISKERS, limit=10.0, unit="N m")]


@dataclass(slots=True, eq=False)
class ArmReading:
    """Head pose as the arm device reports it."""

    version: ClassVar[int] = 1
    tick: Tick
    pose: Pose


@dataclass(slots=True, eq=False)
class DeviceClock:
    """How a device's clock reads on the host's: a line through its least delayed messages."""

    version: ClassVar[int] = 1
    device: Annotated[str, Text(40)]
    tick: Tick
    device_ns: Annotated[int, Int(0, 2**62, "ns, the device's own clock at the end of the line")]
    host_ns: Annotated[int, Int(-(2**53), 2**53, "ns since tick 0 was due, at that moment")]
    drift: Annotated[float, Real(1.0, "how much faster the host's clock runs, 1e-6 is one ppm")]


@dataclass(slots=True, eq=False)
class ArmState:
    """Head pose as the system uses it (ground truth), with where the path is."""

    version: ClassVar[int] = 1
    tick: Tick
    pose: Pose
    moving: Annotated[int, Int(0, 1)]


@dataclass(slots=True, eq=False)
class ArmSetpoint:
    """Where the arm is told to be at its next 125 Hz cycle."""

    version: ClassVar[int] = 1
    tick: Tick
    pose: Pose


@dataclass(slots=True, eq=False)
class SlamView:
    """The tactile images of a whisk cycle and the local view that one of them matched."""

    version: ClassVar[int] = 1
    cycle: Annotated[int, Int(0, 2**31)]
    max_angle_gated: Pixels
    max_angle_ungated: Pixels
    contact_angle: Pixels
    template: Annotated[int, Int(-1, 2**31, "-1 for none")]
    new: Annotated[int, Int(0, 1)]
    error: Annotated[float, Real(1e6, "mean absolute pixel difference, -1 for none compared")]


@dataclass(slots=True, eq=False)
class SlamPose:
    """Where SLAM believes the head is, beside the odometry it was given and the truth."""

    version: ClassVar[int] = 1
    cycle: Annotated[int, Int(0, 2**31)]
    experience: Annotated[int, Int(-1, 2**31)]
    action: Annotated[int, Int(0, 3, "0 none, 1 create node, 2 create edge, 3 set node")]
    estimate: Annotated[F64, f64(3, limit=1e6, unit="m, m, rad in the map frame")]
    odometry: Annotated[F64, f64(3, limit=1e6, unit="m/s, rad/s, s")]
    truth: Pose


@dataclass(slots=True, eq=False)
class SlamHistory:
    """What was seen so far, in parts, for a SLAM that comes later; one row per whisk cycle."""

    version: ClassVar[int] = 1
    request: Annotated[int, Int(0, 2**31)]
    node: Annotated[str, Text(40)]
    first: Annotated[int, Int(0, 2**31, "cycles seen before this part")]
    total: Annotated[int, Int(0, 2**31, "cycles seen in all parts")]
    cycles: Annotated[I32, Array("<i4", (-1,))]
    images: Annotated[U8, Array("|u1", (-1, WHISKERS), unit="tip height code, 0 = no contact")]
    odometry: Annotated[F64, f64(-1, 3, limit=1e6, unit="m/s, rad/s, s")]
    truth: Annotated[F64, f64(-1, 4, limit=1e3, unit="m, m, m, rad")]


@dataclass(slots=True, eq=False)
class SlamMap:
    """The experience map: poses in the map frame and links between experiences."""

    version: ClassVar[int] = 1
    cycle: Annotated[int, Int(0, 2**31)]
    poses: Annotated[F64, f64(-1, 3, limit=1e6, unit="m, m, rad")]
    links: Annotated[I32, Array("<i4", (-1, 2), unit="from, to")]


@dataclass(slots=True, eq=False)
class Metrics:
    """Scores up to a cycle; -1 where a score is not defined yet."""

    version: ClassVar[int] = 1
    cycle: Annotated[int, Int(0, 2**31)]
    arr: Annotated[float, Real(1.0, "average rate of re-localisation")]
    arcr: Annotated[float, Real(1.0, "average rate of correct re-localisation")]
    em_translation: Annotated[float, Real(1e9, "m^2, consecutive relations")]
    em_rotation: Annotated[float, Real(1e9, "rad^2, consecutive relations")]
    odometry_translation: Annotated[float, Real(1e9, "m^2, of the raw odometry")]
    odometry_rotation: Annotated[float, Real(1e9, "rad^2, of the raw odometry")]
    experiences: Annotated[int, Int(0, 2**31)]
    templates: Annotated[int, Int(0, 2**31)]


@dataclass(slots=True, eq=False)
class Event:
    """Something a person, a watchdog or a node decided, with the tick at which it took effect."""

    version: ClassVar[int] = 1
    tick: TickOrNone
    kind: Annotated[str, Text(40)]
    node: Annotated[str, Text(40)]
    cause: Annotated[str, Text(400)]


HOST_ORDERS: Final = ("open", "prepare", "close")
"""Orders about the process of a slot, which concern the supervisor and the host but no node."""


@dataclass(slots=True, eq=False)
class Order:
    """What a person or a schedule asks of a running node; the node named obeys or refuses."""

    version: ClassVar[int] = 1
    request: Annotated[int, Int(0, 2**31, "number of the request; answers repeat it")]
    kind: Annotated[str, Text(40)]
    """open, prepare, assign, register, swap, rollback, forget, set, close"""
    node: Annotated[str, Text(40)]
    """Who is to obey: "sampler" for the arbiter's orders, else the node concerned."""
    name: Annotated[str, Text(200)]
    """The controller, SLAM, circuits, slot or parameter that is meant."""
    value: Annotated[str, Text(2000)]
    """A parameter's value, or parameters of a controller, as JSON."""
    at: TickOrNone
    """Tick at which it is to take effect, -1 for as soon as possible."""
    blend_ticks: Annotated[int, Int(0, 100_000)]


@dataclass(slots=True, eq=False)
class Answer:
    """What became of an order."""

    version: ClassVar[int] = 1
    request: Annotated[int, Int(0, 2**31)]
    tick: TickOrNone
    accepted: Annotated[int, Int(0, 1)]
    node: Annotated[str, Text(40)]
    text: Annotated[str, Text(400)]


@dataclass(slots=True, eq=False)
class Ownership:
    """From `tick` on the drives obey `controller`, the source of commands of that epoch.

    On slam.owner: from `tick` on the run's pose and map are those of the SLAM `controller`.
    """

    version: ClassVar[int] = 1
    tick: Tick
    controller: Annotated[str, Text(40)]
    epoch: Annotated[int, Int(0, 2**31)]


@dataclass(slots=True, eq=False)
class ShadowStatus:
    """How a controller in shadow compares with the owner of the drives, over the last second."""

    version: ClassVar[int] = 1
    tick: Tick
    controller: Annotated[str, Text(40)]
    epoch: Annotated[int, Int(0, 2**31)]
    fresh: Annotated[int, Int(0, TICK_LIMIT, "ticks in a row answered on time")]
    late: Annotated[int, Int(0, TICK_LIMIT, "answers that came after the next sample")]
    mean_divergence: Annotated[float, Real(1e3, "rad from the routed command")]
    max_divergence: Annotated[float, Real(1e3, "rad from the routed command")]


@dataclass(slots=True, eq=False)
class Receipt:
    """What a node consumed, step by step, and what came of it.

    Step first_step + i consumed message `seq[i]` of stream `stream[i]`; streams are listed in
    `streams` as lines "topic source epoch". digest[i] is a running CRC-32 over every input and
    output frame of the node so far, so it fixes order, content and result of all steps.
    """

    version: ClassVar[int] = 1
    first_step: Annotated[int, Int(0, 2**40)]
    streams: Annotated[str, Text(4000)]
    stream: Annotated[U8, Array("|u1", (-1,))]
    seq: Annotated[U32, Array("<u4", (-1,))]
    digest: Annotated[U32, Array("<u4", (-1,))]


@dataclass(slots=True, eq=False)
class Telemetry:
    """Wall-clock facts of a host over the last second; recorded, never compared."""

    version: ClassVar[int] = 1
    steps: Annotated[int, Int(0, 2**40)]
    lateness_us: Annotated[F32, f32(2, limit=1e12, unit="us: mean, max")]
    work_us: Annotated[F32, f32(2, limit=1e12, unit="us: mean, max")]
    latency_us: Annotated[F32, f32(2, limit=1e12, unit="us: mean, max")]
    cpu_s: Annotated[float, Real(1e9, "s of processor time since the start")]


Body = Any
"""One of the types above."""
