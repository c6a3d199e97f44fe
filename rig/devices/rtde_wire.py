"""The real-time data exchange of Universal Robots (RTDE, protocol version 2), on the wire.

Everything is big-endian. A packet is a uint16 with the whole size, a uint8 type and a payload. Data
packets begin with the number of a recipe, a list of variables that was agreed on before.
"""

from __future__ import annotations

import re
import socket
import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

from vibrissa.rig.devices.errors import DeviceRefused, DeviceUnavailable

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
VERSION, CONTROLLER, OUTPUTS, INPUTS, START, PAUSE, DATA = b"VvOISPU"
LONGEST: Final = 4096

NORMAL_BIT, REDUCED_BIT, PROTECTIVE_BIT = 1 << 0, 1 << 1, 1 << 2
SAFEGUARD_BIT, SYSTEM_ESTOP_BIT, ROBOT_ESTOP_BIT, ESTOP_BIT = 1 << 4, 1 << 5, 1 << 6, 1 << 7
VIOLATION_BIT, FAULT_BIT, SAFETY_STOP_BIT = 1 << 8, 1 << 9, 1 << 10
RUNNING_MODE: Final = 7

_FORMATS: Final = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
_OUTPUTS: Final = {
    "DOUBLE": r"timestamp|speed_scaling|target_speed_fraction|actual_momentum|actual_main_voltage|"
    r"actual_robot_voltage|actual_robot_current|actual_execution_time|tcp_force_scalar|payload|"
    r"standard_analog_(in|out)put\d|output_double_register_\d+",
    "VECTOR6D": r"target_(q|qd|qdd|current|moment|TCP_pose|TCP_speed)|"
    r"actual_(q|qd|current|joint_voltage|TCP_pose|TCP_speed|TCP_force|current_as_torque)|"
    r"joint_(control_output|temperatures)|ft_raw_wrench|payload_inertia",
    "VECTOR3D": r"actual_tool_accelerometer|payload_cog",
    "VECTOR6INT32": r"joint_mode",
    "INT32": r"robot_mode|safety_mode|output_int_register_\d+",
    "UINT32": r"runtime_state|robot_status_bits|safety_status_bits|"
    r"output_bit_registers(0_to_31|32_to_63)",
    "UINT64": r"actual_digital_(in|out)put_bits",
}
_INPUTS: Final = {
    "INT32": r"input_int_register_\d+",
    "DOUBLE": r"input_double_register_\d+|speed_slider_fraction|standard_analog_output_[01]",
    "UINT32": r"speed_slider_mask|input_bit_registers(0_to_31|32_to_63)",
    "UINT8": r"(standard|configurable|tool)_digital_output(_mask)?|"
    r"standard_analog_output_(mask|type)",
    "BOOL": r"input_bit_register_\d+",
    "VECTOR6D": r"external_force_torque",
}


class Packet(NamedTuple):
    """One packet, its header taken off."""

    type: int
    payload: bytes


def packet(kind: int, payload: bytes = b"") -> bytes:
    """A packet as it travels."""
    return struct.pack(">HB", 3 + len(payload), kind) + payload


class PacketParser:
    """Finds the packets in a stream that comes in pieces."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Packet] | None:
        """The packets completed by `data`; None when the stream makes no sense any more."""
        self._rest += data
        found = []
        while len(self._rest) >= 3:
            size, kind = struct.unpack_from(">HB", self._rest)
            if not 3 <= size <= LONGEST:
                return None
            if len(self._rest) < size:
                break
            found.append(Packet(kind, self._rest[3:size]))
            self._rest = self._rest[size:]
        return found


@dataclass(frozen=True)
class Recipe:
    """Variables in the order in which they are packed, and their types."""

    names: tuple[str, ...]
    types: tuple[str, ...]

    @staticmethod
    def of(names: bytes, *, inputs: bool) -> Recipe:
        """The recipe of a client's list of names, of which unknown ones are NOT_FOUND."""
        listed = tuple(n for n in names.decode("ascii", "replace").split(",") if n)
        table = _INPUTS if inputs else _OUTPUTS
        return Recipe(listed, tuple(_type(name, table) for name in listed))

    def agreed(self) -> bool:
        """Whether every name is known."""
        return "NOT_FOUND" not in self.types

    def layout(self) -> struct.Struct:
        """How the values are packed."""
        return struct.Struct(">" + "".join(_FORMATS[t] for t in self.types))

    def unpack(self, payload: bytes) -> dict[str, tuple[float, ...]] | None:
        """name -> values, None when the length is wrong."""
        layout = self.layout()
        if len(payload) != layout.size:
            return None
        values = layout.unpack(payload)
        found, at = {}, 0
        for name, kind in zip(self.names, self.types, strict=True):
            width = _width(kind)
            found[name] = values[at : at + width]
            at += width
        return found

    def zeros(self, name: str) -> tuple[int, ...]:
        """A value for a variable that nobody sets."""
        return (0,) * _width(self.types[self.names.index(name)])


