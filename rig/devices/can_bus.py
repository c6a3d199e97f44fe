"""CAN buses by name, and one of our own that needs nothing but the loopback interface."""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import socket
import struct
from collections.abc import Sequence
from typing import Any, Final

import can
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from vibrissa.rig.devices.can_layout import Frame
from vibrissa.rig.devices.errors import DeviceAddressError, DeviceUnavailable

INTERFACES: Final = ("socketcan", "udp_multicast", "virtual", "loopback")
BITRATE, DATA_BITRATE = 1_000_000, 5_000_000
ERROR_ID: Final = -1
"""Stands for a frame that the controller found to be damaged."""
_EVERYBODY: Final = "127.255.255.255"
_MULTICAST_PORT: Final = 43113
"""That of python-can."""
_DATA: Final = b"\xa4data\xc4"
"""msgpack: a name of four letters, and bytes; how many is the byte behind it."""
_FORMS: Final = 64
"""How many forms of frames are learnt, so that strangers can't have us learn for ever."""
_HEADER = struct.Struct("<I")
_KEEP: Final = 1 << 22
_SO_RCVBUFFORCE: Final = 33
"""Linux: beyond the system's limit, for those who may."""
_SO_ATTACH_FILTER: Final = 26
_LOAD_WORD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06
"""Of the kernel's packet filter (linux/bpf_common.h)."""
_UDP_HEADER: Final = 8


class LoopbackBus(can.BusABC):
    """A CAN FD bus between the processes of one machine: datagrams to 127.255.255.255.

    `channel` is a port number. Every member of the port hears every frame of the others. For
    kernels without CAN and networks without multicast; like them it neither arbitrates nor
    acknowledges.
    """

    def __init__(self, channel: Any, **kwargs: Any) -> None:
        super().__init__(channel, **kwargs)
        self.channel_info = f"loopback {channel}"
        self._can_protocol = can.CanProtocol.CAN_FD
        self._to = (_EVERYBODY, int(channel))
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._in = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._out.bind(("127.0.0.1", 0))
        self._me = self._out.getsockname()
        self._in.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        _keep_more(self._in.fileno())
        self._in.bind(self._to)
        self._in.setblocking(False)

    def frame(self, timeout: float | None) -> Frame | None:
        """The next frame of another member within `timeout` s."""
        while True:
            try:
                data, sender = self._in.recvfrom(256)
            except BlockingIOError:
                if timeout == 0 or not select.select([self._in], [], [], timeout)[0]:
                    return None
                continue
            if sender != self._me and 4 <= len(data) <= 68:
                return _HEADER.unpack_from(data)[0] & 0x7FF, data[4:]

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        frame = self.frame(timeout)
        return (None if frame is None else _message(*frame)), False

    def put(self, identifier: int, data: bytes) -> None:
        """Send one frame."""
        self._out.sendto(_HEADER.pack(identifier) + data, self._to)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.put(msg.arbitration_id, bytes(msg.data))

    def fileno(self) -> int:
        return self._in.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        self._in.close()
        self._out.close()


class MulticastBus(UdpMulticastBus):
    """python-can's bus without what only its messages need: time stamps, checks, and one each.

    All frames of one identifier and size are packed alike but for their data, so they are packed,
    and known again, by what stands before and behind it; any other frame is python-can's to read.
    """

    def __init__(self, channel: str) -> None:
        super().__init__(channel, port=_MULTICAST_PORT, fd=True, hop_limit=0)
        self._to = (channel, _MULTICAST_PORT)
        self._socket = socket.socket(fileno=os.dup(self.fileno()))
        self._forms: dict[tuple[int, int], tuple[bytes, bytes]] = {}
        self._seen: dict[bytes, tuple[int, int, bytes]] = {}
        """before the data -> identifier, size of the data, what is behind it"""
        _keep_more(self.fileno())

    def put(self, identifier: int, data: bytes) -> None:
        """Send one frame. Raises OSError."""
        before, behind = self._form(identifier, len(data))
        self._socket.sendto(before + data + behind, self._to)

    def frame(self, timeout: float) -> Frame | None:
        """The next frame within `timeout` s, one's own ones too."""
        while True:
            try:
                data = self._socket.recv(4096, socket.MSG_DONTWAIT)
            except BlockingIOError:
                if timeout == 0 or not select.select([self._socket], [], [], timeout)[0]:
                    return None
                continue
            at = _data_at(data)
            known = self._seen.get(data[:at])
            if known is not None and data[at + known[1] :] == known[2]:
                return known[0], data[at : at + known[1]]
            try:
                message = unpack_message(data)
                identifier, content = message.arbitration_id, bytes(message.data)
                if len(self._forms) < _FORMS:
                    before, behind = self._form(identifier, len(content))
                    if before + content + behind == data:
                        self._seen[before] = identifier, len(content), behind
            except Exception:  # of msgpack and of python-can, for what is no frame
                continue
            return identifier, content

    def _form(self, identifier: int, size: int) -> tuple[bytes, bytes]:
        """What python-can packs before and behind the data of such a frame."""
        form = self._forms.get((identifier, size))
        if form is None:
            packed = pack_message(_message(identifier, bytes(size)))
            at = _data_at(packed)
            form = self._forms[identifier, size] = packed[:at], packed[at + size :]
        return form

    def shutdown(self) -> None:
        super().shutdown()
        self._socket.close()


