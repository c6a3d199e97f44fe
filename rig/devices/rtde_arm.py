"""A UR10 over RTDE, by way of the package ur-rtde (see `rtde_link` for why at arm's length)."""

from __future__ import annotations

import importlib.util
import math
import time
from typing import Final

from vibrissa.rig.devices import rtde_wire, ur10
from vibrissa.rig.devices.arm import TICK_NS, ArmDevice, ArmReport, Controller, Safety
from vibrissa.rig.devices.errors import DeviceRefused, DeviceStopped, DeviceUnavailable
from vibrissa.rig.devices.limits import ARM, ArmLimits, Pose
from vibrissa.rig.devices.rtde_link import ENABLE, HALT, POSE, RUNNING, SERVO, STATE, Link

HALT_S: Final = 0.3
START_S: Final = 15.0


class RtdeArm(ArmDevice):
    """A UR10 whose controller answers at `host`.

    Opening only listens; a second link stands by, so that `enable` need not wait for a process to
    start, and says nothing to the controller yet. `enable` uploads the control script, asks the
    controller to stop by itself when set-points stay away (`limits.watchdog`), and lets set-points
    through, each as a servoL.
    """

    def __init__(
        self, host: str, *, limits: ArmLimits = ARM, mount: ur10.Mount | None = None
    ) -> None:
        super().__init__(f"rtde:{host}", limits=limits, mount=mount or ur10.Mount())
        self._host = host
        self._listener: Link | None = None
        self._control: Link | None = None
        self._standby: Link | None = None
        self._q: ur10.Joints | None = None
        self._tilt = 0.0
        self._answer_s = limits.stale_setpoint_ticks * TICK_NS * 1e-9
        """How long the control link may take for a set-point: as long as there may be none."""

    def fileno(self) -> int:
        return self._listener.fileno() if self._listener is not None else -1

    def _connect(self) -> Controller:
        _check_package()
        found = rtde_wire.probe(self._host)  # ur-rtde would wait for ever for a mute controller
        period = 0.008 if found.version[0] < 5 else 0.002
        self._listener = Link("listen", self._host, str(1.0 / period))
        self._standby = self._make_control(period)
        return Controller("UR10", ".".join(map(str, found.version)), period)

    def _disconnect(self) -> None:
        for link in (self._control, self._standby, self._listener):
            if link is not None:
                link.end()
        self._control = self._standby = self._listener = None

    def _make_control(self, period: float) -> Link:
        numbers = (self.limits.watchdog, period, self.limits.deceleration)
        return Link("control", self._host, *map(str, numbers))

    def _next(self, timeout: float) -> ArmReport | None:
        assert self._listener is not None and self._mount is not None
        data = self._listener.receive(timeout)
        if data is None:
            return None
        stamp, *values = STATE.unpack(data)
        if not all(map(math.isfinite, values)):
            return None  # no pose is better than a wrong one: silence stops the arm
        a, b, c, d, e, f = values[:6]
        self._q = (a, b, c, d, e, f)
        pose, self._tilt = self._mount.head(tuple(values[6:12]))
        speed = math.hypot(*values[12:15])
        return ArmReport(stamp, time.monotonic_ns(), pose, speed, _safety(*values[18:]))

    def _joints(self) -> ur10.Joints | None:
        return self._q

    def _start_motion(self) -> None:
        if self._tilt > self.limits.tilt:
            raise DeviceStopped(
                f"{self.name}: can't be enabled: expected the head's axis within "
                f"{self.limits.tilt:.3g} rad of vertical, found it {self._tilt:.3g} off"
            )
        if self._control is not None and self._control.done(RUNNING, self._answer_s):
            return
        self._give_up_control()
        link = self._standby or self._make_control(self.info.period)
        self._standby = None
        try:
            answer = link.ask(ENABLE, START_S)
        except OSError:
            answer = b"ur-rtde has crashed"
        if answer != b"1":
            link.end()
            reason = answer.decode(errors="replace") if answer else "no answer"
            raise DeviceStopped(f"{self.name}: can't be enabled: {reason}")
        self._control = link

    def _send(self, setpoint: Pose) -> bool:
        assert self._mount is not None
        request = SERVO + POSE.pack(*self._mount.tcp(setpoint))
        return self._control is not None and self._control.done(request, self._answer_s)

    def _halt(self) -> None:
        if self._control is None or self._control.done(HALT, HALT_S):
            return
        running = self._control.done(RUNNING, self._answer_s)
        self._give_up_control()  # whose watchdog then stops the arm, if nothing has yet
        if running:
            raise DeviceRefused("the controller did not confirm the stop")

    def _give_up_control(self) -> None:
        if self._control is not None:
            self._control.end()
            self._control = None


def _check_package() -> None:
    if importlib.util.find_spec("rtde_control") is None:
        raise DeviceUnavailable(
            "rtde: the package ur-rtde is not installed; it has wheels for Python 3.8 to 3.12 "
            "on x86: pip install ur-rtde"
        )


def _safety(bits: int, mode: int) -> Safety:
    wire = rtde_wire
    if bits & (wire.SYSTEM_ESTOP_BIT | wire.ROBOT_ESTOP_BIT | wire.ESTOP_BIT):
        return Safety.EMERGENCY_STOP
    if bits & (wire.PROTECTIVE_BIT | wire.SAFEGUARD_BIT):
        return Safety.PROTECTIVE_STOP
    if bits & (wire.VIOLATION_BIT | wire.FAULT_BIT):
        return Safety.FAULT
    return Safety.NORMAL if mode == wire.RUNNING_MODE else Safety.NOT_RUNNING
