"""An emulated UR10 controller: `python -m vibrissa.rig.devices.rtde_emulator --host 127.0.0.11`.

A stand-in for tests, not proof against a controller: it speaks RTDE (30004), the dashboard (29999)
and takes script uploads (30003), but runs no URScript; the commands of the control script that the
driver uses are executed here. Bound to any address of 127.0.0.0/8, so several run at once.

Orders: stall S, protective_stop, emergency_stop, unlock, reboot S, travelled (rad of joint motion
so far), normal.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import ipaddress
import struct
import sys
import time
from collections.abc import Awaitable, Callable
from typing import Final

from vibrissa.rig.devices import ur10
from vibrissa.rig.devices.emulation import Orders, PoseMouth, read_pose
from vibrissa.rig.devices.rtde_robot import Robot
from vibrissa.rig.devices.rtde_wire import (
    CONTROLLER,
    DASHBOARD_PORT,
    DATA,
    INPUTS,
    LONGEST,
    OUTPUTS,
    PAUSE,
    RTDE_PORT,
    SCRIPT_PORT,
    START,
    VERSION,
    Packet,
    PacketParser,
    Recipe,
    packet,
)

SCRIPT_LONGEST: Final = 1 << 18
CLIENTS: Final = 16
BACKLOG: Final = 1 << 16
"""Bytes that may wait for a client that does not read; then its data is dropped."""
SENSIBLE: Final = 1e6
"""No position, speed or time of a command is larger."""
_REGISTERS: Final = 24


class Session:
    """One RTDE client: its recipes and whether it wants data. Knows nothing of sockets."""

    def __init__(self, robot: Robot, version: tuple[int, int, int, int]) -> None:
        self._robot = robot
        self._version = version
        self._parser = PacketParser()
        self._outputs: dict[int, Recipe] = {}
        self._inputs: dict[int, Recipe] = {}
        self._started = False
        self._registers = [0.0] * _REGISTERS

    def hear(self, data: bytes) -> bytes | None:
        """Answers to what a client sent; None when it has to be thrown out."""
        packets = self._parser.feed(data)
        if packets is None:
            return None
        answers = b""
        for item in packets:
            answer = self._answer(item)
            if answer is None:
                return None
            answers += answer
        return answers

    def _answer(self, item: Packet) -> bytes | None:
        kind, payload = item
        if kind == VERSION and len(payload) == 2:
            return packet(VERSION, bytes((payload == b"\0\x02",)))
        if kind == CONTROLLER and not payload:
            return packet(CONTROLLER, struct.pack(">4I", *self._version))
        if kind == OUTPUTS and len(payload) > 8:
            recipe = Recipe.of(payload[8:], inputs=False)
            return self._agree(OUTPUTS, recipe, self._outputs)
        if kind == INPUTS:
            return self._agree(INPUTS, Recipe.of(payload, inputs=True), self._inputs)
        if kind in (START, PAUSE) and not payload:
            self._started = kind == START
            return packet(kind, b"\x01")
        if kind == DATA and payload and payload[0] in self._inputs:
            values = self._inputs[payload[0]].unpack(payload[1:])
            if values is not None:
                self._take(values)
            return b""
        return None

    def _agree(self, kind: int, recipe: Recipe, recipes: dict[int, Recipe]) -> bytes | None:
        if len(recipes) >= 255:
            return None
        number = 0
        if recipe.agreed():
            number = len(recipes) + 1
            recipes[number] = recipe
        return packet(kind, bytes((number,)) + ",".join(recipe.types).encode())

    def _take(self, values: dict[str, tuple[float, ...]]) -> None:
        for name, (value, *_) in values.items():
            if name.startswith("input_double_register_"):
                index = int(name.rpartition("_")[2])
                if index < _REGISTERS and abs(value) < SENSIBLE:
                    self._registers[index] = value
        if "input_int_register_0" in values:
            number = int(values["input_int_register_0"][0])
            self._robot.command(number, tuple(self._registers))

    def data(self) -> bytes:
        """The data packets of this cycle."""
        if not self._started:
            return b""
        found = b""
        for number, recipe in self._outputs.items():
            values: list[float] = []
            for name in recipe.names:
                value = self._robot.value(name)
                values += recipe.zeros(name) if value is None else value
            found += packet(DATA, bytes((number,)) + recipe.layout().pack(*values))
        return found


class Dashboard:
    """The dashboard server's side of a conversation."""

    GREETING = b"Connected: Universal Robots Dashboard Server\n"

    def __init__(self, robot: Robot, version: tuple[int, int, int, int]) -> None:
        self._robot = robot
        self._version = version

    def answer(self, line: str) -> str:
        """What it says to a line."""
        match line.strip().lower():
            case "polyscopeversion":
                major, minor, bugfix, build = self._version
                return f"URSoftware {major}.{minor}.{bugfix}.{build} (Jan 01 2020)"
            case "get serial number":
                return "20193000001"
            case "is in remote control":
                return "true"
            case "robotmode":
                running = self._robot.robot_mode == 7
                return f"Robotmode: {'RUNNING' if running else 'POWER_OFF'}"
            case "safetystatus":
                normal = self._robot.safety & 1
                return f"Safetystatus: {'NORMAL' if normal else 'PROTECTIVE_STOP'}"
            case "running":
                return f"Program running: {str(self._robot.runtime == 2).lower()}"
            case "unlock protective stop":
                self._robot.unlock()
                return "Protective stop releasing"
            case "stop":
                self._robot.halt()
                return "Stopped"
            case "quit":
                return "Disconnected"
        return f"could not understand: '{line.strip()[:80]}'"


