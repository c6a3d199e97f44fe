"""The local view: recognise an image among the templates seen before, or make a new one.

Source: OpenRatSLAM's LocalViewMatch. The error of a template is the mean absolute difference to
the view at its best horizontal shift; the smallest error wins, the lowest id among equals. As in
the original, templates whose mean differs by more than the threshold + 0.005 are not looked at.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.slam.angles import PI, TAU
from vibrissa.slam.config import RatSlamConfig
from vibrissa.slam.template import Image, Template, TemplateBuilder, mean_value
from vibrissa.slam.template_search import TemplateIndex

MEAN_TOLERANCE: Final = 0.005


@dataclass(frozen=True, slots=True)
class View:
    """The outcome for one image.

    `error` is the mean absolute difference (0 to 1) of the best template, and a huge number when
    no template was compared. `relative_rad`: heading now minus heading stored (panoramic only).
    """

    template: int
    new: bool
    error: float
    relative_rad: float
    mean: float


class LocalView:
    """Templates and their search. Every image gets the id of a template, a known or a new one."""

    def __init__(self, config: RatSlamConfig) -> None:
        self._config = config
        self._builder = TemplateBuilder(config)
        self._index = TemplateIndex(
            config.template_y_size,
            config.template_x_size,
            config.vt_shift_match,
            config.vt_step_match,
            config.vt_panoramic,
        )
        self._last = -1

    def __len__(self) -> int:
        return len(self._index)

    @property
    def templates(self) -> NDArray[np.float64]:
        """float64[n, rows, columns] in order of creation (a view)."""
        return self._index.templates

    @property
    def nbytes(self) -> int:
        """Memory held for templates and their search, bytes."""
        return self._index.nbytes

    def check(self, image: Image) -> None:
        """Raise SlamInputError unless the image can be used; changes nothing."""
        self._builder.check(image)

    def on_image(self, image: Image) -> View:
        """Match one image; a template is added when none is within the threshold.

        Raises SlamInputError for an image of the wrong type or shape; nothing changes then.
        """
        template = self._builder.build(image)
        mean = float(mean_value(template))
        found, error, shift = self.nearest(template, mean)
        if error <= self._config.vt_match_threshold:
            self._last = found
            return View(found, False, error, self._relative_heading(shift), mean)
        self._last = self.add(template)
        return View(self._last, True, error, 0.0, mean)

    def add(self, template: Template) -> int:
        """Remember a template without looking whether it is known; return its id."""
        return self._index.add(template, float(mean_value(template)))

    def nearest(self, template: Template, mean: float) -> tuple[int, float, int]:
        """The best template for a view with this mean: its id, error and shift; changes nothing."""
        c = self._config
        if len(self) == 0:
            return -1, sys.float_info.max, 0
        compared = c.columns_compared * c.template_y_size
        tolerance = c.vt_match_threshold + MEAN_TOLERANCE
        if compared <= 0:
            # OpenRatSLAM compares no columns here: cost 0 over a negative count, always a match
            close = abs(mean - float(self._index.means[0])) <= tolerance
            nothing = np.float64(0.0 if close else sys.float_info.max)
            with np.errstate(divide="ignore", invalid="ignore"):
                return 0, float(nothing / np.float64(compared)), 0
        found, cost, shift = self._index.nearest(template, mean, tolerance, self._last)
        return found, (cost if found >= 0 else sys.float_info.max) / compared, shift

    def _relative_heading(self, shift: int) -> float:
        if not self._config.vt_panoramic:
            return 0.0
        angle = shift / self._config.template_x_size * TAU
        return angle - TAU if angle > PI else angle
