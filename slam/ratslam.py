"""RatSLAM: local view, pose cells and experience map in one deterministic step.

Source: Milford & Wyeth's RatSLAM as in OpenRatSLAM, whose three programs run here in lock-step:
image, view, odometry, action, map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.slam.config import RatSlamConfig
from vibrissa.slam.experience_map import ExperienceMap
from vibrissa.slam.interface import (
    ACTION_CREATE_EDGE,
    ACTION_CREATE_NODE,
    ACTION_NONE,
    Odometry,
    SlamMap,
    SlamStep,
)
from vibrissa.slam.local_view import LocalView
from vibrissa.slam.pose_cells import PoseCells


class RatSlam:
    """RatSLAM behind the `Slam` interface. The parts are open to look at, not to step."""

    def __init__(self, config: RatSlamConfig) -> None:
        self.config = config
        self.local_view = LocalView(config)
        self.pose_cells = PoseCells(config)
        self.experience_map = ExperienceMap(config)

    def step(self, image: NDArray[np.uint8], odometry: Odometry) -> SlamStep:
        """Take the image seen at the end of an odometry step; return the new estimate.

        image: uint8[rows, columns], or uint8[rows, columns, 3] (BGR).
        Raises SlamInputError, before any state changes, for an image of the wrong shape or type
        and for a step of more than 10,000 pose cells.
        """
        v, w, dt = odometry.v, odometry.w, odometry.dt
        self.local_view.check(image)
        self.pose_cells.check_odo(v, w, dt)

        view = self.local_view.on_image(image)
        self.pose_cells.on_view_template(view.template, view.relative_rad)
        self.pose_cells.on_odo(v, w, dt)
        action = self.pose_cells.get_action()
        self.experience_map.on_odo(v, w, dt)
        if action.kind == ACTION_CREATE_NODE:
            self.experience_map.create()
        elif action.kind == ACTION_CREATE_EDGE:
            self.experience_map.link(action.source, action.target, view.relative_rad)
            self.experience_map.enter(action.target, view.relative_rad)
        if action.kind != ACTION_NONE:
            self.experience_map.iterate()

        x, y, heading = self.experience_map.pose
        pc_x, pc_y, pc_th = self.pose_cells.best
        return SlamStep(
            template=view.template,
            new_template=view.new,
            match_error=view.error if view.error <= 1.0 else float("inf"),
            experience=self.experience_map.current,
            action=action.kind,
            x=x,
            y=y,
            heading=heading,
            pc_x=pc_x,
            pc_y=pc_y,
            pc_th=pc_th,
            experiences=len(self.experience_map),
            templates=len(self.local_view),
        )

    def map(self) -> SlamMap:
        """Return a copy of the current map."""
        return SlamMap(
            poses=self.experience_map.poses.copy(),
            links=self.experience_map.links(),
            templates=self.pose_cells.experience_views.copy(),
        )
