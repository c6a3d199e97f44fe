"""What no rig should do, done to the simulated one: defined results or named errors, never NaN."""

import math

import numpy as np
import pytest

from vibrissa.control.kinematics import (
    NOSE_HEIGHT,
    WHISKERS,
    GeometryError,
    HeadGeometry,
    paper_head,
)
from vibrissa.rig import rows as h
from vibrissa.rig.maze_random import random_maze
from vibrissa.rig.plant import HeadPlant, HeadPlantParams, PlantError
from vibrissa.rig.scene import wall_boxes

WALLS_EVERYWHERE = wall_boxes(random_maze(6, 5, 1, ring_walls=1.0, inner_walls=1.0))
MOST = 0.2  # N m: far above what any whisker can bear, far below a runaway


def whisk(plant: HeadPlant, tick: int, period: int = 2000) -> np.ndarray:
    share = (1 - math.cos(2 * math.pi * tick / period)) / 2
    return (share * plant.params.geometry.swing).astype(np.float32)


def assert_sound(plant: HeadPlant, samples, most: float = MOST) -> None:
    assert np.isfinite(plant.state).all()
    for values in samples:
        assert np.isfinite(values).all()
    low = -plant.params.stop_margin - 1e-12
    high = plant.params.geometry.swing + plant.params.stop_margin + 1e-12
    assert (plant.state[h.THETA] >= low).all() and (plant.state[h.THETA] <= high).all()
    assert np.abs(plant.state[h.MOMENT_X : h.MOMENT_Y + 1]).max() < most


@pytest.mark.parametrize("start", [(0.18, 0.27), (0.2, 0.181), (0.36, 0.36), (0.55, 0.45)])
def test_whiskers_that_start_inside_a_wall_get_out_of_it(start) -> None:
    plant = HeadPlant(WALLS_EVERYWHERE, 1)
    low = plant.params.geometry.swing.astype(np.float32)
    plant.state[h.THETA] = plant.state[h.COMMAND] = plant.params.geometry.swing
    plant.state[h.PSI] = plant.params.geometry.phi_start - plant.params.geometry.swing
    for t in range(400):
        samples = plant.step(t, (*start, NOSE_HEIGHT, 0.3), low)
        assert_sound(plant, samples)
    touching = (plant.state[h.PEG] >= 0) | (plant.state[h.SIDE] != 0)
    assert touching.any()
    for t in range(400, 1400):
        raised = (*start, NOSE_HEIGHT + 1e-4 * (t - 400), 0.3)
        samples = plant.step(t, raised, np.zeros(WHISKERS, dtype=np.float32))
    assert_sound(plant, samples)
    assert (plant.state[h.PEG] == -1).all() and (plant.state[h.SIDE] == 0).all()
    assert not plant.state[h.MOMENT_X : h.MOMENT_Y + 1].any()


def test_hundred_times_the_usual_speed_is_survived() -> None:
    plant = HeadPlant(WALLS_EVERYWHERE, 1)
    for t in range(4000):
        s = 4.0 * t * 0.0005
        pose = (0.54 + 0.4 * math.sin(s * 5), 0.45 + 0.3 * math.cos(s * 7), NOSE_HEIGHT, 30 * s)
        assert_sound(plant, plant.step(t, pose, whisk(plant, t, period=20)))


@pytest.mark.parametrize("servo", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("modulus", [1e6, 1e9, 1e12])
def test_six_decades_of_stiffness_stay_sound(servo: float, modulus: float) -> None:
    params = HeadPlantParams(
        servo_stiffness=servo, shaft_modulus=modulus, sensor_noise=0.0, sensor_full_scale=10.0
    )
    plant = HeadPlant(WALLS_EVERYWHERE, 1, params)
    most = MOST * max(modulus / 3e9, 1.0) * 100
    last = np.zeros(WHISKERS)
    for t in range(3000):
        pose = (0.5 + 0.05 * t * 0.0005, 0.41, NOSE_HEIGHT, 0.2)
        theta, x, y = plant.step(t, pose, whisk(plant, t))
        assert_sound(plant, (theta, x, y), most)
    # A soft motor against a stiff whisker comes to rest at the wall; it does not hammer.
    hold = whisk(plant, 700)
    for t in range(3000, 5000):
        theta, _, _ = plant.step(t, pose, hold)
        if t > 4900:
            assert np.abs(plant.state[h.THETA] - last).max() < 1e-4
        last = plant.state[h.THETA].copy()


@pytest.mark.parametrize("beam", ["linear", "table"])
def test_walls_everywhere_and_a_wandering_head_stay_sound(beam: str) -> None:
    plant = HeadPlant(WALLS_EVERYWHERE, 3, HeadPlantParams(beam=beam))
    contact = 0
    for t in range(12000):
        s = t * 0.0005
        pose = (0.5 + 0.3 * math.sin(0.7 * s), 0.45 + 0.2 * math.sin(1.1 * s), NOSE_HEIGHT, s)
        samples = plant.step(t, pose, whisk(plant, t))
        if t % 50 == 0:
            assert_sound(plant, samples)
            contact += int((plant.state[h.PEG] >= 0).sum())
    assert contact > 500


def test_long_rest_leaves_nothing_that_grows_and_no_subnormal_number() -> None:
    plant = HeadPlant(WALLS_EVERYWHERE, 1, HeadPlantParams(sensor_noise=0.0, encoder_noise=0.0))
    for t in range(2000):
        plant.step(t, (0.5, 0.41, NOSE_HEIGHT, 0.0), whisk(plant, t))
    hold = whisk(plant, 600)
    for t in range(2000, 14000):
        samples = plant.step(t, (0.5, 0.41, NOSE_HEIGHT, 0.0), hold)
    assert_sound(plant, samples)
    small = np.abs(plant.state[plant.state != 0])
    assert small.min() > 1e-300
    still = plant.state.copy()
    for t in range(14000, 14100):
        plant.step(t, (0.5, 0.41, NOSE_HEIGHT, 0.0), hold)
    assert plant.state.tobytes() == still.tobytes()


def with_lengths(length: float) -> HeadGeometry:
    g = paper_head()
    return HeadGeometry(
        np.full(WHISKERS, length), g.pivot_radius, g.pivot_height, g.azimuth, g.phi_start, g.swing
    )


def test_shafts_without_length_or_thickness_are_refused() -> None:
    with pytest.raises(GeometryError, match="length"):
        with_lengths(0.0)
    for change, word in (
        ({"geometry": with_lengths(1e-6)}, "length"),
        ({"geometry": with_lengths(3.0)}, "length"),
        ({"shaft_base_diameter": (1e-6, 1e-3, 1e-3)}, "shaft_base_diameter"),
        ({"shaft_tip_diameter": (0.0, 4e-4, 4e-4)}, "shaft_tip_diameter"),
    ):
        with pytest.raises(PlantError, match=word) as error:
            HeadPlantParams(**change)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("length", [0.005, 0.05, 0.6])
def test_shortest_and_longest_and_thinnest_shafts_are_defined(length: float) -> None:
    params = HeadPlantParams(
        geometry=with_lengths(length),
        shaft_base_diameter=(1e-4, 1e-3, 1e-2),
        shaft_tip_diameter=(1e-5, 1e-3, 1e-3),
        sensor_full_scale=10.0,
    )
    plant = HeadPlant(WALLS_EVERYWHERE, 1, params)
    for t in range(3000):
        pose = (0.5 + 0.02 * t * 0.0005, 0.42, NOSE_HEIGHT, 0.5)
        assert_sound(plant, plant.step(t, pose, whisk(plant, t)), most=1e3)
