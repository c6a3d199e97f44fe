"""RatSLAM parameters: OpenRatSLAM's names and defaults, its configuration files, and presets.

Source: Ball et al., "OpenRatSLAM: an open source brain-based SLAM system", Autonomous Robots 2013.
"""

from __future__ import annotations

import configparser
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final


class ConfigError(ValueError):
    """A RatSLAM parameter is unknown, malformed or out of range."""


@dataclass(frozen=True, slots=True)
class RatSlamConfig:
    """Parameters of RatSLAM, named and defaulted as in OpenRatSLAM.

    OpenRatSLAM's own defaults for the local view (a template of one pixel, a shift of 25) leave
    nothing to compare, so `RatSlamConfig()` alone raises; give a template size and a shift.

    template_x_size, template_y_size: template columns and rows.
    image_crop_*: part of the image used, pixels, max -1 = to the edge.
    vt_match_threshold: mean absolute difference (0 to 1) up to which a template is recognised.
    vt_shift_match, vt_step_match: largest horizontal shift and its step, columns.
    vt_normalisation: mean the template is scaled to, 0 = off.
    vt_patch_normalise: half width of the normalisation patch, 0 = off.
    vt_min_patch_normalisation_std: patches flatter than this become 0.5.
    vt_panoramic: shifts wrap around; the match gives a relative heading.
    vt_active_decay: habituation added by each repetition of a template.
    pc_dim_xy, pc_dim_th: pose cells per axis (x and y; heading).
    pc_w_e_dim, pc_w_e_var, pc_w_i_dim, pc_w_i_var: width (cells) of the excitatory and the
        inhibitory kernel and their standard deviation (cells; the name says variance).
    pc_global_inhib: activity taken from every cell in each iteration.
    pc_vt_inject_energy: activity injected by a recognised view.
    pc_vt_restore: habituation forgotten per view.
    pc_cell_x_size: side of a pose cell, m.
    exp_delta_pc_threshold: pose-cell distance (cells) that makes a new experience.
    exp_correction, exp_loops: relaxation gain and sweeps.
    exp_initial_em_deg: heading at the start, degrees.
    faithful: reproduce OpenRatSLAM's known defects (see the modules) instead of the fixes.

    Raises ConfigError on construction when a value is out of range.
    """

    template_x_size: int = 1
    template_y_size: int = 1
    image_crop_x_min: int = 0
    image_crop_x_max: int = -1
    image_crop_y_min: int = 0
    image_crop_y_max: int = -1
    vt_match_threshold: float = 0.03
    vt_shift_match: int = 25
    vt_step_match: int = 5
    vt_normalisation: float = 0.0
    vt_patch_normalise: int = 0
    vt_min_patch_normalisation_std: float = 0.0
    vt_panoramic: bool = False
    vt_active_decay: float = 1.0
    pc_dim_xy: int = 21
    pc_dim_th: int = 36
    pc_w_e_dim: int = 7
    pc_w_e_var: int = 1
    pc_w_i_dim: int = 5
    pc_w_i_var: int = 2
    pc_global_inhib: float = 0.00002
    pc_vt_inject_energy: float = 0.15
    pc_vt_restore: float = 0.05
    pc_cell_x_size: float = 1.0
    exp_delta_pc_threshold: float = 2.0
    exp_correction: float = 0.5
    exp_loops: int = 10
    exp_initial_em_deg: float = 90.0
    faithful: bool = False

    def __post_init__(self) -> None:
        for field in fields(self):
            value: Any = getattr(self, field.name)
            expected = _TYPES[str(field.type)]
            if not isinstance(value, expected) or (
                isinstance(value, bool) and str(field.type) != "bool"
            ):
                raise ConfigError(f"{field.name}: expected {field.type}, found {value!r}")
            if not math.isfinite(float(getattr(self, field.name))):
                raise ConfigError(f"{field.name}: expected a finite number, found {value}")
        for name in _POSITIVE:
            if getattr(self, name) <= 0:
                raise ConfigError(f"{name}: expected > 0, found {getattr(self, name)}")
        for name in _NOT_NEGATIVE:
            if getattr(self, name) < 0:
                raise ConfigError(f"{name}: expected >= 0, found {getattr(self, name)}")
        for name in ("pc_w_e_dim", "pc_w_i_dim"):
            if getattr(self, name) % 2 == 0:
                raise ConfigError(f"{name}: expected an odd width, found {getattr(self, name)}")
        for axis in "xy":
            low: int = getattr(self, f"image_crop_{axis}_min")
            high: int = getattr(self, f"image_crop_{axis}_max")
            if high != -1 and high <= low:
                raise ConfigError(
                    f"image_crop_{axis}_max: expected -1 or > image_crop_{axis}_min ({low}),"
                    f" found {high}"
                )
        if not self.faithful and not self.vt_panoramic and self.columns_compared <= 0:
            raise ConfigError(
                f"vt_shift_match: a shift of {self.vt_shift_match} leaves no columns of"
                f" template_x_size {self.template_x_size}, expected"
                f" <= {(self.template_x_size - 1) // 2}"
            )

    @property
    def columns_compared(self) -> int:
        """Template columns that every shift compares (all of them when panoramic)."""
        if self.vt_panoramic:
            return self.template_x_size
        return self.template_x_size - 2 * self.vt_shift_match


