"""Parameters: names, defaults, files and refusals."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vibrissa.slam.config import (
    IRAT,
    OXFORD,
    PRESETS,
    WHISKER,
    ConfigError,
    RatSlamConfig,
    faithful,
    parse_config,
)

IRAT_FILE = """
[general]
topic_root=irat_red

[ratslam]
image_crop_y_max=150
template_x_size=60
template_y_size=20
vt_shift_match = 4
vt_step_match = 1
vt_match_threshold = 0.03
vt_active_decay = 1.0

pc_dim_xy = 11
pc_vt_inject_energy = 0.1
pc_cell_x_size = 0.015

exp_delta_pc_threshold = 2
exp_loops=20
exp_initial_em_deg=140

[draw]
enable=1
media_path=../src/media
"""


def test_an_openratslam_file_reads_as_the_preset():
    assert parse_config(IRAT_FILE) == IRAT


def test_a_bare_section_and_comments_are_read():
    text = "# Oxford\ntemplate_x_size=60\ntemplate_y_size=10\nvt_panoramic=1 ; wraps\n"
    config = parse_config(text + "vt_patch_normalise=2\nvt_match_threshold=0.054\n"
                          "pc_dim_xy=30\npc_vt_inject_energy=0.2\nexp_loops=100")  # fmt: skip
    assert config == OXFORD


def test_overrides_repair_a_file_that_leaves_the_default_shift():
    text = "[ratslam]\ntemplate_x_size=6\ntemplate_y_size=3\n"
    with pytest.raises(ConfigError, match="vt_shift_match: a shift of 25 leaves no columns"):
        parse_config(text)
    config = parse_config(text, {"vt_shift_match": 0})
    assert (config.template_x_size, config.vt_shift_match) == (6, 0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[ratslam]\nvt_shift_mach=4", r"\[ratslam\] vt_shift_mach: unknown parameter"),
        ("[ratslam]\npc_dim_xy=11.5", r"\[ratslam\] pc_dim_xy: expected int, found '11.5'"),
        ("[ratslam]\npc_cell_x_size=wide", "pc_cell_x_size: expected float, found 'wide'"),
        ("[ratslam]\nvt_panoramic=yes please", "vt_panoramic: expected bool"),
        ("[general]\ntopic_root=x", r"expected a section \[ratslam\]"),
        ("[ratslam]\npc_dim_xy=3\npc_dim_xy=4", "configuration text: .*already exists"),
        ("[ratslam\npc_dim_xy=3", "configuration text: "),
    ],
)
def test_what_is_wrong_with_a_file_is_named_in_one_line(text, message):
    with pytest.raises(ConfigError, match=message) as caught:
        parse_config(text)
    assert "\n" not in str(caught.value)


def test_unknown_override_is_named():
    with pytest.raises(ConfigError, match="pc_dim_z: unknown parameter"):
        parse_config(IRAT_FILE, {"pc_dim_z": 3})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("pc_dim_xy", 0),
        ("pc_dim_th", -1),
        ("pc_cell_x_size", 0.0),
        ("pc_cell_x_size", float("nan")),
        ("pc_w_e_dim", 6),
        ("pc_vt_inject_energy", -0.1),
        ("vt_match_threshold", float("inf")),
        ("vt_step_match", 0),
        ("exp_loops", -1),
        ("image_crop_x_max", 0),
        ("template_x_size", 6.0),
        ("pc_dim_xy", True),
        ("vt_panoramic", 1),
        ("vt_shift_match", 3),
    ],
)
def test_a_value_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=f"^{name}: ") as caught:
        replace(WHISKER, **{name: value})
    assert "\n" not in str(caught.value)


def test_openratslams_own_defaults_leave_nothing_to_compare():
    with pytest.raises(ConfigError, match="vt_shift_match"):
        RatSlamConfig()
    assert RatSlamConfig(faithful=True).columns_compared == -49


def test_presets_differ_from_their_faithful_versions_in_one_switch_only():
    for preset in PRESETS.values():
        assert replace(faithful(preset), faithful=False) == preset
