"""A SLAM beside the run's first one: the same images and odometry, a map of its own.

It is handed over everything the front end has seen so far, so that its map is the one it would have
had from the start; from then on it steps with every whisk cycle. What it says is recorded, and
reported as the run's once the front end names it in `slam.owner`.
"""

from __future__ import annotations

from collections.abc import Iterable

from vibrissa.messages.codec import Message
from vibrissa.messages.types import (
    HOST_ORDERS,
    TICK_NS,
    Answer,
    Event,
    Order,
    SlamHistory,
    SlamView,
)
from vibrissa.processes.config import Experiment
from vibrissa.processes.mapping import IMAGES, Mapping, Sight, Truth
from vibrissa.processes.node import Output
from vibrissa.processes.results import one_line
from vibrissa.processes.slams import make_slam
from vibrissa.slam.interface import Odometry

FRONT_END = "slam"


class SlamShadowNode:
    """An empty place until an order assigns a SLAM; one that raises an error is not asked again."""

    def __init__(self, experiment: Experiment, name: str) -> None:
        self.name = name
        self._experiment = experiment
        self._mapping: Mapping | None = None
        self._view: SlamView | None = None
        self._awake = False

    def step(self, message: Message) -> Iterable[Output]:
        body = message.body
        if message.topic == "run.order" and body.node == self.name:
            return [] if body.kind in HOST_ORDERS else [self._assign(body, message.t)]
        if self._mapping is None:
            return []
        try:
            match message.topic:
                case "slam.history" if body.node == self.name and not self._awake:
                    return self._catch_up(self._mapping, body, message.t)
                case "slam.view" if message.source == FRONT_END:
                    self._view = body
                case "slam.pose" if message.source == FRONT_END and self._awake:
                    odometry = Odometry(*body.odometry.tolist())
                    return self._see(self._mapping, body.cycle, odometry, body.truth)
                case "run.event" if body.kind == "stop" and self._awake:
                    return self._mapping.report()
        except Exception as error:  # whatever a stranger's SLAM raises
            self._mapping = None
            cause = one_line(f"{type(error).__name__}: {error}")
            return [("node.event", Event(message.t // TICK_NS, "failed", self.name, cause))]
        return []

    def counters(self) -> dict[str, int]:
        """Cycles that became a view."""
        return {"views": self._mapping.views if self._mapping else 0}

    def _assign(self, order: Order, t: int) -> Output:
        try:
            if order.kind != "assign":
                raise ValueError(f"{self.name} can't be told to {order.kind} {order.name}")
            slam = make_slam(order.name, self._experiment, order.value)
            self._mapping = Mapping(slam, self._experiment.slam.image)
            self._awake = False
            text, accepted = f"{order.name} waits for what was seen so far", 1
        except Exception as error:
            text, accepted = f"{error}" or type(error).__name__, 0
        return self._answer(order.request, t, accepted, text)

    def _catch_up(self, mapping: Mapping, history: SlamHistory, t: int) -> list[Output]:
        """Step through a part of the past; the last part is answered."""
        if history.first != mapping.views:
            return []  # an earlier part was not heard; it will be asked for again
        for cycle, image, odometry, truth in zip(
            history.cycles.tolist(), history.images, history.odometry, history.truth, strict=True
        ):
            mapping.learn(cycle, image, Odometry(*odometry.tolist()), truth)
        if mapping.views < history.total:
            return []
        self._awake = True
        text = f"{history.total} cycles handed over"
        return [self._answer(history.request, t, 1, text)]

    def _see(self, mapping: Mapping, cycle: int, odometry: Odometry, truth: Truth) -> list[Output]:
        view = self._view
        if view is None or view.cycle != cycle:
            return []
        images = {kind: getattr(view, kind) for kind in IMAGES}
        return mapping.see(Sight(cycle, images, odometry, truth))

    def _answer(self, request: int, t: int, accepted: int, text: str) -> Output:
        answer = Answer(request, t // TICK_NS, accepted, self.name, one_line(text))
        return "node.answer", answer