_TYPES: Final[dict[str, tuple[type, ...]]] = {
    "int": (int,),
    "float": (int, float),
    "bool": (bool,),
}
_POSITIVE: Final = (
    "template_x_size",
    "template_y_size",
    "vt_step_match",
    "pc_dim_xy",
    "pc_dim_th",
    "pc_w_e_dim",
    "pc_w_e_var",
    "pc_w_i_dim",
    "pc_w_i_var",
    "pc_cell_x_size",
    "exp_delta_pc_threshold",
)
_NOT_NEGATIVE: Final = (
    "image_crop_x_min",
    "image_crop_y_min",
    "vt_match_threshold",
    "vt_shift_match",
    "vt_normalisation",
    "vt_patch_normalise",
    "vt_min_patch_normalisation_std",
    "vt_active_decay",
    "pc_global_inhib",
    "pc_vt_inject_energy",
    "pc_vt_restore",
    "exp_correction",
    "exp_loops",
)


def parse_config(text: str, overrides: Mapping[str, Any] | None = None) -> RatSlamConfig:
    """Read the [ratslam] section of an OpenRatSLAM configuration file, given as its text.

    Other sections ([general], [draw], [visual_odometry]) belong to other programs and are passed
    over. Text without any section header is taken as the [ratslam] section. `overrides` replaces
    single values before anything is checked, which is how a file that leaves `vt_shift_match` at
    OpenRatSLAM's unusable default is repaired.

    Raises ConfigError for malformed text, unknown parameters and values out of range.
    """
    parser = configparser.ConfigParser(
        interpolation=None, inline_comment_prefixes=("#", ";"), strict=True
    )
    parser.optionxform = str  # type: ignore[method-assign,assignment]
    headed = any(line.lstrip().startswith("[") for line in text.splitlines())
    try:
        parser.read_string(text if headed else "[ratslam]\n" + text)
    except configparser.Error as error:
        raise ConfigError(f"configuration text: {' '.join(str(error).split())}") from None
    if not parser.has_section("ratslam"):
        raise ConfigError(
            f"configuration text: expected a section [ratslam], found {parser.sections()}"
        )
    types = {field.name: str(field.type) for field in fields(RatSlamConfig)}
    values: dict[str, Any] = {}
    for name, raw in parser.items("ratslam"):
        if name not in types:
            raise ConfigError(f"[ratslam] {name}: unknown parameter")
        values[name] = _parse_value(name, types[name], raw)
    for name, value in (overrides or {}).items():
        if name not in types:
            raise ConfigError(f"{name}: unknown parameter")
        values[name] = value
    return RatSlamConfig(**values)


def _parse_value(name: str, kind: str, raw: str) -> int | float | bool:
    try:
        if kind == "bool":
            return {"0": False, "1": True, "false": False, "true": True}[raw.strip().lower()]
        return int(raw) if kind == "int" else float(raw)
    except (ValueError, KeyError):
        raise ConfigError(f"[ratslam] {name}: expected {kind}, found {raw!r}") from None


IRAT: Final = RatSlamConfig(
    template_x_size=60,
    template_y_size=20,
    image_crop_y_max=150,
    vt_match_threshold=0.03,
    vt_shift_match=4,
    vt_step_match=1,
    pc_dim_xy=11,
    pc_vt_inject_energy=0.1,
    pc_cell_x_size=0.015,
    exp_delta_pc_threshold=2.0,
    exp_loops=20,
    exp_initial_em_deg=140.0,
)
"""iRat in the Australia maze, 2011: a robot of 15 mm cells and forward camera."""

ST_LUCIA: Final = RatSlamConfig(
    template_x_size=60,
    template_y_size=10,
    image_crop_x_min=40,
    image_crop_x_max=600,
    image_crop_y_min=150,
    image_crop_y_max=300,
    vt_match_threshold=0.085,
    vt_shift_match=5,
    vt_step_match=1,
    vt_normalisation=0.4,
    pc_dim_xy=30,
    pc_vt_inject_energy=0.15,
    pc_vt_restore=0.04,
    pc_cell_x_size=2.0,
    exp_delta_pc_threshold=1.0,
    exp_loops=20,
)
"""A car in the suburb of St Lucia, 2007."""

OXFORD: Final = RatSlamConfig(
    template_x_size=60,
    template_y_size=10,
    vt_match_threshold=0.054,
    vt_panoramic=True,
    vt_patch_normalise=2,
    pc_dim_xy=30,
    pc_vt_inject_energy=0.2,
    pc_cell_x_size=1.0,
    exp_loops=100,
)
"""Oxford New College: panoramic images."""

WHISKER: Final = RatSlamConfig(
    template_x_size=6,
    template_y_size=3,
    vt_match_threshold=0.002,
    vt_shift_match=0,
    vt_step_match=1,
    pc_dim_xy=21,
    pc_vt_inject_energy=0.02,
    pc_vt_restore=0.05,
    pc_cell_x_size=0.06,
    exp_delta_pc_threshold=1.0,
    exp_loops=20,
)
"""Eighteen whiskers in a maze of 180 mm cells: the pose-cell torus (1.26 m) spans the maze."""

PRESETS: Final[dict[str, RatSlamConfig]] = {
    "irat": IRAT,
    "st_lucia": ST_LUCIA,
    "oxford": OXFORD,
    "whisker": WHISKER,
}


def faithful(config: RatSlamConfig) -> RatSlamConfig:
    """The same parameters with OpenRatSLAM's defects reproduced."""
    return replace(config, faithful=True)
