"""ur-rtde in a process of its own: `python -m vibrissa.rig.devices.rtde_link listen|control ...`.

Some calls of ur-rtde hold the interpreter's lock while they connect, wait minutes for an answer, or
reconnect from a thread of their own and crash when they are interrupted in that. Here they can be
given up at any moment by ending the process; the controller's watchdog then stops the arm.

The parent talks over a socket that keeps messages apart. `listen` sends a STATE per packet of the
controller. `control` does nothing before it is asked to ENABLE, which it answers with b"1" or the
reason why it can't, and then every request with one byte: b"1" done, b"0" not.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from typing import Any, Final

STATE = struct.Struct("<d6d6d6dIi")
"""stamp; joints; TCP pose; TCP speed; safety bits; robot mode."""
POSE = struct.Struct("<6d")
ENABLE, SERVO, HALT, RUNNING = b"E", b"S", b"H", b"R"
POLL_S: Final = 0.0005
EARLY_S: Final = 0.002
"""How long before the next state is due polling begins."""
PRIORITY: Final = 30
"""Of SCHED_FIFO, where the parent has it."""
LOOKAHEAD: Final = 0.03
GAIN: Final = 1000.0
VARIABLES: Final = [
    "timestamp",
    "actual_q",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "robot_mode",
    "safety_status_bits",
    "runtime_state",
]


class Link:
    """The parent's end: a running process and the socket to it."""

    def __init__(self, *arguments: str) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            module = "vibrissa.rig.devices.rtde_link"
            self._popen = subprocess.Popen(
                [sys.executable, "-m", module, *arguments, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # ur-rtde talks to itself here
                stderr=subprocess.DEVNULL,
            )
        self._socket = ours

    def receive(self, timeout: float) -> bytes | None:
        """The next message within `timeout` s. Raises OSError when the process has ended."""
        if not select.select([self._socket], [], [], timeout)[0]:
            return None
        data = self._socket.recv(4096)
        if not data:
            raise OSError("the link has ended")
        return data

    def ask(self, request: bytes, timeout: float) -> bytes | None:
        """What is answered, None when nothing is in time. Raises OSError as `receive` does."""
        self._socket.send(request)
        return self.receive(timeout)

    def done(self, request: bytes, timeout: float) -> bool:
        """Whether a request was done; False too when there is no answer in time."""
        try:
            return self.ask(request, timeout) == b"1"
        except OSError:
            return False

    def fileno(self) -> int:
        """What to wait on."""
        return self._socket.fileno()

    def end(self) -> None:
        """End the process, whatever it is doing."""
        self._socket.close()
        self._popen.kill()
        self._popen.wait()


def listen(link: socket.socket, host: str, frequency: float) -> None:
    """Pass on every state, until the controller or the parent is gone."""
    from rtde_receive import RTDEReceiveInterface

    receiver = RTDEReceiveInterface(host, frequency, VARIABLES)
    pause = max(1.0 / frequency - EARLY_S, 0.0)
    last = receiver.getTimestamp()
    while receiver.isConnected():
        stamp = receiver.getTimestamp()
        if stamp == last:
            time.sleep(POLL_S)
            continue
        values = (
            *receiver.getActualQ(),
            *receiver.getActualTCPPose(),
            *receiver.getActualTCPSpeed(),
            receiver.getSafetyStatusBits(),
            receiver.getRobotMode(),
        )
        if receiver.getTimestamp() == stamp:  # else another packet has come between
            link.send(STATE.pack(stamp, *values))
            last = stamp
            time.sleep(pause)


def control(link: socket.socket, host: str, frequency: float, period: float, brake: float) -> None:
    """Carry out the parent's requests. frequency: Hz of the watchdog; brake: m/s^2."""
    from rtde_control import RTDEControlInterface

    if link.recv(256) != ENABLE:
        return
    try:
        controller: Any = RTDEControlInterface(host, 1.0 / period)
        if not controller.setWatchdog(frequency):
            raise RuntimeError("the watchdog can't be set")
    except (RuntimeError, ValueError) as error:
        link.send((str(error).splitlines() or [type(error).__name__])[0].encode()[:400])
        return
    link.send(b"1")
    while request := link.recv(256):
        done = False
        with contextlib.suppress(RuntimeError, ValueError):
            match request[:1]:
                case b"S":
                    pose = list(POSE.unpack(request[1:]))
                    done = controller.servoL(pose, 0.0, 0.0, period, LOOKAHEAD, GAIN)
                case b"H":
                    done = controller.servoStop(brake)
                case b"R":
                    done = controller.isProgramRunning()
        link.send(b"1" if done else b"0")


def _make_way() -> None:
    """Run where there is room, ur-rtde's threads after everybody else who is in a hurry."""
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


def main() -> None:
    """Entry point: listen HOST HZ FD, or control HOST HZ PERIOD BRAKE FD."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _make_way()
    what, host, *numbers, descriptor = sys.argv[1:]
    with socket.socket(fileno=int(descriptor)) as link, contextlib.suppress(OSError, RuntimeError):
        (listen if what == "listen" else control)(link, host, *map(float, numbers))
    os._exit(0)  # ur-rtde's destructors may wait, or crash


if __name__ == "__main__":
    main()
