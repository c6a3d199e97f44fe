"""Devices by URL, as an experiment file names them.

head:  virtual
       serial:PORT[?baud=N&batch=N]
       can:INTERFACE:CHANNEL[?bitrate=N&data_bitrate=N&batch=N]
arm:   virtual
       rtde:HOST
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from vibrissa.control.kinematics import Float64s
from vibrissa.rig.devices.arm import ArmDevice
from vibrissa.rig.devices.errors import DeviceAddressError
from vibrissa.rig.devices.head import HeadDevice
from vibrissa.rig.devices.limits import ARM, ArmLimits
from vibrissa.rig.devices.virtual_arm import VirtualArm
from vibrissa.rig.devices.virtual_head import NOWHERE, VirtualHead
from vibrissa.rig.plant import HeadPlantParams, Pose

START: Pose = (0.63, 0.09, 0.177, 0.0)
"""Where a virtual arm holds the head when nobody says otherwise."""
_SERIAL = {"baud": (1200, 20_000_000), "batch": (1, 100)}
_CAN = {"bitrate": (10_000, 1_000_000), "data_bitrate": (10_000, 8_000_000), "batch": (1, 100)}


class Address(NamedTuple):
    """The parts of a URL."""

    scheme: str
    place: str
    options: dict[str, str]


def parse(url: str, where: str, schemes: tuple[str, ...]) -> Address:
    """SCHEME:PLACE?NAME=VALUE&... Raises DeviceAddressError naming `where`."""
    rest, _, query = url.partition("?")
    scheme, _, place = rest.partition(":")
    if scheme not in schemes:
        raise DeviceAddressError(f"{where}: expected one of {', '.join(schemes)}, found {url!r}")
    if (scheme == "virtual") == bool(place) or (scheme == "virtual" and query):
        expected = "virtual" if scheme == "virtual" else f"{scheme}:PLACE"
        raise DeviceAddressError(f"{where}: expected {expected}, found {url!r}")
    options: dict[str, str] = {}
    for item in query.split("&") if query else ():
        name, equals, value = item.partition("=")
        if not equals or name in options:
            raise DeviceAddressError(
                f"{where}: expected NAME=VALUE once, found {item!r} in {url!r}"
            )
        options[name] = value
    return Address(scheme, place, options)


def _numbers(address: Address, where: str, allowed: dict[str, tuple[int, int]]) -> dict[str, int]:
    numbers = {}
    for name, text in address.options.items():
        if name not in allowed:
            raise DeviceAddressError(
                f"{where}: expected options {', '.join(allowed)}, found {name!r}"
            )
        low, high = allowed[name]
        if not text.isdecimal() or not low <= int(text) <= high:
            raise DeviceAddressError(f"{where}: {name}: expected {low} to {high}, found {text!r}")
        numbers[name] = int(text)
    return numbers


def make_head(
    url: str,
    *,
    boxes: Float64s | None = None,
    pose: Callable[[], Pose] = lambda: NOWHERE,
    seed: int = 0,
    params: HeadPlantParams | None = None,
) -> HeadDevice:
    """The head of a URL, not opened yet; the keywords are those of `VirtualHead`.

    Raises DeviceAddressError, or DeviceRefused for a bus that can't bear the load.
    """
    where = "rig.head"
    address = parse(url, where, ("virtual", "serial", "can"))
    match address.scheme:
        case "serial":
            from vibrissa.rig.devices.serial_head import SerialHead

            return SerialHead(address.place, **_numbers(address, where, _SERIAL))
        case "can":
            from vibrissa.rig.devices.can_head import CanHead

            interface, _, channel = address.place.partition(":")
            if not channel:
                raise DeviceAddressError(f"{where}: expected can:INTERFACE:CHANNEL, found {url!r}")
            return CanHead(interface, channel, **_numbers(address, where, _CAN))
    return VirtualHead(boxes, pose, seed=seed, params=params)


def make_arm(url: str, *, start: Pose = START, limits: ArmLimits = ARM) -> ArmDevice:
    """The arm of a URL, not opened yet; start: where a virtual one holds the head.

    Raises DeviceAddressError.
    """
    address = parse(url, "rig.arm", ("virtual", "rtde"))
    _numbers(address, "rig.arm", {})
    if address.scheme == "virtual":
        return VirtualArm(start, limits=limits)
    from vibrissa.rig.devices.rtde_arm import RtdeArm

    return RtdeArm(address.place, limits=limits)


def open_head(url: str) -> HeadDevice:
    """Open the head of a URL. Raises DeviceError."""
    return make_head(url).open()


def open_arm(url: str) -> ArmDevice:
    """Open the arm of a URL; it only listens until it is enabled. Raises DeviceError."""
    return make_arm(url).open()
