"""The arm as its users see it: set-points down, states up, and a stop that always wins.

A back end talks to the arm; the limits, the explicit start and the order of states are here, once:

    closed -> RESTING -> (enable) MOVING -> (stop, limit, stale set-points) STOPPED
    any    -> PROTECTIVE_STOP, EMERGENCY_STOP, STALE, LOST: what the controller or its silence says

Nothing moves before `enable`. What is stopped stays stopped until `enable` is called again, which a
program does only when a person asks.
"""

from __future__ import annotations

import enum
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

from vibrissa.rig.devices import ur10
from vibrissa.rig.devices.clock import ClockRelation
from vibrissa.rig.devices.errors import (
    DeviceError,
    DeviceLimit,
    DeviceLost,
    DeviceRefused,
    DeviceStopped,
)
from vibrissa.rig.devices.limits import ARM, ArmLimits, Follower, Pose

TICK_NS: Final = 500_000
ANSWER_S: Final = 10.0
"""How long the first state may take, the start of a process that listens included."""
RETRY_NS: Final = 500_000_000
SILENT_NS: Final = 1_000_000_000
"""Silence after which a connection is given up and made again."""


class Safety(enum.Enum):
    """What keeps the arm from moving, the most serious first."""

    EMERGENCY_STOP = "emergency stop"
    PROTECTIVE_STOP = "protective stop"
    FAULT = "fault or violation"
    NOT_RUNNING = "power or brakes off"
    NORMAL = "normal"


class State(enum.Enum):
    """Where an open arm is."""

    RESTING = "resting, not enabled"
    MOVING = "enabled"
    STOPPED = "stopped"
    STALE = "no news"
    LOST = "lost"


class ArmReport(NamedTuple):
    """What the arm says of itself.

    stamp      s, the controller's own clock
    host_ns    monotonic clock of the host when it arrived
    pose       of the head: m and rad, maze frame; yaw goes on over full turns
    speed      m/s of the nose
    safety     what keeps it from moving
    """

    stamp: float
    host_ns: int
    pose: Pose
    speed: float
    safety: Safety


class Controller(NamedTuple):
    """Who controls the arm: as it introduces itself."""

    name: str
    version: str
    period: float


@dataclass(slots=True)
class ArmCounters:
    """What has happened on the line.

    states, setpoints   received and sent
    gaps                times two states were more than 1.5 periods apart by their stamps
    refused             set-points that the limits forbade
    ignored             set-points that came while the arm was not enabled
    stalls              times there was no news for longer than the limits allow
    reconnects          times the connection was made again
    """

    states: int = 0
    setpoints: int = 0
    gaps: int = 0
    refused: int = 0
    ignored: int = 0
    stalls: int = 0
    reconnects: int = 0


