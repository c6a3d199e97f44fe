"""The buses of datagrams: who hears what."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from vibrissa.rig.devices.can_bus import (
    MulticastBus,
    close_bus,
    open_bus,
    receive_frame,
    send_frame,
)
from vibrissa.rig.devices.can_layout import FROM_HEAD, FROM_HOST
from vibrissa.rig.devices.errors import DeviceUnavailable

STRANGER = 0x123


@pytest.fixture(params=["loopback", "udp_multicast"])
def members(request: pytest.FixtureRequest) -> Iterator[dict[str, can.BusABC]]:
    """A host, a head, and one that listens to everything."""
    channel = "239.74.163.77"
    if request.param == "loopback":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.255.255.255", 0))
            channel = str(probe.getsockname()[1])
    found: dict[str, can.BusABC] = {}
    try:
        for name, own in (("host", FROM_HOST), ("head", FROM_HEAD), ("anybody", ())):
            found[name] = open_bus(name, request.param, channel, own)
    except DeviceUnavailable as error:
        pytest.skip(str(error))
    yield found
    for bus in found.values():
        close_bus(bus)


def heard(bus: can.BusABC) -> list[tuple[int, bytes]]:
    """What comes until nothing comes."""
    found = []
    while (message := bus.recv(0.1)) is not None:
        found.append((message.arbitration_id, bytes(message.data)))
    return found


def test_members_hear_everything_but_what_only_they_say(members: dict[str, can.BusABC]) -> None:
    said = [(i, bytes((i & 0xFF,)) * 8) for i in (*FROM_HOST, *FROM_HEAD, STRANGER)]
    for identifier, data in said:
        send_frame(members["anybody"], identifier, data)
    for name, own in (("host", FROM_HOST), ("head", FROM_HEAD)):
        assert heard(members[name]) == [frame for frame in said if frame[0] not in own]


def test_multicast_is_python_cans() -> None:
    channel = "239.74.163.78"
    try:
        ours = open_bus("ours", "udp_multicast", channel)
    except DeviceUnavailable as error:
        pytest.skip(str(error))
    theirs = can.Bus(interface="udp_multicast", channel=channel, fd=True, hop_limit=0)
    try:
        # twice each: packed, and known again, by what was learnt the first time
        said = 2 * [(i, bytes(range(n))) for i in (0, 0x80, 0x7FF) for n in (0, 8, 64)]
        said += [(0x80, b"\xa4data\xc4\x08\x00")]
        for identifier, data in said:
            send_frame(ours, identifier, data)
        assert heard(theirs) == said
        while receive_frame(ours, 0.0) is not None:
            pass  # it hears itself
        found = []
        for identifier, data in said:
            for fd in (True, False) if len(data) <= 8 else (True,):
                theirs.send(
                    can.Message(
                        arbitration_id=identifier,
                        data=data,
                        is_fd=fd,
                        bitrate_switch=fd,
                        is_extended_id=False,
                    )
                )
                found.append(receive_frame(ours, 1.0))
                assert found[-1] == (identifier, data)
        assert len(found) > len(said)
    finally:
        close_bus(ours)
        close_bus(theirs)


def test_strangers_frames_on_multicast_end_nothing_and_are_not_learnt_for_ever() -> None:
    channel = "239.74.163.79"
    try:
        ours = open_bus("ours", "udp_multicast", channel)
    except DeviceUnavailable as error:
        pytest.skip(str(error))
    assert isinstance(ours, MulticastBus)
    theirs = can.Bus(interface="udp_multicast", channel=channel, fd=True, hop_limit=0)
    whole = msgpack.unpackb(pack_message(can.Message(arbitration_id=1, data=b"12")))
    wrong = [whole | {"arbitration_id": found} for found in ([], {}, None, "x", -1)]
    wrong += [whole | {"data": found} for found in (None, 7, "x", [300])]
    try:
        with socket.socket(fileno=os.dup(theirs.fileno())) as wire:
            for frame in (b"", b"\xa4data\xc4", *map(msgpack.packb, wrong)):
                wire.sendto(frame, (channel, 43113))
        for identifier in range(2000, 2300):
            theirs.send(can.Message(arbitration_id=identifier, data=b"12"))
        heard_of = []
        while (frame := receive_frame(ours, 0.2)) is not None:
            heard_of.append(frame)
        assert heard_of[-300:] == [(identifier, b"12") for identifier in range(2000, 2300)]
        assert len(ours._forms) <= 64 and len(ours._seen) <= 64
    finally:
        close_bus(ours)
        close_bus(theirs)


def test_an_own_frame_does_not_wake_its_sender(members: dict[str, can.BusABC]) -> None:
    for identifier in FROM_HOST:
        send_frame(members["host"], identifier, bytes(8))
    assert [identifier for identifier, _ in heard(members["head"])] == list(FROM_HOST)
    assert heard(members["host"]) == []
