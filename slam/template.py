"""From an 8-bit image to a template: block means, normalisation, patch normalisation."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import compiled
from vibrissa.slam.config import RatSlamConfig
from vibrissa.slam.interface import SlamInputError

Image = NDArray[np.uint8]
Template = NDArray[np.float64]

FLAT_PATCH_STD: Final = 1e-9
"""Patches flatter than this become 0.5; in faithful mode rounding decides about a flat patch."""


class TemplateBuilder:
    """Turns images of one shape into templates float64[template_y_size, template_x_size].

    Every value lies in [0, 1]. The first image fixes the shape of all later ones. Blocks have
    integer sizes, so the right and bottom remainder of the crop is not looked at.
    """

    def __init__(self, config: RatSlamConfig) -> None:
        self._config = config
        self._shape: tuple[int, ...] | None = None

    def check(self, image: Image) -> None:
        """Raise SlamInputError unless the image can be used; changes nothing."""
        self._crop(image)

    def build(self, image: Image) -> Template:
        """The template of one image, uint8[rows, columns] or uint8[rows, columns, 3].

        Raises SlamInputError for another type, another shape than the first image's, or an
        image smaller than the crop or the template.
        """
        x_min, x_max, y_min, y_max = self._crop(image)
        self._shape = image.shape
        c = self._config
        channels = np.ascontiguousarray(image).reshape(image.shape[0], image.shape[1], -1)
        template = np.empty((c.template_y_size, c.template_x_size), dtype=np.float64)
        block_x = (x_max - x_min) // c.template_x_size
        block_y = (y_max - y_min) // c.template_y_size
        _block_means(channels, x_min, y_min, block_x, block_y, template)
        if c.vt_normalisation > 0.0:
            _normalise(template, float(c.vt_normalisation))
        if c.vt_patch_normalise > 0:
            flat = 0.0 if c.faithful else FLAT_PATCH_STD
            least = max(float(c.vt_min_patch_normalisation_std), flat)
            _patch_normalise(template.copy(), c.vt_patch_normalise, least, template)
        return template

    def _crop(self, image: Image) -> tuple[int, int, int, int]:
        c = self._config
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
            found = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
            raise SlamInputError(f"image: expected a uint8 array, found {found}")
        if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
            raise SlamInputError(
                f"image: expected shape (rows, columns) or (rows, columns, 3), found {image.shape}"
            )
        if self._shape is not None and image.shape != self._shape:
            raise SlamInputError(
                f"image: expected shape {self._shape} as before, found {image.shape}"
            )
        rows, columns = image.shape[:2]
        x_max = columns if c.image_crop_x_max == -1 else c.image_crop_x_max
        y_max = rows if c.image_crop_y_max == -1 else c.image_crop_y_max
        need_x = max(x_max, c.image_crop_x_min + c.template_x_size)
        need_y = max(y_max, c.image_crop_y_min + c.template_y_size)
        if columns < need_x or rows < need_y or x_max - c.image_crop_x_min < c.template_x_size:
            raise SlamInputError(
                f"image: expected at least {need_y} rows and {need_x} columns for the crop and"
                f" template, found {image.shape}"
            )
        if y_max - c.image_crop_y_min < c.template_y_size:
            raise SlamInputError(
                f"image: the crop has {y_max - c.image_crop_y_min} rows, expected at least"
                f" template_y_size {c.template_y_size}"
            )
        return c.image_crop_x_min, x_max, c.image_crop_y_min, y_max


@compiled
def _block_means(
    image: Image, x_min: int, y_min: int, block_x: int, block_y: int, out: Template
) -> None:
    rows, columns = out.shape
    channels = image.shape[2]
    for r in range(rows):
        for c in range(columns):
            total = 0
            for y in range(y_min + r * block_y, y_min + (r + 1) * block_y):
                for x in range(x_min + c * block_x, x_min + (c + 1) * block_x):
                    for channel in range(channels):
                        total += int(image[y, x, channel])
            out[r, c] = total / (255.0 * channels) / (block_x * block_y)


@compiled
def _normalise(template: Template, target: float) -> None:
    """Scale to a mean of `target`, clamped to [0, 1]; a black image stays black."""
    mean = mean_value(template)
    rows, columns = template.shape
    for r in range(rows):
        for c in range(columns):
            if mean > 0.0:
                template[r, c] = min(max(template[r, c] * target / mean, 0.0), 1.0)


@compiled
def _patch_normalise(source: Template, half: int, least_std: float, out: Template) -> None:
    """Each pixel against mean and standard deviation of its patch, +-3 std mapped to [0, 1]."""
    rows, columns = source.shape
    count = (2 * half + 1) * (2 * half + 1)
    for r in range(rows):
        for c in range(columns):
            total = 0.0
            for dr in range(-half, half + 1):
                for dc in range(-half, half + 1):
                    total += source[min(max(r + dr, 0), rows - 1), min(max(c + dc, 0), columns - 1)]
            mean = total / count
            squares = 0.0
            for dr in range(-half, half + 1):
                for dc in range(-half, half + 1):
                    d = (
                        source[min(max(r + dr, 0), rows - 1), min(max(c + dc, 0), columns - 1)]
                        - mean
                    )
                    squares += d * d
            std = math.sqrt(squares / count)
            if std < least_std or std == 0.0:
                out[r, c] = 0.5
            else:
                out[r, c] = min(max(((source[r, c] - mean) / std + 3.0) / 6.0, 0.0), 1.0)


@compiled
def mean_value(template: Template) -> float:
    """Mean of a template, summed in row order."""
    rows, columns = template.shape
    total = 0.0
    for r in range(rows):
        for c in range(columns):
            total += template[r, c]
    mean: float = total / (rows * columns)
    return mean