class ArmDevice(ABC):
    """An arm that carries the head. Use it as a context manager, from one thread.

    `info` says who controls it; `report` is the newest state; `clock` relates its clock to the
    host's; `cause` says why it is stopped.
    """

    info: Controller
    report: ArmReport

    def __init__(
        self, name: str, *, limits: ArmLimits = ARM, mount: ur10.Mount | None = None
    ) -> None:
        """mount: where the arm stands; None for one that has no joints to look after."""
        self.name = name
        self.limits = limits
        self.counters = ArmCounters()
        self.clock = ClockRelation()
        self.state = State.RESTING
        self.cause = ""
        self._mount = mount
        self._open = False
        self._connected = False
        self._follower: Follower | None = None
        self._heard_ns = 0
        self._tried_ns = 0
        self._setpoint_ns = 0
        self._last_tick = 0

    def open(self) -> Self:
        """Connect and wait for the first state. Nothing moves.

        Raises DeviceUnavailable or DeviceRefused, and then everything is closed again.
        """
        try:
            self.info = self._connect()
            self._connected = True
            report = self._take(ANSWER_S)
            if report is None:
                raise DeviceRefused(f"{self.name}: connected, but sends no state")
            self._note(report)
        except BaseException:
            self._disconnect()
            self._connected = False
            raise
        self._open = True
        return self

    def close(self) -> None:
        """Stop the arm if it moves, and let go. May be repeated."""
        if self._open:
            self.stop("closed")
            self._open = self._connected = False
            self._disconnect()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, timeout: float) -> ArmReport | None:
        """The next state, or None after `timeout` s; 0 takes only what is there.

        Looks after stale set-points, stale states and lost connections on the way: each stops the
        arm. A lost connection is made again, for as long as the limits' patience; then raises
        DeviceLost.
        """
        deadline = time.monotonic() + timeout
        while True:
            left = deadline - time.monotonic()
            report = self._take(max(left, 0.0)) if self._connected else None
            if report is not None:
                self._note(report)
            self._look_after(time.monotonic_ns())
            if report is not None or left <= 0.0:
                return report
            if not self._connected:
                time.sleep(min(left, 0.02))

    def check(self, path: Sequence[Pose]) -> None:
        """A whole path before the first motion, one pose per period. Raises DeviceLimit."""
        self._make_follower().check_path(path)

    def enable(self) -> None:
        """Let set-points through: the operator's explicit start.

        Raises DeviceStopped when the arm is in no state to move.
        """
        if self.state in (State.STALE, State.LOST) or not self._connected:
            raise DeviceStopped(f"{self.name}: can't be enabled: {self.state.value}")
        if self.report.safety is not Safety.NORMAL:
            raise DeviceStopped(f"{self.name}: can't be enabled: {self.report.safety.value}")
        self._start_motion()
        self._follower = self._make_follower()
        self._setpoint_ns = time.monotonic_ns()
        self._last_tick = 0
        self.state, self.cause = State.MOVING, ""

    def write(self, tick: int, setpoint: Pose) -> bool:
        """Where the head shall be at `tick`, a period from now: (x, y, z, yaw), m, rad, maze frame.

        Speeds are judged over the ticks since the set-point before. True when it was sent; False
        (counted as ignored) while the arm is not enabled. Raises DeviceLimit for a set-point
        outside the limits and DeviceStopped when the controller takes none any more; either way the
        arm has then been stopped.
        """
        if self.state is not State.MOVING or self._follower is None:
            self.counters.ignored += 1
            return False
        since = min(tick - self._last_tick, self.limits.stale_setpoint_ticks)
        seconds = since * TICK_NS * 1e-9 if self._last_tick and since > 0 else None
        self._last_tick = tick
        try:
            self._follower.follow(f"{self.name} set-point, tick {tick}", setpoint, seconds)
        except DeviceLimit as error:
            self.counters.refused += 1
            self.stop(str(error))
            raise
        if not self._send(setpoint):
            self.stop("the controller takes no set-points")
            raise DeviceStopped(f"{self.name}: the controller takes no set-points: {self.cause}")
        self._setpoint_ns = time.monotonic_ns()
        self.counters.setpoints += 1
        return True

    def stop(self, cause: str) -> None:
        """Decelerate and stay; wins over everything, never raises."""
        if self.state is State.MOVING:
            self.state, self.cause = State.STOPPED, cause
            self._follower = None
            try:
                self._halt()
            except DeviceError as error:
                self.cause += f" ({error})"

    def silent_ticks(self) -> int:
        """Ticks of host time since the last state arrived."""
        return (time.monotonic_ns() - self._heard_ns) // TICK_NS

    def fileno(self) -> int:
        """What to wait on for states beside other things; -1 where there is nothing."""
        return -1

    # What a back end must do.

    @abstractmethod
    def _connect(self) -> Controller:
        """Connect without moving anything. Raises DeviceUnavailable or DeviceRefused."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Let go of what there is; never raises."""

    @abstractmethod
    def _next(self, timeout: float) -> ArmReport | None:
        """The next state within `timeout` s. Raises OSError when the connection is gone."""

    @abstractmethod
    def _start_motion(self) -> None:
        """Make ready for set-points. Raises DeviceStopped."""

    @abstractmethod
    def _send(self, setpoint: Pose) -> bool:
        """Send a set-point; False when it is not taken."""

    @abstractmethod
    def _halt(self) -> None:
        """Decelerate now."""

    def _joints(self) -> ur10.Joints | None:
        """Joint angles, rad, where there are joints."""
        return None

    def _take(self, timeout: float) -> ArmReport | None:
        try:
            return self._next(timeout)
        except OSError:
            self._disconnect()
            self._connected = False
            return None

    def _make_follower(self) -> Follower:
        return Follower(
            self.limits, self.info.period, self.report.pose, self._mount, self._joints()
        )

    def _note(self, report: ArmReport) -> None:
        last = getattr(self, "report", None)
        if last is not None:
            x, y, z, yaw = report.pose
            yaw += 2 * math.pi * round((last.pose[3] - yaw) / (2 * math.pi))
            report = report._replace(pose=(x, y, z, yaw))
            self.counters.gaps += report.stamp - last.stamp > 1.5 * self.info.period
        self.report = report
        self._heard_ns = report.host_ns
        self.counters.states += 1
        self.clock.see(round(report.stamp * 1e9), report.host_ns)
        if report.safety is not Safety.NORMAL:
            self.stop(report.safety.value)
        if self.state in (State.STALE, State.LOST):
            self.state = State.STOPPED

    def _look_after(self, now: int) -> None:
        limits = self.limits
        idle = now - self._setpoint_ns
        if self.state is State.MOVING and idle > limits.stale_setpoint_ticks * TICK_NS:
            silent = now - self._heard_ns > idle  # set-points answer states
            what = "no state, so no set-point" if silent else "no set-point"
            self.stop(f"{what} for {limits.stale_setpoint_ticks} ticks")
        silence = now - self._heard_ns
        if silence <= limits.stale_ticks * TICK_NS:
            return
        if self.state not in (State.STALE, State.LOST):
            self.counters.stalls += 1
            self.stop(f"no state for {limits.stale_ticks} ticks")
            self.state = State.STALE
        if silence > limits.patience * 1e9:
            self.state = State.LOST
            raise DeviceLost(f"{self.name}: no state for {limits.patience:g} s")
        since_try = now - self._tried_ns
        if (silence > SILENT_NS or not self._connected) and since_try > RETRY_NS:
            self._reconnect()

    def _reconnect(self) -> None:
        self._disconnect()
        self._connected = False
        try:
            self.info = self._connect()
        except DeviceError:
            self._tried_ns = time.monotonic_ns()
            return
        self._tried_ns = time.monotonic_ns()
        self._connected = True
        self.counters.reconnects += 1
        self.clock.forget()
