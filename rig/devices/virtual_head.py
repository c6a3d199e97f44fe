"""The simulated head as a device: the emulated firmware without a wire, against the clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from vibrissa.control.kinematics import Float64s
from vibrissa.rig.devices.emulation import DeviceClock
from vibrissa.rig.devices.firmware import Firmware
from vibrissa.rig.devices.head import HeadDevice
from vibrissa.rig.devices.protocol import FromHead, FromHost, Hello
from vibrissa.rig.plant import HeadPlant, HeadPlantParams, Pose

NOWHERE: Pose = (0.0, 0.0, 1.0, 0.0)
"""A pose far above any maze."""


class VirtualHead(HeadDevice):
    """A head over `boxes` (float64[n, 5], m, as made by `wall_boxes`; none for an empty floor).

    pose says where the arm holds it, seed and params are those of `HeadPlant`.
    """

    _others_s = 0.0  # nobody else can be in here

    def __init__(
        self,
        boxes: Float64s | None = None,
        pose: Callable[[], Pose] = lambda: NOWHERE,
        *,
        seed: int = 0,
        params: HeadPlantParams | None = None,
    ) -> None:
        super().__init__("virtual head")
        if boxes is None:
            boxes = np.zeros((0, 5), np.float64)
        plant = HeadPlant(boxes, seed, params)
        self.firmware = Firmware(plant, pose, Hello(0, 0, (1, 0, 0), "VIRTUAL"), seed)
        self._said: list[FromHead] = []
        self._device_clock = DeviceClock()

    def reset(self) -> None:
        """Reset the firmware, as a person might."""
        self._said.append(self.firmware.reset())

    def _open_link(self) -> None:
        self._device_clock = DeviceClock()

    def _close_link(self) -> None:
        """There is no wire to let go of."""

    def _receive(self, timeout: float) -> Iterator[FromHead]:
        if not self._said:
            time.sleep(min(timeout, self._device_clock.wait()))
        said, self._said = self._said, []
        for _ in range(self._device_clock.due()):
            sample = self.firmware.sample()
            if sample is not None:
                said.append(sample)
        self.counters.frames += len(said)
        return iter(said)

    def _send(self, item: FromHost) -> None:
        answer = self.firmware.hear(item)
        if answer is not None:
            self._said.append(answer)
