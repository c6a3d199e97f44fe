"""RatSLAM as a whole: the end-to-end vectors, determinism, and cases that go wrong elsewhere."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.slam import oracle
from vibrissa.slam.config import IRAT, WHISKER, RatSlamConfig, faithful
from vibrissa.slam.interface import Odometry, Slam, SlamInputError
from vibrissa.slam.ratslam import RatSlam

RING = faithful(
    replace(
        IRAT,
        template_x_size=6,
        template_y_size=3,
        image_crop_y_max=-1,
        vt_shift_match=0,
        pc_vt_inject_energy=0.05,
        pc_cell_x_size=0.05,
    )
)


def lap(places, seed=0):
    """One image per place, and the odometry of a circle through them in 40 mm steps."""
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (places, 3, 6)).astype(np.uint8)
    return images, Odometry(0.04, oracle.TAU / places, 1.0)


def test_the_whole_chain_equals_openratslam():
    slam = RatSlam(RING)
    final = []
    for line in oracle.lines("e2e_ring_whisker")[1:]:
        if line.startswith("#"):
            if line.startswith("#e,"):
                final.append([float(f) for f in line.split(",")[2:]])
            continue
        f = [float(v) for v in line.split(",")]
        image = np.array(f[4:22], dtype=np.uint8).reshape(3, 6)
        step = slam.step(image, Odometry(f[1], f[2], f[3]))
        assert (step.template, step.action, step.experience) == (int(f[22]), int(f[27]), int(f[30]))
        assert step.match_error == (pytest.approx(f[23], abs=1e-9) if f[23] <= 1 else math.inf)
        assert [step.pc_x, step.pc_y, step.pc_th] == pytest.approx(f[24:27], abs=1e-9)
        current = slam.experience_map.poses[step.experience]
        np.testing.assert_allclose(current, f[31:34], atol=1e-9)
    np.testing.assert_allclose(slam.map().poses, final, atol=1e-9)
    links = oracle.table("e2e_ring_whisker_links")
    assert (slam.map().links == links[:, 1:3]).all()
    np.testing.assert_allclose(slam.experience_map.link_values(), links[:, 3:], atol=1e-9)


def test_it_stands_behind_the_interface():
    slam: Slam = RatSlam(WHISKER)
    step = slam.step(np.zeros((3, 6), np.uint8), Odometry(0.01, 0.0, 1.0))
    assert (step.template, step.new_template, step.experience, step.action) == (0, True, 0, 1)
    assert (step.experiences, step.templates) == (1, 1)
    found = slam.map()
    assert (found.poses.dtype, found.poses.shape) == (np.float64, (1, 3))
    assert (found.links.dtype, found.links.shape) == (np.int32, (0, 2))
    assert (found.templates.dtype, found.templates.tolist()) == (np.int32, [0])


def test_the_map_is_a_copy():
    slam = RatSlam(WHISKER)
    slam.step(np.zeros((3, 6), np.uint8), Odometry(0.01, 0.0, 1.0))
    slam.map().poses[:] = 99.0
    slam.map().templates[:] = 99
    assert slam.map().poses.max() < 99.0
    assert slam.map().templates.tolist() == [0]


def test_two_runs_give_the_same_bits():
    images, odometry = lap(30)
    runs = []
    for _ in range(2):
        slam = RatSlam(WHISKER)
        steps = [slam.step(image, odometry) for _ in range(4) for image in images]
        runs.append((steps, slam.map().poses.tobytes(), slam.pose_cells.cells.tobytes()))
    assert runs[0] == runs[1]


def test_a_ring_is_closed():
    """With odometry that turns 10 % too little, views bring the second lap back to the first."""
    images, odometry = lap(30)
    drifting = replace(odometry, w=0.9 * odometry.w)
    slam = RatSlam(replace(WHISKER, pc_vt_inject_energy=0.1))
    steps = [slam.step(image, drifting) for _ in range(6) for image in images]
    assert {s.action for s in steps[60:]} <= {1, 2}
    last = [s.experience for s in steps[-30:]]
    assert sum(s.action == 2 for s in steps[-30:]) >= 25
    assert min(last) < 60
    assert len(slam.local_view) == 30


def test_a_kidnapped_agent_relocalises_and_the_jump_is_not_in_its_odometry():
    images, odometry = lap(40)
    slam = RatSlam(replace(WHISKER, pc_vt_inject_energy=0.1))
    for _ in range(2):
        for image in images:
            slam.step(image, odometry)
    # carried from place 0 to place 20 between two steps
    after = [slam.step(image, odometry) for image in images[20:]]
    created = [s.action for s in after[:15]].count(1)
    assert created >= 1
    assert after[-1].action == 2
    assert after[-1].experience < 40


def test_driving_backwards_returns_to_the_experiences_of_the_way_out():
    rng = np.random.default_rng(3)
    images = rng.integers(0, 256, (20, 3, 6)).astype(np.uint8)
    slam = RatSlam(WHISKER)
    out = [slam.step(image, Odometry(0.03, 0.0, 1.0)) for image in images]
    start, far = out[0], out[-1]
    slam.step(images[-1], Odometry(-0.03, 0.0, 1.0))
    back = [slam.step(image, Odometry(-0.03, 0.0, 1.0)) for image in images[-2::-1]]
    assert math.hypot(back[-1].x - start.x, back[-1].y - start.y) < 0.1
    assert math.hypot(far.x - start.x, far.y - start.y) > 0.5
    assert back[-1].heading == pytest.approx(start.heading, abs=0.1)
    assert sum(s.action == 2 for s in back) >= 15


def test_a_long_step_injects_once_however_often_it_is_split():
    config = replace(WHISKER, pc_vt_inject_energy=0.1)
    slam = RatSlam(config)
    images = np.random.default_rng(1).integers(0, 256, (12, 3, 6)).astype(np.uint8)
    for image in images:
        slam.step(image, Odometry(0.0, 0.0, 1.0))
    energies = []
    inject = slam.pose_cells._inject
    slam.pose_cells._inject = lambda view, relative, energy: (
        energies.append(energy),
        inject(view, relative, energy),
    )
    slam.step(images[0], Odometry(0.3, 0.0, 1.0))
    assert len(energies) == 1


@pytest.mark.parametrize(
    ("image", "odometry", "message"),
    [
        (np.zeros((3, 7), np.uint8), Odometry(0.0, 0.0, 1.0), "image: expected shape"),
        (np.zeros((3, 6)), Odometry(0.0, 0.0, 1.0), "image: expected a uint8 array"),
        (np.zeros((3, 6), np.uint8), Odometry(1e9, 0.0, 1.0), "odometry v: expected at most"),
        (np.zeros((3, 6), np.uint8), Odometry(0.0, 1e9, 1.0), "odometry w: expected at most"),
    ],
)
def test_a_refused_step_changes_nothing(image, odometry, message):
    slam = RatSlam(WHISKER)
    good = np.full((3, 6), 7, np.uint8)
    slam.step(good, Odometry(0.01, 0.1, 1.0))
    cells, arrays = slam.pose_cells.cells.copy(), slam.experience_map.to_arrays()
    with pytest.raises(SlamInputError, match=message):
        slam.step(image, odometry)
    assert (slam.pose_cells.cells == cells).all()
    assert all((slam.experience_map.to_arrays()[k] == v).all() for k, v in arrays.items())
    assert len(slam.local_view) == 1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0.0, 0.0, 0.0), "odometry dt: expected a positive time in s, found 0.0"),
        ((0.0, 0.0, -1.0), "odometry dt: expected a positive"),
        ((math.nan, 0.0, 1.0), "odometry v: expected a finite number, found nan"),
        ((0.0, math.inf, 1.0), "odometry w: expected a finite number"),
        ((0.0, 0.0, math.nan), "odometry dt: expected a finite number"),
    ],
)
def test_impossible_odometry_is_refused_by_name(values, message):
    with pytest.raises(SlamInputError, match=message):
        Odometry(*values)


@pytest.mark.parametrize(
    ("level", "v", "w"), [(0, 0.0, 0.0), (255, 0.0, 0.0), (0, 0.01, 0.0), (0, 0.0, math.pi)]
)
def test_one_view_forever_stays_defined(level, v, w):
    slam = RatSlam(WHISKER)
    image = np.full((3, 6), level, np.uint8)
    for _ in range(500):
        step = slam.step(image, Odometry(v, w, 1.0))
    assert step.templates == 1
    numbers = (step.x, step.y, step.heading, step.pc_x, step.pc_y, step.pc_th)
    assert all(math.isfinite(n) for n in numbers)
    assert np.isfinite(slam.map().poses).all()
    if v == w == 0.0:
        assert step.experiences == 1


def test_blind_the_estimate_is_the_odometry_until_the_torus_comes_round():
    """Views that never change and motion below the torus: no loop can be claimed."""
    slam = RatSlam(WHISKER)
    image = np.zeros((3, 6), np.uint8)
    x = 0.0
    for _ in range(80):
        step = slam.step(image, Odometry(0.01, 0.0, 1.0))
        x += 0.01
        assert math.hypot(step.x, step.y) == pytest.approx(x, abs=1e-9)
        assert step.action != 2


def test_every_preset_runs_on_its_images():
    sizes = {"irat": (240, 416), "st_lucia": (480, 640), "oxford": (64, 128), "whisker": (3, 6)}
    from vibrissa.slam.config import PRESETS

    for name, config in PRESETS.items():
        assert isinstance(config, RatSlamConfig)
        slam = RatSlam(config)
        rng = np.random.default_rng(0)
        for _ in range(3):
            image = rng.integers(0, 256, (*sizes[name], 3)).astype(np.uint8)
            step = slam.step(image, Odometry(config.pc_cell_x_size, 0.1, 1.0))
        assert step.experiences >= 1
