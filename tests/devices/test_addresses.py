"""Devices are chosen by URL; a URL that names none is refused in one line."""

from __future__ import annotations

import pytest

from vibrissa.rig.devices.addresses import make_arm, make_head, open_arm, open_head
from vibrissa.rig.devices.can_head import CanHead
from vibrissa.rig.devices.errors import DeviceAddressError, DeviceError, DeviceRefused
from vibrissa.rig.devices.rtde_arm import RtdeArm
from vibrissa.rig.devices.serial_head import SerialHead
from vibrissa.rig.devices.virtual_arm import VirtualArm
from vibrissa.rig.devices.virtual_head import VirtualHead


def test_every_scheme_makes_its_device() -> None:
    assert isinstance(make_head("virtual"), VirtualHead)
    head = make_head("serial:/dev/ttyACM0?baud=3000000&batch=5")
    assert isinstance(head, SerialHead) and head.name == "serial:/dev/ttyACM0"
    head = make_head("can:socketcan:can0?bitrate=1000000&data_bitrate=8000000")
    assert isinstance(head, CanHead) and head.load[1] < 0.7
    assert isinstance(make_arm("virtual"), VirtualArm)
    assert isinstance(make_arm("rtde:127.0.0.9"), RtdeArm)


def test_virtual_devices_open_by_url() -> None:
    with open_head("virtual") as head:
        assert head.read(1.0) is not None
    with open_arm("virtual") as arm:
        assert arm.read(1.0) is not None


@pytest.mark.parametrize(
    ("url", "complaint"),
    [
        ("", "rig.head: expected one of virtual, serial, can, found ''"),
        ("usb:1", "rig.head: expected one of virtual, serial, can"),
        ("serial:", "rig.head: expected serial:PLACE"),
        ("virtual:1", "rig.head: expected virtual, found"),
        ("can:can0", "rig.head: expected can:INTERFACE:CHANNEL"),
        ("serial:/dev/x?speed=9", "rig.head: expected options baud, batch, found 'speed'"),
        ("serial:/dev/x?baud=fast", "rig.head: baud: expected 1200 to 20000000, found 'fast'"),
        ("serial:/dev/x?batch=1&batch=2", "rig.head: expected NAME=VALUE once"),
    ],
)
def test_other_urls_are_refused(url: str, complaint: str) -> None:
    with pytest.raises(DeviceAddressError, match=complaint) as caught:
        make_head(url)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, DeviceError) and isinstance(caught.value, ValueError)


def test_arms_are_refused_too_and_so_is_an_overloaded_bus() -> None:
    with pytest.raises(DeviceAddressError, match=r"rig\.arm: expected one of virtual, rtde"):
        make_arm("ros:192.168.0.1")
    with pytest.raises(DeviceAddressError, match=r"rig\.arm: expected options"):
        make_arm("rtde:127.0.0.1?fast=1")
    with pytest.raises(DeviceRefused, match="bus load"):
        make_head("can:virtual:x?data_bitrate=1000000")
