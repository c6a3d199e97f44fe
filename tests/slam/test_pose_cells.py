"""Pose cells: OpenRatSLAM's numbers, the torus, and the defects that are fixed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.slam import oracle
from vibrissa.slam import packet
from vibrissa.slam.config import IRAT, WHISKER, faithful
from vibrissa.slam.interface import SlamInputError
from vibrissa.slam.path_integration import integrate
from vibrissa.slam.pose_cells import PoseCellError, PoseCells

CELL = IRAT.pc_cell_x_size
SEQUENCES = {
    "irat": IRAT,
    "whisker_inject0.05": replace(IRAT, pc_vt_inject_energy=0.05),
    "irat_overspeed": IRAT,
    "stlucia": replace(
        IRAT,
        pc_dim_xy=30,
        pc_cell_x_size=2.0,
        pc_vt_inject_energy=0.15,
        pc_vt_restore=0.04,
        exp_delta_pc_threshold=1.0,
    ),
    "relrad": replace(IRAT, pc_dim_xy=10, pc_vt_inject_energy=0.2),
}


def sparse_states(text):
    """The '#...' sections of a vector file as (title, cells) pairs."""
    sections = []
    for line in text:
        if line.startswith("#"):
            sections.append((line[1:], np.zeros((36, 11, 11))))
        else:
            k, j, i, value = line.split(",")
            sections[-1][1][int(k), int(j), int(i)] = float(value)
    return sections


def settled(config, steps=60):
    cells = PoseCells(config)
    for _ in range(steps):
        cells.on_odo(0.0, 0.0, 1.0)
    return cells


def place(cells, activity):
    """Put a state into a network."""
    cells._box[:, packet.LENGTH] = 0
    for k, j, i in np.argwhere(activity).tolist():
        cells._add(k, j, i, float(activity[k, j, i]))


def integrated(activity, step, spin, exact):
    """One path integration of the compiled kernel."""
    cells = PoseCells(replace(IRAT, faithful=exact))
    place(cells, activity)
    work, box, n = cells._work, cells._box, activity.shape[1]
    work[packet.SPARE] = work[packet.STATE]
    motion = cells._motion[1 if step < 0.0 else 0]
    kept = (activity != 0.0).any(axis=(1, 2)).astype(np.uint8)
    integrate(work, box, kept, 0, 1.0, motion, abs(step), spin, cells._margin, n, exact)
    return cells.cells


def test_the_oracles_kernels_and_stages_equal_openratslam():
    for line in oracle.lines("pc_kernels")[1:]:
        name, k, j, i, weight = line.split(",")
        kernel = oracle.kernel(7, 1) if name == "E" else oracle.kernel(5, 2)
        assert kernel[int(k), int(j), int(i)] == pytest.approx(float(weight), abs=1e-15)
    states = [s for title, s in sparse_states(oracle.lines("pc_stages")[:-1]) if "state" in title]
    for found, expected in zip(oracle.stages(states[0], 2e-5), states[1:5], strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    moved = oracle.move(states[4], 0.009 / CELL, 0.11, corners=False)
    np.testing.assert_allclose(moved, states[5], atol=1e-12)


def test_one_iteration_equals_openratslams_stage_dump():
    text = oracle.lines("pc_stages")
    states = [s for title, s in sparse_states(text[:-1]) if "state" in title]
    best = [float(f.split("=")[1]) for f in text[-1].split()[1:]]
    cells = PoseCells(faithful(IRAT))
    place(cells, states[0])
    cells.on_odo(0.009, 0.11, 1.0)
    np.testing.assert_allclose(cells.cells, states[5], atol=1e-12)
    assert [*cells.best, cells.cells.max()] == pytest.approx(best, abs=1e-9)


def test_path_integration_equals_openratslam_in_67_cases():
    cases = 0
    text = oracle.lines("pc_pathint")[1:]
    starts = [n for n, line in enumerate(text) if line.startswith("#case")]
    for start, end in zip(starts, [*starts[1:], len(text)], strict=True):
        head = dict(f.split("=") for f in text[start].split()[2:] if "=" in f)
        expected = np.zeros((36, 11, 11))
        for line in text[start + 1 : end]:
            _, k, j, i, value = line.split(",")
            expected[int(k), int(j), int(i)] = float(value)
        activity = np.zeros((36, 11, 11))
        activity[int(head["k0"]), int(head["j0"]), int(head["i0"])] = 1.0
        step, angle = float(head["v"]) / CELL, float(head["w"])
        found = integrated(activity, step, angle * 36 / oracle.TAU, exact=True)
        np.testing.assert_allclose(found, expected, atol=1e-12)
        np.testing.assert_allclose(
            oracle.move(activity, step, angle, corners=False), expected, atol=1e-12
        )
        cases += 1
    assert cases == 67


@pytest.mark.parametrize("name", SEQUENCES)
def test_sequences_equal_openratslam(name):
    network = PoseCells(faithful(SEQUENCES[name]))
    snapshots = {}
    if name == "irat":
        for title, state in sparse_states(oracle.lines("pcseq_irat_states")):
            snapshots[int(title.rsplit("_", 1)[1])] = state
    for row, out in zip(
        oracle.table(f"pcseq_{name}_in"), oracle.table(f"pcseq_{name}_out"), strict=True
    ):
        n, v, w, dt, view, relative = row
        if view >= 0:
            network.on_view_template(int(view), relative)
        network.on_odo(v, w, dt)
        action = network.get_action()
        found = [*network.best, network.cells.max(), network.cells.sum()]
        np.testing.assert_allclose(found, out[1:6], atol=1e-9)
        assert (action.kind, network.experiences) == (int(out[6]), int(out[9]))
        if action.kind:
            assert (action.source, action.target) == (int(out[7]), int(out[8]))
        if int(n) in snapshots:
            np.testing.assert_allclose(network.cells, snapshots.pop(int(n)), atol=1e-9)
    assert not snapshots


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    step=st.floats(-1.0, 1.0),
    angle=st.floats(-7.0, 7.0),
    n=st.integers(5, 12),
)
def test_an_iteration_equals_the_plain_formulas(seed, step, angle, n):
    rng = np.random.default_rng(seed)
    config = replace(IRAT, pc_dim_xy=n)
    activity = np.zeros((36, n, n))
    for _ in range(4):
        k, j, i = rng.integers(0, (36, n, n))
        activity[k, j, i] += rng.random()
    network = PoseCells(config)
    place(network, activity)
    network.on_odo(step * CELL, angle, 1.0)
    expected = oracle.move(oracle.stages(activity, 2e-5)[3], step, angle, corners=True)
    np.testing.assert_allclose(network.cells, expected, atol=1e-12)


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("n", [11, 21])
def test_many_iterations_with_far_injections_equal_the_plain_formulas(n, exact):
    """Packets in several places, on the seams of the torus, and where the work box is closed."""
    config = replace(IRAT, pc_dim_xy=n, faithful=exact)
    network = PoseCells(config)
    rng = np.random.default_rng(n)
    expected = network.cells.copy()
    for number in range(12):
        if number % 3 == 0:
            k, j, i = rng.integers(0, (36, n, n))
            network._add(k, j, i, 0.3)
            expected[k, j, i] += 0.3
        step, angle = rng.uniform(-1, 1), rng.normal()
        network.on_odo(step * CELL, angle, 1.0)
        expected = oracle.move(oracle.stages(expected, 2e-5)[3], step, angle, corners=not exact)
        np.testing.assert_allclose(network.cells, expected, atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 24),
    layers=st.integers(1, 40),
    widths=st.tuples(st.sampled_from([1, 3, 5, 7, 9]), st.sampled_from([1, 3, 5, 7, 9])),
    step=st.floats(-1.0, 1.0),
    exact=st.booleans(),
)
def test_any_grid_and_any_kernels_equal_the_plain_formulas(seed, n, layers, widths, step, exact):
    """Grids smaller than the kernels, packets with gaps between them, boxes that open and close.

    In faithful mode also steps of more than a cell, which make activity negative.
    """
    step *= 2.5 if exact else 1.0
    rng = np.random.default_rng(seed)
    config = replace(
        IRAT,
        pc_dim_xy=n,
        pc_dim_th=layers,
        pc_w_e_dim=widths[0],
        pc_w_i_dim=widths[1],
        pc_w_i_var=3,
        faithful=exact,
    )
    network = PoseCells(config)
    expected = network.cells
    excite, inhibit = oracle.kernel(widths[0], 1), oracle.kernel(widths[1], 3)
    for number in range(5):
        if number % 2 == 0:
            k, j, i = rng.integers(0, (layers, n, n)).tolist()
            network._add(k, j, i, 0.5)
            expected[k, j, i] += 0.5
        angle = float(rng.normal())
        excited = oracle.convolve(expected, excite)
        left = excited - oracle.convolve(excited, inhibit)
        kept = np.where(left >= config.pc_global_inhib, left - config.pc_global_inhib, 0.0)
        if not kept.sum() > 1e-6:
            # nothing to compare: the network inhibits itself, or all that is left is rounding
            return
        expected = oracle.move(kept / kept.sum(), step, angle, corners=not exact)
        if (expected > 0.0).any():
            network.on_odo(step * CELL, angle, 1.0)
        else:
            with pytest.raises(PoseCellError, match="no activity left"):
                network.on_odo(step * CELL, angle, 1.0)
        np.testing.assert_allclose(network.cells, expected, atol=1e-12)


def test_the_read_out_equals_the_plain_formula():
    network = PoseCells(IRAT)
    rng = np.random.default_rng(7)
    for _ in range(200):
        network.on_odo(rng.uniform(-2, 2) * CELL, rng.normal(), 1.0)
        for found, expected, length in zip(
            network.best, oracle.read_out(network.cells), (11, 11, 36), strict=True
        ):
            assert (found - expected + length / 2) % length == pytest.approx(length / 2, abs=1e-9)


@settings(max_examples=15, deadline=None)
@given(
    shift=st.tuples(st.integers(0, 35), st.integers(0, 10), st.integers(0, 10)),
    step=st.floats(-1.0, 1.0),
    angle=st.floats(-3.0, 3.0),
)
def test_the_torus_has_no_special_place(shift, step, angle):
    """Moving a state and iterating commute; for headings, when the layers turn alike."""
    rng = np.random.default_rng(3)
    activity = np.zeros((36, 11, 11))
    activity[10:14, 2:6, 3:5] = rng.random((4, 4, 2))
    _, dj, di = shift
    here, there = PoseCells(IRAT), PoseCells(IRAT)
    place(here, activity)
    place(there, np.roll(activity, (dj, di), (1, 2)))
    for network in (here, there):
        network.on_odo(step * CELL, angle, 1.0)
    np.testing.assert_allclose(np.roll(here.cells, (dj, di), (1, 2)), there.cells, atol=1e-12)
    place(here, activity)
    place(there, np.roll(activity, shift, (0, 1, 2)))
    for network in (here, there):
        network.on_odo(0.0, angle, 1.0)
    np.testing.assert_allclose(np.roll(here.cells, shift, (0, 1, 2)), there.cells, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(
    steps=st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)), min_size=1, max_size=12)
)
def test_activity_is_conserved_and_never_negative(steps):
    network = PoseCells(IRAT)
    for step, angle in steps:
        network.on_odo(step * CELL, angle, 1.0)
        assert network.cells.min() >= 0.0
        assert network.cells.sum() == pytest.approx(1.0, abs=1e-12)


def test_corners_lose_activity_only_in_faithful_mode():
    corner = np.zeros((36, 11, 11))
    corner[0, 10, 0] = 1.0
    assert integrated(corner, 0.4, 0.0, exact=True).sum() == pytest.approx(0.6)
    fixed = integrated(corner, 0.4, 0.0, exact=False)
    assert fixed.sum() == pytest.approx(1.0)
    assert fixed[0, 0, 0] == pytest.approx(0.4)


def distance_moved(network, cells, steps):
    """Cells moved along +y in heading layer 0, unwrapped."""
    moved, y = 0.0, network.best[1]
    for _ in range(steps):
        network.on_odo(cells * network._config.pc_cell_x_size, 0.0, 1.0)
        new = network.best[1]
        moved += (new - y + 5.5) % 11.0 - 5.5
        y = new
    return moved


@pytest.mark.parametrize(
    ("cells", "original_ratio"), [(1.5, 0.844), (2.0, -0.647), (3.0, -0.792), (-2.0, -0.647)]
)
def test_a_long_step_is_split_where_the_original_aliases(cells, original_ratio):
    start = np.zeros((36, 11, 11))
    start[0, 5, 5] = 1.0
    ratios = []
    for config in (IRAT, faithful(IRAT)):
        network = PoseCells(config)
        place(network, start)
        for _ in range(50):
            network.on_odo(0.0, 0.0, 1.0)
        ratios.append(distance_moved(network, cells, 100) / (100 * cells))
        assert bool(network.cells.min() < 0.0) is config.faithful
    assert ratios[0] == pytest.approx(1.0, abs=0.01)
    assert ratios[1] == pytest.approx(original_ratio, abs=0.001)


def test_reverse_undoes_forward():
    network = settled(WHISKER)
    start = network.best
    for v in (0.03, -0.03):
        for _ in range(10):
            network.on_odo(v, 0.0, 1.0)
    assert network.best == pytest.approx(start, abs=0.05)


def test_the_newest_ten_views_never_inject_and_in_faithful_mode_the_first_nine_do():
    for config, few in ((IRAT, 0.0), (faithful(IRAT), 0.1 * (30 - np.exp(1.2)) / 30)):
        for count in (5, 9, 10, 11):
            network = PoseCells(config)
            for view in range(count):
                network.on_view_template(view)
            before = network.cells.sum()
            network.on_view_template(0)
            injected = network.cells.sum() - before
            expected = few if count < 10 else 0.0
            if count == 11:
                expected = 0.1 * (30 - np.exp(1.2)) / 30
            assert injected == pytest.approx(expected, abs=1e-12)


def test_habituation_lets_a_repeated_view_inject_twice():
    network = PoseCells(replace(WHISKER, pc_vt_inject_energy=0.1))
    for view in range(12):
        network.on_view_template(view)
    injected = []
    for _ in range(4):
        before = network.cells.sum()
        network.on_view_template(0)
        injected.append((network.cells.sum() - before) / 0.1)
    # the repetitions start from a habituation that has been restored by 0.05 each
    first, second = ((30 - np.exp(1.2 * d)) / 30 for d in (1.0, 2.0))
    assert injected == pytest.approx([first, second, 0.0, 0.0], abs=1e-9)
    for _ in range(60):
        network.on_view_template(11)
    before = network.cells.sum()
    network.on_view_template(0)
    assert network.cells.sum() - before == pytest.approx(0.1 * first, abs=1e-9)


def test_a_view_on_the_seam_of_the_torus_injects_unless_faithful():
    for config, injects in ((IRAT, True), (faithful(IRAT), False)):
        network = PoseCells(config)
        network._best[:] = (5.0, 5.0, 36.0)
        for view in range(12):
            network.on_view_template(view)
        before = network.cells.sum()
        network.on_view_template(0)
        assert bool(network.cells.sum() > before) is injects
        assert bool(network.cells[0, 5, 5] > 0.0) is injects


def test_a_view_on_a_cell_injects_there_whatever_the_last_bit_unless_faithful():
    for config, column in ((IRAT, 5), (faithful(IRAT), 4)):
        network = PoseCells(config)
        network._best[:] = (np.nextafter(5.0, 0.0), 5.0, 18.0)
        for view in range(12):
            network.on_view_template(view)
        place(network, np.zeros((36, 11, 11)))
        network.on_view_template(0)
        assert np.argwhere(network.cells).tolist() == [[18, 5, column]]


def test_a_kidnapped_packet_comes_back_after_enough_different_views():
    """Seven injections of 0.05 move a resting packet (OpenRatSLAM's count, fixed or faithful)."""
    for config in (IRAT, faithful(IRAT)):
        network = PoseCells(replace(config, pc_vt_inject_energy=0.05))
        network._best[:] = (1.0, 1.0, 4.0)
        for view in range(30):
            network.on_view_template(view)
        for _ in range(50):
            network._odo_update = False
            network.on_odo(0.0, 0.0, 1.0)
        jumped = 0
        for n in range(1, 15):
            network.on_view_template(n - 1)
            network.on_odo(0.0, 0.0, 1.0)
            if abs(network.best[0] - 1.0) < 1.0:
                jumped = n
                break
        assert jumped == 7


def test_a_step_that_cannot_be_integrated_changes_nothing():
    network = settled(IRAT)
    before, best = network.cells.copy(), network.best
    for v, w in ((1e6, 0.0), (float("nan"), 0.0), (0.0, 1e9), (0.0, float("nan"))):
        with pytest.raises(SlamInputError, match=r"odometry [vw]: expected at most"):
            network.on_odo(v, w, 1.0)
    assert (network.cells == before).all()
    assert network.best == best


def test_views_out_of_order_are_refused():
    network = PoseCells(IRAT)
    with pytest.raises(ValueError, match="view template: expected 0 to 0, found 1"):
        network.on_view_template(1)
    assert network.views == 0


def test_activity_that_dies_out_is_a_named_error():
    network = PoseCells(replace(IRAT, pc_global_inhib=0.5))
    with pytest.raises(PoseCellError, match="no activity left on the 11x11x36 grid"):
        network.on_odo(0.0, 0.0, 1.0)


@pytest.mark.parametrize("cells", [0.0, 1e-12, 1.0, 1e3])
def test_tiny_and_huge_steps_give_finite_packets(cells):
    network = settled(WHISKER)
    for sign in (1.0, -1.0):
        for angle in (0.0, np.pi, -np.pi, 1e-12, 1e3):
            network.on_odo(sign * cells * WHISKER.pc_cell_x_size, angle, 1.0)
            assert np.isfinite(network.cells).all()
            x, y, th = network.best
            assert 0.0 <= x < 21.0 and 0.0 <= y < 21.0 and 0.0 <= th < 36.0


def test_what_flat_loops_leave_around_the_box_stays_finite():
    """From there it once came into a packet that changed its extent, which then was lost."""
    draws = np.random.default_rng(0)
    cells = PoseCells(WHISKER)
    for _ in range(300):
        known = cells.views
        cells.on_view_template(known if known < 40 else int(draws.integers(known)))
        cells.on_odo(abs(draws.normal(0.01, 0.003)), draws.choice([0.0, 0.0, 0.3, -1.5]), 1.0)
        assert np.isfinite(cells._work[: packet.LINES]).all()


def test_a_hundred_thousand_iterations_keep_the_packet_whole():
    network = PoseCells(IRAT)
    for n in range(100):
        # 100 turns and moves, each in one call of 1000 sub-steps
        network.on_odo((-1) ** n * 1000.0 * CELL, 0.3, 1.0)
        assert network.cells.sum() == pytest.approx(1.0, abs=1e-12)
    assert 50 < np.count_nonzero(network.cells) < 1000