class Controller:
    """The controller's three servers and its cycle."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        major, minor, bugfix = map(int, arguments.version.split("."))
        self._version = (major, minor, bugfix, 106339)
        self._host: str = arguments.host
        period = 0.008 if major < 5 else 0.002
        self.robot = Robot(ur10.Mount(), read_pose(arguments.pose), period)
        self._mouth = PoseMouth(arguments.tell) if arguments.tell else None
        self._sessions: dict[asyncio.StreamWriter, Session] = {}
        self._writers: set[asyncio.StreamWriter] = set()
        self._servers: list[asyncio.Server] = []
        self._stalled_until = 0.0
        self._back_at: float | None = None
        self.orders = Orders(
            {
                "stall": self.stall,
                "protective_stop": self.robot.protective_stop,
                "emergency_stop": self.robot.emergency_stop,
                "unlock": self.robot.unlock,
                "reboot": self.reboot,
                "travelled": lambda: self.robot.travelled,
                "normal": self.normal,
            }
        )

    def stall(self, seconds: float) -> None:
        """Send nothing for so long; everything else goes on."""
        self._stalled_until = time.monotonic() + seconds

    def reboot(self, seconds: float) -> None:
        """Close everything, be away for so long, start afresh."""
        for server in self._servers:
            server.close()
        for writer in list(self._writers):
            writer.transport.abort()
        self._back_at = time.monotonic() + seconds
        self.robot.reboot()

    def normal(self) -> None:
        """No more faults."""
        self.stall(0.0)
        self.robot.unlock()

    async def run(self) -> None:
        """Until the standard input ends."""
        await self._serve()
        ended = asyncio.Event()
        stdin = sys.stdin.fileno()
        asyncio.get_running_loop().add_reader(
            stdin, lambda: None if self.orders.take() else ended.set()
        )
        self.orders.ready(f"rtde:{self._host}")
        cycle = time.monotonic()
        while not ended.is_set():
            cycle = max(cycle + self.robot.period, time.monotonic() - 0.1)
            await asyncio.sleep(max(cycle - time.monotonic(), 0.0))
            if self._back_at is not None:
                if time.monotonic() >= self._back_at:
                    self._back_at = None
                    await self._serve()
                continue
            self._cycle()

    def _cycle(self) -> None:
        self.robot.step()
        if self._mouth is not None:
            self._mouth.tell(self.robot.head())
        if time.monotonic() < self._stalled_until:
            return
        for writer, session in self._sessions.items():
            if writer.transport.get_write_buffer_size() < BACKLOG:
                writer.write(session.data())

    async def _serve(self) -> None:
        services = (
            (RTDE_PORT, self._rtde),
            (DASHBOARD_PORT, self._dashboard),
            (SCRIPT_PORT, self._script),
        )
        self._servers = [
            await asyncio.start_server(self._guarded(service), self._host, port, limit=LONGEST)
            for port, service in services
        ]

    def _guarded(
        self, service: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
    ) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            if len(self._writers) < CLIENTS:
                self._writers.add(writer)
                # A line too long, a broken connection, our own end: each ends this client only.
                with contextlib.suppress(OSError, ValueError, asyncio.CancelledError):
                    await service(reader, writer)
                self._writers.discard(writer)
            writer.close()

        return serve

    async def _rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        session = Session(self.robot, self._version)
        self._sessions[writer] = session
        try:
            while data := await reader.read(LONGEST):
                answers = session.hear(data)
                if answers is None:
                    return
                writer.write(answers)
        finally:
            del self._sessions[writer]

    async def _dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        dashboard = Dashboard(self.robot, self._version)
        writer.write(dashboard.GREETING)
        while line := await reader.readline():
            answer = dashboard.answer(line.decode(errors="replace"))
            writer.write(answer.encode() + b"\n")
            if answer == "Disconnected":
                return

    async def _script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        script = b""
        while len(script) < SCRIPT_LONGEST and (data := await reader.read(LONGEST)):
            script += data
            if b"def rtde_control" in script and script.rstrip().endswith(b"end"):
                script = b""
                self.robot.play()


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="An emulated UR10 controller, for tests.")
    parser.add_argument("--host", default="127.0.0.1", help="address to bind, of this machine")
    parser.add_argument("--pose", default="0.63,0.09,0.177,0", help="head x,y,z,yaw at first")
    parser.add_argument("--version", default="3.15.8", help="controller version it reports")
    parser.add_argument("--tell", type=int, help="port of 127.0.0.1 to tell the head's pose to")
    arguments = parser.parse_args()
    if not ipaddress.ip_address(arguments.host).is_loopback:
        parser.error(f"--host: expected an address of 127.0.0.0/8, found {arguments.host}")
    try:
        asyncio.run(Controller(arguments).run())
    except OSError as error:
        sys.exit(f"rtde emulator: {arguments.host}: {error.strerror}")


if __name__ == "__main__":
    main()
