"""The CAN database (DBC) of a head, for whoever looks at the bus with other tools."""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from cantools.database.can import Bus, Database, Message, Node, Signal
from cantools.database.can.formats.dbc import DbcSpecifics
from cantools.database.can.formats.dbc.dbc_attribute_definition import DbcAttributeDefinition
from cantools.database.conversion import BaseConversion

from vibrissa.messages.types import WHISKERS
from vibrissa.rig.devices.can_bus import BITRATE, DATA_BITRATE
from vibrissa.rig.devices.can_layout import (
    COMMAND_BYTES,
    COMMAND_ID,
    CONTROL_BYTES,
    CONTROL_ID,
    HALF,
    SAMPLE_A_ID,
    SAMPLE_B_ID,
    SAMPLE_BYTES,
)
from vibrissa.rig.devices.protocol import PROTOCOL, THETA, Channel, Hello

FRAME_FORMAT: Final = DbcAttributeDefinition[str](
    "VFrameFormat",
    default_value="StandardCAN",
    kind="BO_",
    type_name="ENUM",
    choices=["StandardCAN", "ExtendedCAN", *("reserved",) * 12, "StandardCAN_FD"],
)
"""How a database says that a message is an FD frame."""


def database(hello: Hello) -> Database:
    """The CAN database of a head, made from its own channel map; `as_dbc_string()` writes it."""
    command = [_number("tick", 0, 32)]
    command += [
        _scaled(f"theta_set_{i:02d}", 4 + 2 * i, hello.command_scale, "rad")
        for i in range(WHISKERS)
    ]
    halves = (hello.channels[:HALF], hello.channels[HALF:])
    sample_a = [_number("seq_a", 0, 32), _number("time", 4, 32, "us"), _number("flags", 8, 8)]
    sample_b = [_number("seq_b", 0, 32), _number("answers", 4, 32)]
    for signals, half, version in zip(
        (sample_a, sample_b), halves, ("version_a", "version_b"), strict=True
    ):
        signals.append(_number(version, 9, 8))
        signals += [_scaled(c.name, 10 + 2 * k, c.scale, _unit(c)) for k, c in enumerate(half)]
    control = [_number(n, at, 8) for n, at in (("version_c", 0), ("type", 1), ("batch", 2))]
    messages = [
        _message(COMMAND_ID, "command", COMMAND_BYTES, "host", command),
        _message(SAMPLE_A_ID, "sample_a", SAMPLE_BYTES, "head", sample_a),
        _message(SAMPLE_B_ID, "sample_b", SAMPLE_BYTES, "head", sample_b),
        _message(CONTROL_ID, "control", CONTROL_BYTES, "host", [*control, _number("nonce", 4, 32)]),
    ]
    nodes = [Node(name) for name in ("host", "head")]
    bus = Bus("head", baudrate=BITRATE, fd_baudrate=DATA_BITRATE)
    specifics = DbcSpecifics(attribute_definitions=OrderedDict({FRAME_FORMAT.name: FRAME_FORMAT}))
    return Database(messages, nodes, [bus], str(PROTOCOL), specifics)


def _unit(channel: Channel) -> str:
    return "rad" if channel.kind == THETA else "N m"


def _number(name: str, at: int, bits: int, unit: str = "") -> Signal:
    return Signal(name, 8 * at, bits, byte_order="little_endian", unit=unit)


def _scaled(name: str, at: int, scale: float, unit: str) -> Signal:
    conversion = BaseConversion.factory(scale=float(f"{scale:.7g}"))
    return Signal(
        name,
        8 * at,
        16,
        byte_order="little_endian",
        is_signed=True,
        conversion=conversion,
        unit=unit,
    )


def _message(identifier: int, name: str, size: int, sender: str, signals: list[Signal]) -> Message:
    return Message(identifier, name, size, signals, senders=[sender], is_fd=True, strict=True)
