"""Emulators of the devices: how they are started, told what to do, and how they keep time.

An emulator is a process of its own. It prints one line of JSON when it is ready, with the URL of
the device it plays, then takes orders from its standard input, one per line, and answers each with
a line: "ok" or what was wrong. It ends with its input.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Final, Self

from vibrissa.rig.devices.errors import DeviceUnavailable

READY_S: Final = 120.0
ANSWER_S: Final = 30.0
TICK_S: Final = 0.0005
BACKLOG: Final = 40
"""Ticks an emulator makes up for when it was kept from running; beyond them its clock is late."""
_POSE = struct.Struct("<4d")
Pose = tuple[float, float, float, float]


class EmulatorProcess:
    """An emulator that was started; a context manager that ends it."""

    def __init__(self, kind: str, arguments: Sequence[str] = ()) -> None:
        """kind: "serial", "can" or "rtde". Raises DeviceUnavailable when it does not come up."""
        module = f"vibrissa.rig.devices.{kind}_emulator"
        self.name = f"{kind} emulator"
        self._popen = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
        )
        try:
            ready = json.loads(self._line(READY_S))
        except (ValueError, DeviceUnavailable):
            self.stop()
            raise DeviceUnavailable(f"{self.name}: could not start (see above)") from None
        self.url: str = ready["url"]
        self.hear: int = ready["hear"]
        """Port of 127.0.0.1 at which a head that listens (`--hear`) takes its pose, else 0."""

    def ask(self, order: str) -> str:
        """Give an order and wait for the answer. Raises DeviceUnavailable when there is none."""
        stdin = self._popen.stdin
        assert stdin is not None
        try:
            stdin.write(order.encode() + b"\n")
            stdin.flush()
        except (OSError, ValueError):  # the latter: it was stopped
            raise DeviceUnavailable(f"{self.name}: has ended") from None
        return self._line(ANSWER_S)

    def stop(self) -> None:
        """End it. May be repeated."""
        if self._popen.stdin is not None:
            with contextlib.suppress(OSError):
                self._popen.stdin.close()
        try:
            self._popen.wait(2.0)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()
        if self._popen.stdout is not None:
            self._popen.stdout.close()

    @property
    def pid(self) -> int:
        """Its process number."""
        return self._popen.pid

    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._popen.poll() is None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _line(self, timeout: float) -> str:
        stdout = self._popen.stdout
        assert stdout is not None
        if not select.select([stdout], [], [], timeout)[0]:
            raise DeviceUnavailable(f"{self.name}: no answer within {timeout:g} s")
        line = stdout.readline().decode().strip()
        if not line:
            raise DeviceUnavailable(f"{self.name}: has ended")
        return line


class Orders:
    """The emulator's side of its standard input and output."""

    def __init__(self, handlers: Mapping[str, Callable[..., object]]) -> None:
        """handlers: name -> function of numbers; what it returns, if anything, is the answer."""
        self._handlers = handlers
        self._rest = b""

    def ready(self, url: str, hear: int = 0) -> None:
        """Say that the device can be opened, and at which port it takes its pose."""
        print(json.dumps({"ready": True, "url": url, "hear": hear}), flush=True)

    def take(self) -> bool:
        """Carry out what has come in; False when there will be nothing more."""
        data = os.read(sys.stdin.fileno(), 4096)
        if not data or len(self._rest) > 4096:
            return False
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            print(self.carry_out(line.decode(errors="replace").split()), flush=True)
        return True

    def carry_out(self, words: list[str]) -> str:
        """One order: its name and its numbers; the answer."""
        if not words or words[0] not in self._handlers:
            return f"expected one of {', '.join(self._handlers)}"
        try:
            result = self._handlers[words[0]](*map(float, words[1:]))
        except (TypeError, ValueError) as error:
            return f"{words[0]}: {error}"
        return "ok" if result is None else str(result)


class DeviceClock:
    """A 2 kHz clock of its own: `drift` (1e-6 is one ppm fast) and `jitter` of its ticks, s.

    When its process was kept from running it makes up for BACKLOG ticks, at twice the pace: a head
    sends no bursts, and its clock is late for what was longer.
    """

    def __init__(self, drift: float = 0.0, jitter: float = 0.0, seed: int = 0) -> None:
        self._period = TICK_S / (1.0 + drift)
        self._jitter = jitter
        self._random = random.Random(seed)
        self._next = self._ideal = time.monotonic()

    def wait(self) -> float:
        """Seconds until the next tick is due."""
        return max(self._next - time.monotonic(), 0.0)

    def due(self) -> int:
        """Whether a tick has become due since the last one: 0 or 1 of them."""
        now = time.monotonic()
        if self._next > now:
            return 0
        self._ideal = max(self._ideal, now - BACKLOG * self._period) + self._period
        jitter = self._random.random() * self._jitter
        self._next = max(self._ideal + jitter, now + 0.5 * self._period)
        return 1


