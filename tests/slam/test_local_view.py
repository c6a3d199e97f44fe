"""Local view: OpenRatSLAM's numbers, and a search that finds what exhaustive search finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.slam import oracle
from vibrissa.slam.config import IRAT, OXFORD, ST_LUCIA, WHISKER, RatSlamConfig, faithful
from vibrissa.slam.interface import SlamInputError
from vibrissa.slam.local_view import LocalView

UNCROPPED = {
    "image_crop_x_min": 0,
    "image_crop_x_max": -1,
    "image_crop_y_min": 0,
    "image_crop_y_max": -1,
}
VECTORS = {
    "whisker6x3_shift0": replace(WHISKER, vt_match_threshold=0.03),
    "plain60x20_shift4": replace(IRAT, **UNCROPPED),
    "norm60x10_shift5_rgb120x20": replace(ST_LUCIA, **UNCROPPED),
    "panoramic60x10_patch2": OXFORD,
}


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("name", VECTORS)
def test_templates_ids_and_errors_equal_openratslam(name, exact):
    text = oracle.lines(f"lv_{name}")
    width, height, channels = (
        int(text[0].split(key + "=")[1].split()[0]) for key in ("W", "H", "channels")
    )
    shape = (height, width) if channels == 1 else (height, width, channels)
    view = LocalView(replace(VECTORS[name], faithful=exact))
    for line in text[1:]:
        fields = line.split(",")
        if line.startswith("#t,"):
            values = np.array(fields[3:], dtype=np.float64)
            np.testing.assert_allclose(view.templates[int(fields[1])].ravel(), values, atol=1e-9)
            continue
        if line.startswith("#"):
            continue
        image = np.array(fields[6:], dtype=np.uint8).reshape(shape)
        found = view.on_image(image)
        assert (found.template, len(view)) == (int(fields[1]), int(fields[5]))
        error = float(fields[2])
        assert found.error == pytest.approx(error, rel=1e-9, abs=1e-9)
        assert found.mean == pytest.approx(float(fields[3]), abs=1e-9)
        assert found.relative_rad == pytest.approx(float(fields[4]), abs=1e-9)


def expected_ids(config, images):
    """Ids and errors by exhaustive search over the templates the local view itself built."""
    builder = LocalView(config)
    for image in images:
        before = builder.templates.copy()
        found = builder.on_image(image)
        view = LocalView(config)
        view.on_image(image)
        template = view.templates[0]
        number, cost, shift = oracle.match(
            template,
            before,
            config.vt_match_threshold + 0.005,
            0 if config.vt_panoramic else config.vt_shift_match,
            config.vt_step_match,
            config.vt_panoramic,
        )
        compared = config.columns_compared * config.template_y_size
        yield found, number, cost / compared, shift


CONFIGS = {
    "whisker": replace(WHISKER, vt_match_threshold=0.05),
    "blocks": replace(WHISKER, vt_match_threshold=0.05),
    "large": RatSlamConfig(
        template_x_size=20, template_y_size=8, vt_shift_match=2, vt_step_match=1
    ),
    "large, step 3": RatSlamConfig(
        template_x_size=20, template_y_size=7, vt_shift_match=3, vt_step_match=3
    ),
    "single pixel": replace(WHISKER, template_x_size=1, template_y_size=1),
    "shifted": RatSlamConfig(
        template_x_size=9, template_y_size=2, vt_shift_match=3, vt_step_match=2
    ),
    "panoramic": RatSlamConfig(
        template_x_size=8, template_y_size=3, vt_panoramic=True, vt_step_match=1
    ),
}


@pytest.mark.parametrize("name", CONFIGS)
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), levels=st.sampled_from([2, 3, 20, 256]))
def test_search_finds_what_exhaustive_search_finds(name, seed, levels):
    config = CONFIGS[name]
    rng = np.random.default_rng(seed)
    # more than one pixel to a block makes means that are no whole bytes
    block = 3 if name in ("blocks", "large") else 1
    shape = (40, block * config.template_y_size, block * config.template_x_size)
    images = (rng.integers(0, levels, shape) * (255 // (levels - 1))).astype(np.uint8)
    images[20:] = np.clip(images[:20].astype(int) + rng.integers(-9, 10, shape)[:20], 0, 255)
    for found, number, error, _ in expected_ids(config, images):
        if number < 0 or error > config.vt_match_threshold:
            assert found.new
        else:
            assert (found.template, found.new) == (number, False)
        if number >= 0:
            assert found.error == error


def test_search_over_thousands_of_templates_of_equal_mean_is_exact():
    config = replace(WHISKER, vt_match_threshold=0.0)
    rng = np.random.default_rng(1)
    base = rng.integers(0, 256, 18).astype(np.uint8)
    images = np.array([rng.permutation(base) for _ in range(2000)]).reshape(-1, 3, 6)
    view = LocalView(config)
    for image in images:
        view.on_image(image)
    templates = view.templates.copy()
    for image in images[::97]:
        query = rng.permutation(image.ravel()).reshape(3, 6)
        mine = LocalView(config)
        mine.on_image(query)
        number, cost, _ = oracle.match(mine.templates[0], templates, 0.005, 0, 1, False)
        found = view.nearest(mine.templates[0], float(mine.templates[0].mean()))
        assert (found[0], found[1]) == (number, cost / 18)


@pytest.mark.parametrize("wide", [False, True])
def test_search_among_look_alikes_is_exact(wide):
    """Templates that differ by less than a byte, where rounding must not decide."""
    rows, columns = (10, 30) if wide else (3, 6)
    config = replace(
        WHISKER, template_x_size=columns, template_y_size=rows, vt_match_threshold=0.01
    )
    rng = np.random.default_rng(2)
    base = rng.random((rows, columns))
    view = LocalView(config)
    for _ in range(300):
        view.add(np.clip(base + rng.normal(0, 1e-3, (rows, columns)), 0.0, 1.0))
    for _ in range(20):
        query = np.clip(base + rng.normal(0, 1e-3, (rows, columns)), 0.0, 1.0)
        number, cost, _ = oracle.match(query, view.templates, 0.015, 0, 1, False)
        found = view.nearest(query, float(query.mean()))
        assert (found[0], found[1]) == (number, cost / query.size)


def test_a_uniform_search_ties_go_to_the_lowest_id():
    view = LocalView(replace(WHISKER, vt_match_threshold=0.0))
    dark, bright = np.zeros((3, 6), np.uint8), np.full((3, 6), 2, np.uint8)
    assert view.on_image(bright).template == 0
    assert view.on_image(dark).template == 1
    between = view.on_image(np.ones((3, 6), np.uint8))
    assert (between.template, between.new) == (2, True)
    wide = LocalView(replace(WHISKER, vt_match_threshold=0.005))
    for level in (6, 3):
        wide.on_image(np.full((3, 6), level, np.uint8))
    found = wide.on_image(np.full((3, 6), 5, np.uint8))
    assert (found.template, found.new) == (0, False)


def test_black_and_white_images_are_two_places():
    for config in (WHISKER, OXFORD):
        view = LocalView(config)
        shape = (config.template_y_size, config.template_x_size)
        ids = [view.on_image(np.full(shape, v, np.uint8)).template for v in (0, 255, 0, 255)]
        assert ids == ([0, 1, 0, 1] if config is WHISKER else [0, 0, 0, 0])
        assert np.isfinite(view.templates).all()


def test_a_flat_patch_is_grey_and_not_decided_by_rounding():
    config = replace(OXFORD, template_x_size=10, template_y_size=10)
    image = np.full((20, 20), 100, np.uint8)
    fixed, original = LocalView(config), LocalView(faithful(config))
    fixed.on_image(image)
    original.on_image(image)
    assert (fixed.templates == 0.5).all()
    assert np.isfinite(original.templates).all()


def test_no_template_inherits_from_the_image_before():
    view = LocalView(replace(WHISKER, vt_match_threshold=0.0))
    view.on_image(np.full((3, 6), 255, np.uint8))
    assert view.on_image(np.zeros((3, 6), np.uint8)).mean == 0.0


def test_a_shift_that_leaves_no_columns_matches_template_0_only_in_faithful_mode():
    rng = np.random.default_rng(5)
    images = rng.integers(100, 130, (6, 3, 6)).astype(np.uint8)
    original = LocalView(RatSlamConfig(template_x_size=6, template_y_size=3, faithful=True))
    found = [original.on_image(image) for image in images]
    assert [f.template for f in found] == [0] * 6
    assert all(f.error == 0.0 and np.signbit(f.error) for f in found[1:])
    fixed = LocalView(WHISKER)
    assert [fixed.on_image(image).template for image in images] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((3, 6)), "expected a uint8 array, found float64"),
        (np.full((3, 6), np.nan), "expected a uint8 array"),
        ([[0] * 6] * 3, "expected a uint8 array, found list"),
        (np.zeros((3, 6, 2), np.uint8), r"expected shape .*found \(3, 6, 2\)"),
        (np.zeros(18, np.uint8), r"expected shape .*found \(18,\)"),
        (np.zeros((6, 12), np.uint8), r"expected shape \(3, 6\) as before"),
    ],
)
def test_a_wrong_image_is_refused_before_anything_changes(image, message):
    view = LocalView(WHISKER)
    view.on_image(np.zeros((3, 6), np.uint8))
    with pytest.raises(SlamInputError, match=message):
        view.on_image(image)
    assert len(view) == 1


def test_an_image_smaller_than_template_or_crop_is_refused():
    with pytest.raises(SlamInputError, match="expected at least 3 rows and 6 columns"):
        LocalView(WHISKER).on_image(np.zeros((2, 6), np.uint8))
    with pytest.raises(SlamInputError, match="expected at least 150 rows"):
        LocalView(IRAT).on_image(np.zeros((100, 60), np.uint8))
    with pytest.raises(SlamInputError, match="crop has 2 rows"):
        LocalView(replace(WHISKER, image_crop_y_max=2)).on_image(np.zeros((3, 6), np.uint8))
