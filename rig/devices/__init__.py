"""Drivers and emulators of the head and the arm.

`open_head` and `open_arm` open a device by its URL; see `addresses`. Every error is a `DeviceError`
of `errors`. The limits of everything that moves are in `limits`.
"""
