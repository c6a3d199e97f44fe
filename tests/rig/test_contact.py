"""The geometry of contact: box and shaft, seen in the whisking plane and across it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrissa.rig.beam import EXACT, TABLE, beam_tables
from vibrissa.rig.contact import (
    FREE,
    ON_EDGE,
    ON_FACE,
    PAST,
    across_edge,
    clearance,
    from_above,
    from_inside,
    side_extent,
    slice_box,
    wall_angles,
    wall_side,
)
from vibrissa.rig.elastica import STEPS, tip_contact

LENGTH, TAPER, DROP = 0.11, (1 - 0.4 / 1.3) / 0.11, 0.057
TABLES = beam_tables((0.4 / 1.3,), 49)
BOX = np.array([[-0.1, 0.12, -0.006, 0.006, 0.05]])


def test_far_edge_in_reach_is_a_peg_and_out_of_reach_the_tip_lands_on_top() -> None:
    _, outer = wall_angles(LENGTH, DROP, 0.060, 0.072)
    assert outer == pytest.approx(math.atan2(0.072, DROP))
    inner, outer = wall_angles(LENGTH, DROP, 0.085, 0.097)
    assert outer == pytest.approx(math.acos(DROP / LENGTH))
    assert inner == pytest.approx(math.asin(0.085 / LENGTH))
    inner, outer = wall_angles(LENGTH, DROP, 0.095, 0.107)
    assert inner > outer


@given(
    st.floats(0.03, 0.2),
    st.floats(0.001, 0.15),
    st.floats(0.0, 0.15),
    st.floats(0.001, 0.1),
    st.floats(-0.3, 1.8),
)
def test_side_of_a_wall_is_told_as_by_its_angles(chord, drop, near, thickness, psi) -> None:
    inner, outer = wall_angles(chord, drop, near, near + thickness)
    found = wall_side(chord, drop, near, near + thickness, math.sin(psi), math.cos(psi))
    if inner > outer:
        assert found == 2
    elif min(abs(psi - inner), abs(psi - outer)) > 1e-9:
        assert found == (1 if psi > outer else -1 if psi < inner else 0)


def above(phi, near, far, on_face=False, ux=1.0, uy=0.0, form=TABLE):
    s, c = math.sin(phi), math.cos(phi)
    return from_above(
        form, TABLES, 1, TAPER, LENGTH, phi, s, c, DROP, near, far, True, ux, uy, on_face
    )


def inside(phi, near, ux=1.0, uy=0.0, form=TABLE):
    s, c = math.sin(phi), math.cos(phi)
    return from_inside(form, TABLES, 1, TAPER, LENGTH, phi, s, c, DROP, near, True, ux, uy)


def test_whisker_coming_down_meets_the_edge_then_slips_onto_the_top_and_past_it() -> None:
    seen = []
    moments = []
    on_face = False
    for phi in np.arange(1.05, 0.0, -1e-3):
        what, angle, y, x = above(phi, 0.078, 0.090, on_face)
        on_face = what == ON_FACE
        assert x == 0.0 and (angle > phi) == (what in (ON_EDGE, ON_FACE))
        moments.append(y)
        if not seen or seen[-1] != what:
            seen.append(what)
        if what == PAST:
            break
    assert seen == [FREE, ON_EDGE, ON_FACE, PAST]
    # On the edge and on the top the moment grows without a jump; slipping onto it takes some away.
    assert (np.diff(moments)[:-1] > 5e-2 * max(moments)).sum() == 0


def test_whisker_coming_up_behind_a_wall_is_held_by_its_face_and_comes_free() -> None:
    near = 0.085
    seen, moments = [], []
    for phi in np.arange(0.6, 1.5, 1e-3):
        what, _, y, x = inside(phi, near)
        assert x == 0.0 and y <= 0.0
        moments.append(-y)
        if not seen or seen[-1] != what:
            seen.append(what)
        if what == PAST:
            break
    assert seen == [FREE, ON_FACE, PAST]
    assert np.abs(np.diff(moments)[:-1]).max() < 0.02 * max(moments)
    # Bent by the face, the tip lags far behind the straight shaft: it rises over the wall's top at
    # the angle at which the exact solution has it there.
    last, next_ = (
        tip_contact(1 - TAPER * LENGTH, near / LENGTH, math.pi / 2 - angle, STEPS)[1] * LENGTH
        for angle in (phi - 2e-3, phi)
    )
    assert last > DROP and next_ < DROP + 1e-5


def test_contact_close_to_the_pivot_passes_from_face_to_edge_without_a_jump() -> None:
    for ux in (1.0, 0.8):
        uy = -math.sqrt(1 - ux * ux)
        found = [inside(phi, 0.020, ux, uy) for phi in np.arange(0.2, 1.0, 5e-4)]
        what = [entry[0] for entry in found]
        assert PAST not in what[what.index(ON_FACE) :]
        held = [entry for entry in found if entry[0] in (ON_FACE, ON_EDGE)]
        assert ON_FACE in what and ON_EDGE in what
        force = np.hypot([entry[2] for entry in held], [entry[3] for entry in held])
        assert np.abs(np.diff(force)).max() < 0.03 * force.max()


@pytest.mark.parametrize("phi", [0.95, 0.85, 0.80])
def test_exact_form_gives_the_same_contact(phi: float) -> None:
    fast, exact = above(phi, 0.060, 0.075), above(phi, 0.060, 0.075, form=EXACT)
    assert fast[0] == exact[0] and fast[2] == pytest.approx(exact[2], rel=1e-3, abs=1e-9)
    fast, exact = inside(phi, 0.070), inside(phi, 0.070, form=EXACT)
    assert fast[0] == exact[0] and fast[2] == pytest.approx(exact[2], rel=2e-3, abs=1e-9)


def test_oblique_wall_pushes_to_the_side_and_mirrored_walls_to_the_other() -> None:
    straight = above(0.80, 0.060, 0.075)
    _, _, y, x = above(0.80, 0.060, 0.075, ux=0.9, uy=math.sqrt(1 - 0.81))
    _, _, mirrored_y, mirrored_x = above(0.80, 0.060, 0.075, ux=0.9, uy=-math.sqrt(1 - 0.81))
    assert (y, x) == (mirrored_y, -mirrored_x)
    assert 0 < y < straight[2] and x < 0
    assert math.hypot(y, x) < straight[2]


def test_edge_across_the_plane_is_where_it_is_seen() -> None:
    distance, gamma, w = across_edge(0.075, DROP, math.sin(0.7), math.cos(0.7), 1.0)
    assert w == pytest.approx(1.0)
    assert distance == pytest.approx(math.hypot(0.075, DROP))
    assert gamma == pytest.approx(math.atan2(0.075, DROP) - 0.7)


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-math.pi, math.pi))
def test_clearance_is_never_more_than_the_distance(px: float, py: float, heading: float) -> None:
    ux, uy = math.cos(heading), math.sin(heading)
    bound = clearance(BOX, 0, px, py, ux, uy, 0.16)
    u = np.linspace(0.0, 0.16, 200)
    x, y = px + u * ux, py + u * uy
    gap_x = np.maximum(np.maximum(BOX[0, 0] - x, x - BOX[0, 1]), 0)
    gap_y = np.maximum(np.maximum(BOX[0, 2] - y, y - BOX[0, 3]), 0)
    assert bound <= np.hypot(gap_x, gap_y).min() + 1e-12


@given(st.floats(-math.pi, math.pi), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_slice_is_the_part_of_the_ray_inside_the_box(heading: float, px: float, py: float) -> None:
    box = BOX[0]
    ux, uy = math.cos(heading), math.sin(heading)
    near, far, _, _ = slice_box(BOX, 0, px, py, ux, uy)
    for u in np.linspace(0.0005, 0.4995, 200):
        x, y = px + u * ux, py + u * uy
        depth = min(x - box[0], box[1] - x, y - box[2], box[3] - y)
        if abs(depth) > 1e-9:
            assert (near < u < far) == (depth > 0)


def test_side_extent_of_a_wall_along_the_plane() -> None:
    box = np.array([[0.05, 0.5, -0.002, 0.010, 0.05]])
    left, _, right, _ = side_extent(box, 0, 0.0, 0.0, 1.0, 0.0, 0.03, 0.12)
    assert (left, right) == pytest.approx((0.010 / 0.05, -0.002 / 0.05))
    assert side_extent(box, 0, 0.0, 0.0, 1.0, 0.0, 0.01, 0.04) == (0.0, 0.0, 0.0, 0.0)
    left, _, right, _ = side_extent(box, 0, 0.0, -0.1, 1.0, 0.0, 0.03, 0.12)
    assert (left, right) == pytest.approx((0.110 / 0.05, 0.098 / 0.12))