def _data_at(packed: bytes) -> int:
    """Where the data of a frame begins that python-can has packed."""
    return packed.find(_DATA) + len(_DATA) + 1


def _keep_more(descriptor: int) -> None:
    """Let the kernel hold more datagrams for a reader that is kept from running."""
    with socket.socket(fileno=os.dup(descriptor)) as same:
        same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KEEP)  # the system's limit counts
        with contextlib.suppress(OSError):
            same.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _KEEP)


def _turn_deaf(bus: can.BusABC, identifiers: Sequence[int]) -> None:
    """Have the kernel drop frames of these identifiers, so that a member need not hear itself.

    A member of a bus of datagrams is woken for what it said, too. Drops only what is packed as
    this end packs it; whatever else there is comes through.
    """
    words = []
    at = 0
    for identifier in identifiers:
        if isinstance(bus, LoopbackBus):
            packed = _HEADER.pack(identifier)
        else:
            packed = pack_message(_message(identifier, b""))
            at = packed.index(b"arbitration_id") + len("arbitration_i")  # and the id behind it
        words.append(int.from_bytes(packed[at : at + 4], "big"))
    steps = [(_LOAD_WORD, 0, 0, _UDP_HEADER + at)]
    steps += [(_JUMP_IF_EQUAL, len(words) - k, 0, word) for k, word in enumerate(words)]
    steps += [(_RETURN, 0, 0, 0xFFFFFFFF), (_RETURN, 0, 0, 0)]
    program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    with socket.socket(fileno=os.dup(bus.fileno())) as same:
        same.setsockopt(
            socket.SOL_SOCKET,
            _SO_ATTACH_FILTER,
            struct.pack("HL", len(steps), ctypes.addressof(program)),
        )


def _message(identifier: int, data: bytes) -> can.Message:
    return can.Message(
        arbitration_id=identifier,
        data=data,
        is_extended_id=False,
        is_fd=True,
        bitrate_switch=True,
    )


def send_frame(bus: can.BusABC, identifier: int, data: bytes) -> None:
    """Put one FD frame on a bus. Raises OSError."""
    try:
        if isinstance(bus, LoopbackBus | MulticastBus):
            bus.put(identifier, data)
        else:
            bus.send(_message(identifier, data))
    except can.CanError as error:
        raise OSError(str(error)) from None


def receive_frame(bus: can.BusABC, timeout: float) -> Frame | None:
    """The next frame within `timeout` s, 0 for what is there. Raises OSError."""
    if isinstance(bus, LoopbackBus | MulticastBus):
        return bus.frame(timeout)
    try:
        message = bus.recv(timeout)
    except can.CanError as error:
        raise OSError(str(error)) from None
    if message is None:
        return None
    return (ERROR_ID if message.is_error_frame else message.arbitration_id), bytes(message.data)


def open_bus(name: str, interface: str, channel: str, own: Sequence[int] = ()) -> can.BusABC:
    """A bus; `name` is for messages. Raises DeviceAddressError or DeviceUnavailable.

    own: identifiers that only this member sends, and need not hear.
    """
    if interface not in INTERFACES:
        raise DeviceAddressError(
            f"{name}: interface: expected one of {', '.join(INTERFACES)}, found {interface!r}"
        )
    if interface == "loopback" and (not channel.isdigit() or not 1024 <= int(channel) < 2**16):
        raise DeviceAddressError(f"{name}: channel: expected a port, found {channel!r}")
    try:
        if interface == "loopback":
            bus: can.BusABC = LoopbackBus(channel)
        elif interface == "udp_multicast":
            bus = MulticastBus(channel)
        else:
            return can.Bus(interface=interface, channel=channel, fd=True)
        if own:
            _turn_deaf(bus, own)
        return bus
    except (can.CanError, OSError, ValueError, NotImplementedError) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DeviceUnavailable(f"{name}: can't be opened: {text}") from None


def close_bus(bus: can.BusABC | None) -> None:
    """Let go of a bus; never raises."""
    if bus is not None:
        with contextlib.suppress(can.CanError, OSError):
            bus.shutdown()
