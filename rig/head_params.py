"""What the simulated head is made of, and the arrays made of that for the compiled step."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vibrissa.control.kinematics import WHISKERS, HeadGeometry, paper_head, ring_of
from vibrissa.numerics import cos, sin
from vibrissa.rig import rows
from vibrissa.rig.beam import FORMS, beam_tables
from vibrissa.rig.beam_table import SIZE
from vibrissa.rig.head import HeadModel
from vibrissa.rig.modes import second_order_step
from vibrissa.rig.scene import build_scene
from vibrissa.rig.sensing import DRIFT_TICKS
from vibrissa.rig.whisker import shaft_table

Float64s = NDArray[np.float64]


class PlantError(ValueError):
    """A parameter or an input that the plant refuses; nothing has changed."""


def check_range(where: str, name: str, value: float, low: float, high: float, unit: str) -> None:
    if not low <= value <= high:
        raise PlantError(f"{where}.{name}: expected {low} to {high} {unit}, found {value}")


@dataclass(frozen=True)
class HeadPlantParams:
    """What the simulated head is made of. Three-tuples are (front, mid, rear ring).

    Raises PlantError for a value outside the range given here.

    shaft_base_diameter  m, 0.1e-3 to 10e-3
    shaft_tip_diameter   m, at least 0.1 of the base, at most the base
    shaft_modulus        Pa, 1e6 to 1e12, Young's modulus
    shaft_density        kg/m^3, 100 to 20000
    shaft_damping        damping ratio of both modes, 0 to 0.99
    beam                 how the shaft bends: "table", "linear" or "exact" (vibrissa.rig.beam)
    friction             0 to 2, Coulomb coefficient across the shaft; along it there is none
    servo_frequency      Hz, 0.5 to 200, natural frequency of the position servo
    servo_damping        damping ratio of the servo, 0.1 to 10
    servo_stiffness      N m/rad, 1e-3 to 1e3, static: a moment M moves the servo by M / Kp
    servo_speed          rad/s, 0.1 to 1000, speed limit
    stop_margin          rad, 0 to 0.5, mechanical stops lie this far outside [0, swing]
    retract_speed        rad/s, 0.01 to 100, speed of the watchdog's retraction
    encoder_noise        rad, 0 to 0.1, standard deviation
    sensor_noise         N m, 0 to 1e-2, standard deviation
    sensor_drift         N m/sqrt(s), 0 to 1e-2, random walk of the bias
    sensor_cross_talk    0 to 0.5, share of x seen in y and of y in x
    sensor_full_scale    N m, 1e-5 to 10, readings are clipped here
    sensor_resolution    N m per count, 0 to 1e-3, 0 for none
    rate                 Hz, 100 to 100000, of the ticks

    The whiskers of the geometry are 5 mm to 1 m long.
    """

    geometry: HeadGeometry = field(default_factory=paper_head)
    shaft_base_diameter: tuple[float, float, float] = (0.8e-3, 1.3e-3, 1.6e-3)
    shaft_tip_diameter: tuple[float, float, float] = (0.3e-3, 0.4e-3, 0.4e-3)
    shaft_modulus: float = 3e9
    shaft_density: float = 1200.0
    shaft_damping: float = 0.15
    beam: str = "table"
    friction: float = 0.0
    servo_frequency: float = 10.0
    servo_damping: float = 1.0
    servo_stiffness: float = 0.3
    servo_speed: float = 20.0
    stop_margin: float = 0.087
    retract_speed: float = 2.0
    encoder_noise: float = math.radians(0.1)
    sensor_noise: float = 1e-5
    sensor_drift: float = 0.0
    sensor_cross_talk: float = 0.0
    sensor_full_scale: float = 0.03
    sensor_resolution: float = 1e-6
    rate: float = 2000.0

    def __post_init__(self) -> None:
        ranges = {
            "shaft_modulus": (1e6, 1e12, "Pa"),
            "shaft_density": (100.0, 20000.0, "kg/m^3"),
            "shaft_damping": (0.0, 0.99, ""),
            "friction": (0.0, 2.0, ""),
            "servo_frequency": (0.5, 200.0, "Hz"),
            "servo_damping": (0.1, 10.0, ""),
            "servo_stiffness": (1e-3, 1e3, "N m/rad"),
            "servo_speed": (0.1, 1000.0, "rad/s"),
            "stop_margin": (0.0, 0.5, "rad"),
            "retract_speed": (0.01, 100.0, "rad/s"),
            "encoder_noise": (0.0, 0.1, "rad"),
            "sensor_noise": (0.0, 1e-2, "N m"),
            "sensor_drift": (0.0, 1e-2, "N m/sqrt(s)"),
            "sensor_cross_talk": (0.0, 0.5, ""),
            "sensor_full_scale": (1e-5, 10.0, "N m"),
            "sensor_resolution": (0.0, 1e-3, "N m"),
            "rate": (100.0, 100000.0, "Hz"),
        }
        for name, (low, high, unit) in ranges.items():
            check_range("head plant", name, getattr(self, name), low, high, unit)
        for name in ("shaft_base_diameter", "shaft_tip_diameter"):
            if len(getattr(self, name)) != 3:
                raise PlantError(
                    f"head plant.{name}: expected 3 values (front, mid, rear), "
                    f"found {len(getattr(self, name))}"
                )
        for base, tip in zip(self.shaft_base_diameter, self.shaft_tip_diameter, strict=True):
            check_range("head plant", "shaft_base_diameter", base, 0.1e-3, 10e-3, "m")
            check_range("head plant", "shaft_tip_diameter", tip, 0.1 * base, base, "m")
        if self.beam not in FORMS:
            raise PlantError(
                f"head plant.beam: expected one of {', '.join(FORMS)}, found {self.beam!r}"
            )
        for i, length in enumerate(self.geometry.length):
            check_range("head plant", f"geometry.length[{i}]", float(length), 0.005, 1.0, "m")


def head_table(params: HeadPlantParams) -> Float64s:
    """The parameters as ``head_step`` reads them, float64[HEAD_ROWS, 18]."""
    g = params.geometry
    rings = [ring_of(i) for i in range(WHISKERS)]
    table = np.empty((rows.HEAD_ROWS, WHISKERS), dtype=np.float64)
    table[: rows.SHAFT_ROWS] = shaft_table(
        g.length,
        np.array([params.shaft_base_diameter[r] for r in rings]),
        np.array([params.shaft_tip_diameter[r] for r in rings]),
        params.shaft_modulus,
        params.shaft_density,
        params.shaft_damping,
        1.0 / params.rate,
    )
    table[rows.PIVOT_RADIUS] = g.pivot_radius
    table[rows.PIVOT_HEIGHT] = g.pivot_height
    table[rows.AZIMUTH_COS] = [cos(a) for a in g.azimuth]
    table[rows.AZIMUTH_SIN] = [sin(a) for a in g.azimuth]
    table[rows.PHI_START] = g.phi_start
    table[rows.THETA_LOW] = -params.stop_margin
    table[rows.THETA_HIGH] = g.swing + params.stop_margin
    dt = 1.0 / params.rate
    servo = second_order_step(2 * math.pi * params.servo_frequency, params.servo_damping, dt)
    table[rows.SERVO_EE : rows.SERVO_WW + 1] = np.array(servo)[:, None]
    table[rows.COMPLIANCE] = 1.0 / params.servo_stiffness
    table[rows.SPEED_LIMIT] = params.servo_speed
    table[rows.RETRACT_STEP] = params.retract_speed * dt
    table[rows.ENCODER_NOISE] = params.encoder_noise
    table[rows.SENSOR_NOISE] = params.sensor_noise
    table[rows.DRIFT_STEP] = params.sensor_drift * math.sqrt(DRIFT_TICKS * dt)
    table[rows.CROSS_TALK] = params.sensor_cross_talk
    table[rows.FULL_SCALE] = params.sensor_full_scale
    table[rows.RESOLUTION] = params.sensor_resolution
    table[rows.COUNTS] = 1.0 / params.sensor_resolution if params.sensor_resolution > 0.0 else 0.0
    table[rows.FRICTION] = params.friction
    table[rows.FORM] = FORMS.index(params.beam)
    ratios = _tip_ratios(params)
    table[rows.TIP_TABLE] = [1 + ratios.index(_tip_ratio(params, r)) for r in rings]
    table[rows.DT] = dt
    table[rows.RATE] = params.rate
    return table


def _tip_ratio(params: HeadPlantParams, ring: int) -> float:
    return params.shaft_tip_diameter[ring] / params.shaft_base_diameter[ring]


def _tip_ratios(params: HeadPlantParams) -> tuple[float, ...]:
    """The different tip over base diameters, in the order of their tables."""
    return tuple(dict.fromkeys(_tip_ratio(params, ring) for ring in range(3)))


def head_model(boxes: Float64s, params: HeadPlantParams, table_size: int = SIZE) -> HeadModel:
    """What ``head_step`` needs besides the state: head and beam tables, and the indexed scene.

    boxes float64[n, 5] as made by ``wall_boxes``; table_size: of the beam tables.
    Raises SceneError.
    """
    scene = build_scene(boxes, float(params.geometry.length.max()))
    beam = beam_tables(_tip_ratios(params), table_size)
    head = head_table(params).reshape(-1)
    return HeadModel(head, beam, scene.boxes, scene.grid, scene.starts, scene.items)


def fresh_memo() -> Float64s:
    """A memo float64[MEMO_ROWS, 18] that knows nothing yet."""
    return np.zeros((rows.MEMO_ROWS, WHISKERS), dtype=np.float64)


def rest_state(params: HeadPlantParams) -> Float64s:
    """State float64[STATE_ROWS, 18] of a head at rest at theta = 0, touching nothing."""
    state = np.zeros((rows.STATE_ROWS, WHISKERS), dtype=np.float64)
    state[rows.PSI] = params.geometry.phi_start
    state[rows.PEG] = -1
    state[rows.SIDE_BOX] = -1
    return state
