"""What can go wrong with a device: one tree, one line each, saying what was expected and found.

DeviceError
+-- DeviceAddressError   a URL that names no device (also a ValueError)
+-- DeviceUnavailable    can't be opened: no such port, in use, refused, no answer, package missing
+-- DeviceRefused        answers, but is not what we can work with: version, channels, two heads
+-- DeviceLimit          a set-point that the limits forbid; nothing was sent (also a ValueError)
+-- DeviceStopped        the arm was stopped or is not enabled; only a person can change that
+-- DeviceLost           was open and has gone silent for longer than its patience
"""

from __future__ import annotations


class DeviceError(Exception):
    """Base of everything a device can refuse or suffer."""


class DeviceAddressError(DeviceError, ValueError):
    """A URL that names no device."""


class DeviceUnavailable(DeviceError):
    """A device that can't be opened."""


class DeviceRefused(DeviceError):
    """A device that answers but must not be used: another version, channel map or number of it."""


class DeviceLimit(DeviceError, ValueError):
    """A set-point outside the limits; nothing was sent."""


class DeviceStopped(DeviceError):
    """A motion asked of an arm that is stopped or was never enabled."""


class DeviceLost(DeviceError):
    """An open device that has been silent for longer than its patience."""
