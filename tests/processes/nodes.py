"""Nodes a person might put in the place of another: a good one and some that break the rules."""

from __future__ import annotations

import random
import time
import zlib
from typing import Any

import numpy as np

from vibrissa.messages.codec import Message
from vibrissa.processes.slam import SlamNode


class Shifted(SlamNode):
    """Believes to be 1 m further east; otherwise as good as any."""

    def step(self, message: Message) -> list[Any]:
        outputs = list(super().step(message))
        for topic, body in outputs:
            if topic == "slam.pose":
                body.estimate = body.estimate + np.array([1.0, 0.0, 0.0])
        return outputs


class _Impure(SlamNode):
    """Lets what is no input get into the error of every view."""

    def step(self, message: Message) -> list[Any]:
        outputs = list(super().step(message))
        for topic, body in outputs:
            if topic == "slam.view":
                body.error += self.impurity()
        return outputs

    def impurity(self) -> float:
        raise NotImplementedError


class ReadsTheClock(_Impure):
    def impurity(self) -> float:
        return time.monotonic_ns() % 1_000_000 * 1e-6


class DrawsGlobalNumbers(_Impure):
    def impurity(self) -> float:
        return random.random()


class DrawsGlobalNumpyNumbers(_Impure):
    def impurity(self) -> float:
        return float(np.random.random())  # noqa: NPY002


class FollowsSetOrder(_Impure):
    def impurity(self) -> float:
        order = "".join({f"whisker {i}" for i in range(18)})
        return zlib.crc32(order.encode()) * 1e-9


class RemembersOthers(_Impure):
    """Shares state with every other instance in its process."""

    count = 0

    def impurity(self) -> float:
        RemembersOthers.count += 1
        return float(RemembersOthers.count)


class Fails(SlamNode):
    """Can't cope with the tenth sample."""

    def step(self, message: Message) -> list[Any]:
        if message.topic == "head.sample" and message.seq == 10:
            raise ZeroDivisionError("no tenth sample, please")
        return list(super().step(message))


class NoNode:
    """Has no step."""

    def __init__(self, experiment: object) -> None:
        pass


def no_class(experiment: object) -> None:
    """Makes nothing."""
