import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.control.kinematics import (
    NOSE_HEIGHT,
    WHISKERS,
    GeometryError,
    HeadGeometry,
    paper_head,
    tip_height,
    tip_position,
    whisker_name,
)

HEAD = paper_head()
FIELDS = ("length", "pivot_radius", "pivot_height", "azimuth", "phi_start", "swing")


def changed(**changes: object) -> HeadGeometry:
    return HeadGeometry(**{name: changes.get(name, getattr(HEAD, name)) for name in FIELDS})


# ring: length, pivot radius, pivot z (mm), start phi, full phi, swing (deg), tip radius and height
TABLE = [
    (50, 20, 87, 50.2, 0.0, 50.2, (58, 20), (55, 37)),
    (110, 40, 107, 61.8, 23.3, 38.5, (137, 84), (55, 6)),
    (160, 60, 127, 63.3, 40.9, 22.4, (203, 165), (55, 6)),
]


@pytest.mark.parametrize("ring", range(3))
def test_paper_head_reproduces_the_table_of_the_papers_geometry(ring: int) -> None:
    length, radius, pivot, start, full, swing, radii, heights = TABLE[ring]
    at_rest = tip_position(HEAD, (0.0, 0.0, NOSE_HEIGHT, 0.0), 0.0)
    protracted = tip_position(HEAD, (0.0, 0.0, NOSE_HEIGHT, 0.0), HEAD.swing)
    for i in range(6 * ring, 6 * ring + 6):
        assert HEAD.length[i] * 1e3 == pytest.approx(length)
        assert HEAD.pivot_radius[i] * 1e3 == pytest.approx(radius)
        assert (NOSE_HEIGHT + HEAD.pivot_height[i]) * 1e3 == pytest.approx(pivot)
        assert math.degrees(HEAD.phi_start[i]) == pytest.approx(start, abs=0.05)
        assert math.degrees(HEAD.phi_start[i] - HEAD.swing[i]) == pytest.approx(full, abs=0.05)
        assert math.degrees(HEAD.swing[i]) == pytest.approx(swing, abs=0.051)
        assert math.degrees(HEAD.azimuth[i]) == pytest.approx(30 + 60 * (i % 6))
        for tips, r, h in zip((at_rest, protracted), radii, heights, strict=True):
            assert math.hypot(tips[i, 0], tips[i, 1]) * 1e3 == pytest.approx(r, abs=0.6)
            assert tips[i, 2] * 1e3 == pytest.approx(h, abs=1e-9)


def test_tip_height_is_the_height_of_the_tip_position() -> None:
    theta = HEAD.swing * np.linspace(0.0, 1.0, WHISKERS)
    tips = tip_position(HEAD, (0.3, -0.2, 0.12, 1.0), theta)
    assert np.array_equal(tip_height(HEAD, theta, 0.12), tips[:, 2])


@given(
    x=st.floats(-2, 2),
    y=st.floats(-2, 2),
    yaw=st.floats(-7, 7),
    share=st.floats(0, 1),
)
def test_moving_the_head_moves_the_tips_rigidly(
    x: float, y: float, yaw: float, share: float
) -> None:
    theta = HEAD.swing * share
    home = tip_position(HEAD, (0.0, 0.0, NOSE_HEIGHT, 0.0), theta)
    moved = tip_position(HEAD, (x, y, NOSE_HEIGHT, yaw), theta)
    c, s = math.cos(yaw), math.sin(yaw)
    expected = np.column_stack(
        [x + c * home[:, 0] - s * home[:, 1], y + s * home[:, 0] + c * home[:, 1], home[:, 2]]
    )
    assert np.allclose(moved, expected, rtol=0, atol=1e-12)


def test_whiskers_are_counted_counterclockwise_from_the_right_of_forward() -> None:
    tips = tip_position(HEAD, (0.0, 0.0, NOSE_HEIGHT, math.pi / 2), 0.0)  # facing north
    bearings = [math.degrees(math.atan2(tips[k, 1], tips[k, 0])) % 360 for k in range(6)]
    assert [round(b) % 360 for b in bearings] == [120, 180, 240, 300, 0, 60]


def test_protraction_lowers_every_tip() -> None:
    heights = [tip_height(HEAD, HEAD.swing * s, NOSE_HEIGHT) for s in np.linspace(0, 1, 50)]
    assert (np.diff(np.array(heights), axis=0) < 0.0).all()


def test_geometry_arrays_cannot_be_written() -> None:
    with pytest.raises(ValueError, match="read-only"):
        HEAD.length[0] = 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length": np.zeros(18)}, r"length: whisker 0 \(front ring\) is 0.0, expected > 0"),
        ({"azimuth": np.zeros(17)}, r"azimuth: expected 18 values, found shape \(17,\)"),
        ({"swing": np.full(18, np.nan)}, r"swing: whisker 0 \(front ring\) is nan"),
        ({"swing": HEAD.phi_start * 1.01}, r"swing: whisker 0 .* more than its phi_start"),
        ({"phi_start": np.full(18, 1.6)}, r"phi_start: whisker 0 .* expected in \(0, pi/2\]"),
        ({"pivot_radius": np.full(18, -0.1)}, r"pivot_radius: whisker 0 .* expected >= 0"),
    ],
)
def test_an_impossible_head_is_refused_by_name(change: dict[str, object], message: str) -> None:
    with pytest.raises(GeometryError, match=message) as refusal:
        changed(**change)
    assert "\n" not in str(refusal.value)


def test_whisker_names_tell_the_ring() -> None:
    assert [whisker_name(i) for i in (0, 7, 17)] == [
        "whisker 0 (front ring)",
        "whisker 7 (mid ring)",
        "whisker 17 (rear ring)",
    ]