class Line:
    """What may happen to bytes on their way: bit errors, drop-outs."""

    def __init__(self, seed: int = 0) -> None:
        self.bit_errors = 0.0
        self.dropped_until = 0.0
        self._random = random.Random(seed)

    def errors(self, rate: float) -> None:
        """Flip each bit with probability `rate` from now on."""
        if not 0.0 <= rate <= 1.0:
            raise ValueError(f"expected a rate of 0 to 1, found {rate}")
        self.bit_errors = rate

    def drop(self, seconds: float) -> None:
        """Let nothing through for so long."""
        self.dropped_until = time.monotonic() + seconds

    def open(self) -> bool:
        """Whether anything gets through at all."""
        return time.monotonic() >= self.dropped_until

    def carry(self, data: bytes) -> bytes:
        """What arrives of `data`."""
        if not self.bit_errors:
            return data
        hurt = bytearray(data)
        for bit in self._hits(8 * len(data)):
            hurt[bit >> 3] ^= 1 << (bit & 7)
        return bytes(hurt)

    def hit(self, bits: int) -> bool:
        """Whether so many bits suffer an error: what a CAN controller rejects."""
        return bool(self.bit_errors) and next(self._hits(bits), -1) >= 0

    def _hits(self, bits: int) -> Iterator[int]:
        bit = -1
        while True:
            bit += 1 + int(self._random.expovariate(self.bit_errors) if self.bit_errors < 1 else 0)
            if bit >= bits:
                return
            yield bit


class PoseEar:
    """Where the emulated arm (or whoever holds the head) says the head is: 127.0.0.1, UDP."""

    def __init__(self, pose: Pose, port: int | None) -> None:
        """port: to listen at, None to keep the pose; 0 takes a free one."""
        self.pose = pose
        self.port = 0
        self._socket: socket.socket | None = None
        if port is not None:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.bind(("127.0.0.1", port))
            self._socket.setblocking(False)
            self.port = self._socket.getsockname()[1]

    def listen(self) -> Pose:
        """The newest pose that was told."""
        while self._socket is not None:
            try:
                data = self._socket.recv(64)
            except BlockingIOError:
                break
            if len(data) == _POSE.size:
                pose = _POSE.unpack(data)
                if all(abs(v) < 100.0 for v in pose):
                    self.pose = pose
        return self.pose


class PoseMouth:
    """Tells an emulated head where it is."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect(("127.0.0.1", port))

    def tell(self, pose: Pose) -> None:
        """Send a pose; nobody need be listening."""
        with contextlib.suppress(OSError):
            self._socket.send(_POSE.pack(*pose))


def head_arguments(description: str) -> argparse.ArgumentParser:
    """The command line that emulated heads share."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--maze", help="maze file (default: the shipped 7 x 5 board)")
    parser.add_argument("--pose", default="0.63,0.09,0.177,0", help="head x,y,z,yaw in m, rad")
    parser.add_argument("--hear", type=int, help="port of 127.0.0.1 for poses, 0: any")
    parser.add_argument("--serial", default="VIB-EMU-1", help="which head this is")
    parser.add_argument("--seed", type=int, default=1, help="of noise, boot numbers and errors")
    parser.add_argument("--plant", type=json.loads, default={}, help="HeadPlantParams as JSON")
    parser.add_argument("--drift", type=float, default=0.0, help="of its clock, ppm")
    parser.add_argument("--jitter", type=float, default=0.0, help="of its ticks, us")
    parser.add_argument("--protocol", type=int, default=1, help="protocol version it claims")
    parser.add_argument("--channels", type=int, default=54, help="channels it claims")
    return parser


def read_pose(text: str) -> Pose:
    """x,y,z,yaw. Raises ValueError."""
    x, y, z, yaw = map(float, text.split(","))
    return x, y, z, yaw


def maze_text(name: str | None) -> str:
    """A maze file's text; None for the shipped board."""
    if name is not None:
        return Path(name).read_text()
    return (resources.files("vibrissa.rig") / "mazes" / "board7x5.maze").read_text()