def _type(name: str, table: dict[str, str]) -> str:
    for kind, pattern in table.items():
        if re.fullmatch(pattern, name):
            return kind
    return "NOT_FOUND"


def _width(kind: str) -> int:
    return 3 if kind == "VECTOR3D" else 6 if kind.startswith("VECTOR6") else 1


class Probe(NamedTuple):
    """What a controller says of itself without being asked to do anything."""

    version: tuple[int, int, int, int]
    stamp: float
    robot_mode: int
    safety_bits: int
    tcp_pose: tuple[float, ...]


def probe(host: str, timeout: float = 0.5) -> Probe:
    """Ask a controller who it is and how it is; moves nothing, claims nothing, always returns.

    Raises DeviceUnavailable when nobody answers, DeviceRefused when the answer is none of RTDE.
    """
    name = f"rtde:{host}"
    names = b"timestamp,robot_mode,safety_status_bits,actual_TCP_pose"
    try:
        with socket.create_connection((host, RTDE_PORT), timeout) as link:
            ask = _Asker(name, link)
            if ask(VERSION, struct.pack(">H", 2)) != b"\x01":
                raise DeviceRefused(f"{name}: RTDE: expected protocol version 2, found it refused")
            version = ask(CONTROLLER)
            recipe = ask(OUTPUTS, struct.pack(">d", 125.0) + names)
            expected = b"DOUBLE,INT32,UINT32,VECTOR6D"
            if len(version) != 16 or recipe[1:] != expected:
                raise DeviceRefused(f"{name}: RTDE: expected {expected!r}, found {recipe[1:]!r}")
            ask(START)
            payload = ask.wait(DATA)
            found = Recipe.of(names, inputs=False).unpack(payload[1:])
            if found is None:
                raise DeviceRefused(f"{name}: RTDE: found data of {len(payload)} bytes")
    except TimeoutError:
        raise DeviceUnavailable(f"{name}: no answer within {timeout:g} s") from None
    except OSError as error:
        raise DeviceUnavailable(f"{name}: {error.strerror or error}") from None
    major, minor, bugfix, build = struct.unpack(">4I", version)
    return Probe(
        (major, minor, bugfix, build),
        found["timestamp"][0],
        int(found["robot_mode"][0]),
        int(found["safety_status_bits"][0]),
        found["actual_TCP_pose"],
    )


class _Asker:
    """Sends a packet, waits for the answer of the same type."""

    def __init__(self, name: str, link: socket.socket) -> None:
        self._name = name
        self._link = link
        self._parser = PacketParser()
        self._packets: list[Packet] = []

    def __call__(self, kind: int, payload: bytes = b"") -> bytes:
        self._link.sendall(packet(kind, payload))
        return self.wait(kind)

    def wait(self, kind: int) -> bytes:
        for _ in range(100):
            while self._packets:
                found = self._packets.pop(0)
                if found.type == kind:
                    return found.payload
            data = self._link.recv(LONGEST)
            packets = self._parser.feed(data) if data else None
            if packets is None:
                raise DeviceRefused(f"{self._name}: expected RTDE, found something else")
            self._packets = packets
        raise DeviceRefused(f"{self._name}: RTDE: no answer to {chr(kind)}")
