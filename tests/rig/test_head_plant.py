"""The simulated head: what it feels, what it never does, and that skipping changes no byte."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vibrissa.control.kinematics import NOSE_HEIGHT, WHISKERS
from vibrissa.numerics import compiled
from vibrissa.rig import rows as h
from vibrissa.rig.beam import EXACT, peg, tip
from vibrissa.rig.head import POSE_LIMIT, TICK, vibrate
from vibrissa.rig.head_params import head_table
from vibrissa.rig.maze import load_maze
from vibrissa.rig.plant import WATCHDOG_TICKS, HeadPlant, HeadPlantParams, PlantError
from vibrissa.rig.rows import LENGTH, RIGIDITY, TAPER, WEIGHT
from vibrissa.rig.scene import build_scene, wall_boxes
from vibrissa.rig.sensing import DRIFT_TICKS

NOTHING = np.zeros((0, 5))
QUIET = HeadPlantParams(encoder_noise=0.0, sensor_noise=0.0, sensor_resolution=0.0)
CYLINDERS = HeadPlantParams(
    encoder_noise=0.0,
    sensor_noise=0.0,
    sensor_resolution=0.0,
    servo_stiffness=1e3,
    shaft_base_diameter=(1e-3, 1e-3, 1e-3),
    shaft_tip_diameter=(1e-3, 1e-3, 1e-3),
)
START = (0.09, 0.09, NOSE_HEIGHT, 0.0)
ORIGIN = (0.0, 0.0, NOSE_HEIGHT, 0.0)
WHISK = 2000  # ticks, 1 Hz
MID_LEFT = 7  # mid ring, 90 degrees: its whisking plane is x = 0 when the head is at ORIGIN
PIVOT = 0.04  # m, its pivot from the head axis


@compiled
def ring(state, memo, table, ticks):
    for _ in range(ticks):
        vibrate(state.reshape(-1), memo.reshape(-1), table.reshape(-1))


def whisking(plant: HeadPlant, tick: float, share: float = 1.0) -> np.ndarray:
    angle = share * plant.params.geometry.swing * (1 - math.cos(2 * math.pi * tick / WHISK)) / 2
    return angle.astype(np.float32)


def run(plant: HeadPlant, poses, ticks: int, share: float = 1.0) -> tuple[np.ndarray, ...]:
    """Whisk for some ticks; (theta, x, y), each float32[ticks, 18]."""
    samples = [plant.step(t, poses(t), whisking(plant, t, share)) for t in range(ticks)]
    return tuple(np.array(channel) for channel in zip(*samples, strict=True))


def wall_across(near: float, thickness: float = 0.012) -> np.ndarray:
    """A long wall along x whose near face is ``near`` m from MID_LEFT's pivot."""
    y = PIVOT + near
    return np.array([[-0.5, 0.5, y, y + thickness, 0.05]])


def weight_term(plant: HeadPlant, theta: np.ndarray) -> np.ndarray:
    weight = plant.model.head.reshape(-1, WHISKERS)[WEIGHT]
    return -weight * np.sin(plant.params.geometry.phi_start - theta)


def strolling(t: int) -> tuple[float, float, float, float]:
    """Along the south corridor and into the next, turning on the way."""
    s = t * TICK
    return (0.09 + 0.05 * s, 0.09 + 0.01 * math.sin(s), NOSE_HEIGHT, 0.4 * math.sin(0.7 * s))


def test_skipping_changes_no_byte() -> None:
    boxes = wall_boxes(load_maze("board7x5"))
    quick, full = HeadPlant(boxes, 5), HeadPlant(boxes, 5, skip=False)
    touched = 0
    for t in range(3 * WHISK):
        a = quick.step(t, strolling(t), whisking(quick, t))
        b = full.step(t, strolling(t), whisking(full, t))
        assert [v.tobytes() for v in a] == [v.tobytes() for v in b], t
        assert quick.state.tobytes() == full.state.tobytes()
        touched += int((quick.state[h.PEG] >= 0).sum())
    assert touched > WHISK


def test_one_seed_gives_one_run_and_another_seed_another() -> None:
    boxes = wall_boxes(load_maze("board7x5"))
    first, again, other = (run(HeadPlant(boxes, s), strolling, 300) for s in (1, 1, 2))
    for a, b, c in zip(first, again, other, strict=True):
        assert a.tobytes() == b.tobytes()
        assert (a != c).mean() > 0.9


def test_noise_does_not_depend_on_the_scene() -> None:
    walled = HeadPlant(wall_boxes(load_maze("board7x5")), 9)
    empty = HeadPlant(NOTHING, 9)
    for t in range(50):
        a = walled.step(t, START, whisking(walled, t))
        b = empty.step(t, START, whisking(empty, t))
        assert (walled.state[h.PEG] == -1).all()
        assert [v.tobytes() for v in a] == [v.tobytes() for v in b]


def test_free_whisker_follows_a_sinusoid_with_the_lag_of_its_servo() -> None:
    plant = HeadPlant(NOTHING, 1, QUIET)
    theta, x, _ = run(plant, lambda t: ORIGIN, 3 * WHISK)
    wn, w = 2 * math.pi * 10, 2 * math.pi
    lag = 2 * math.atan(w / wn)
    gain = 1 / (1 + (w / wn) ** 2)
    t = np.arange(WHISK, 3 * WHISK)[:, None] * TICK
    expected = plant.params.geometry.swing / 2 * (1 - gain * np.cos(w * t - lag))
    np.testing.assert_allclose(theta[WHISK:], expected, atol=2e-3)
    assert not x.any()


def test_free_whisker_feels_its_weight_and_its_inertia() -> None:
    plant = HeadPlant(NOTHING, 1, QUIET)
    theta, _, y = run(plant, lambda t: ORIGIN, 2 * WHISK)
    error = y - weight_term(plant, theta)
    swing = plant.params.geometry.swing
    inertia = head_table(plant.params)[h.INERTIA]
    peak = inertia * swing / 2 * (2 * math.pi) ** 2
    np.testing.assert_allclose(np.abs(error[WHISK:]).max(axis=0), peak, rtol=0.05)


def test_noise_has_the_given_spread_and_no_bias() -> None:
    plant = HeadPlant(NOTHING, 4, HeadPlantParams(sensor_resolution=0.0))
    still = [plant.step(t, ORIGIN, np.zeros(18, dtype=np.float32)) for t in range(4000)]
    theta, x, y = (np.array(channel, dtype=np.float64) for channel in zip(*still, strict=True))
    y -= weight_term(plant, np.zeros(WHISKERS))
    for values, spread in ((theta, math.radians(0.1)), (x, 1e-5), (y, 1e-5)):
        np.testing.assert_allclose(values.std(axis=0), spread, rtol=0.06)
        assert (np.abs(values.mean(axis=0)) < 5 * spread / math.sqrt(4000)).all()
    channels = np.concatenate([theta / math.radians(0.1), x / 1e-5, y / 1e-5], axis=1)
    correlation = np.corrcoef(channels.T) - np.eye(3 * WHISKERS)
    assert np.abs(correlation).max() < 0.1


@pytest.mark.parametrize("params", [CYLINDERS, QUIET])
def test_contact_moment_is_the_elastica_s(params: HeadPlantParams) -> None:
    # Eight times slower than a whisk: what inertia adds is then far below what is compared.
    plant = HeadPlant(wall_across(0.060), 1, params)
    slow = [whisking(plant, 0.125 * t) for t in range(4 * WHISK)]
    samples = [plant.step(t, ORIGIN, command) for t, command in enumerate(slow)]
    theta, x, y = (np.array(channel) for channel in zip(*samples, strict=True))
    far, drop = 0.072, 0.107 - 0.050
    d, touch = math.hypot(far, drop), math.atan2(far, drop)
    gamma = touch - (plant.params.geometry.phi_start[MID_LEFT] - theta[:, MID_LEFT])
    table = head_table(params)
    q = 1 - table[TAPER, MID_LEFT] * d
    beam = plant.model.beam
    moment = []
    for phi in touch - gamma[::20]:
        unit, _, angle, _ = peg(EXACT, beam, q, max(touch - phi, 0.0))
        moment.append(unit / d)
        if phi + angle > math.pi / 2:  # the shaft has come to lie along the wall's top
            end, length = (
                1 - table[TAPER, MID_LEFT] * table[LENGTH, MID_LEFT],
                table[LENGTH, MID_LEFT],
            )
            unit, _, _ = tip(EXACT, beam, 0, end, drop / length, phi)
            moment[-1] = unit / length
    moment = table[RIGIDITY, MID_LEFT] * np.array(moment)
    felt = (y - weight_term(plant, theta))[:, MID_LEFT]
    assert moment.max() > 5e-4
    np.testing.assert_allclose(felt[::20], moment, atol=1e-3 * moment.max())
    before, after = np.flatnonzero(gamma < -1e-3), np.flatnonzero(gamma > 1e-2)
    assert np.abs(felt[before]).max() < 2e-6
    assert (np.diff(felt[after]) > 0).sum() > 0.95 * (len(after) - 1)
    assert np.abs(x[:, MID_LEFT]).max() < 1e-6


def test_opposite_whiskers_feel_opposite_sideways_pushes_from_one_wall() -> None:
    wall = np.array([[-0.5, 0.5, 0.080, 0.092, 0.05]])
    plant = HeadPlant(wall, 1, QUIET)
    _, x, y = run(plant, lambda t: ORIGIN, WHISK // 2)
    ahead, behind = 12, 14  # rear ring, 30 and 150 degrees: mirror images
    np.testing.assert_allclose(y[:, ahead], y[:, behind], atol=1e-7)
    np.testing.assert_allclose(x[:, ahead], -x[:, behind], atol=1e-7)
    # The wall pushes the whisker at 30 degrees back towards the head, which is to its left side
    # seen from above only for the one at 150 degrees.
    assert np.abs(x[:, ahead]).max() > 1e-4


def test_soft_servo_is_held_back_by_a_wall_and_a_stiff_one_is_not() -> None:
    reached = {}
    for stiffness in (0.01, 1e3):
        params = HeadPlantParams(encoder_noise=0.0, servo_stiffness=stiffness)
        plant = HeadPlant(wall_across(0.060), 1, params)
        reached[stiffness] = run(plant, lambda t: ORIGIN, WHISK)[0][:, MID_LEFT].max()
    swing = plant.params.geometry.swing[MID_LEFT]
    assert reached[1e3] > 0.99 * swing
    assert reached[0.01] < 0.8 * swing


def test_whisker_slips_off_rings_and_hooks_on_the_way_back() -> None:
    plant = HeadPlant(wall_across(0.0915), 1, QUIET)
    felt, pegs = np.empty(WHISK), np.empty(WHISK)
    for t in range(WHISK):
        theta, _, y = plant.step(t, ORIGIN, whisking(plant, t))
        felt[t] = (y - weight_term(plant, theta))[MID_LEFT]
        pegs[t] = plant.state[h.PEG, MID_LEFT]
    land, slip, hook = (int(t) + 1 for t in np.flatnonzero(np.diff(pegs)))
    held = felt[slip - 1]
    assert (pegs[land:slip] == 0).all() and held > 5e-4
    # Let go before full protraction, it rings in both modes about where it would hang.
    assert slip < WHISK // 2
    ringing = felt[slip : slip + 100]
    assert abs(ringing[0] - held) < 0.05 * held
    table = head_table(QUIET)
    first = share = table[h.RELEASE, MID_LEFT]
    states = [np.array([share, 0.0]), np.array([1 - first, 0.0])]
    matrices = [table[row : row + 4, MID_LEFT].reshape(2, 2) for row in (h.FIRST_QQ, h.SECOND_QQ)]
    expected = np.empty(100)
    for k in range(100):
        states = [m @ v for m, v in zip(matrices, states, strict=True)]
        expected[k] = states[0][0] + states[1][0]
    np.testing.assert_allclose(ringing / held, expected, atol=0.03)
    assert ringing.min() < -0.5 * held
    assert np.abs(felt[hook - 50 : hook - 1]).max() < 0.02 * held
    # On the way back it is caught behind the wall and pulls the other way.
    assert hook > WHISK // 2 and felt[-1] < -1e-4


def test_wall_met_sideways_deflects_sideways_and_lets_go() -> None:
    # A wall parallel to MID_LEFT's plane comes from ahead (+x) while the head moves forward.
    wall = np.array([[0.02, 0.032, 0.06, 0.30, 0.05]])
    plant = HeadPlant(wall, 1, QUIET)
    low = plant.params.geometry.swing.astype(np.float32)
    samples = []
    for t in range(2400):
        s = max(0.0, (t - 1000) * TICK)
        samples.append(plant.step(t, (0.05 * s, 0.0, NOSE_HEIGHT, 0.0), low))
    x = np.array([v[1][MID_LEFT] for v in samples])
    y = np.array([v[2][MID_LEFT] for v in samples])
    touch = 1000 + round(0.02 / 0.05 / TICK)
    assert not x[: touch - 2].any()
    pushed = x[touch + 20 : touch + 400]
    # The wall is ahead (right of a whisker that points left): it is pushed to its left.
    assert (pushed > 0).all() and (np.diff(pushed) > 0).all()
    assert pushed[0] < 0.1 * pushed[-1]
    assert np.abs(np.diff(y[touch - 50 : touch + 400])).max() < 1e-6
    # Retracting lifts the tip over the wall.
    assert plant.state[h.SIDE, MID_LEFT] == 1
    for t in range(2400, 4400):
        _, x, _ = plant.step(t, (0.035, 0.0, NOSE_HEIGHT, 0.0), np.zeros(18, dtype=np.float32))
    assert plant.state[h.SIDE, MID_LEFT] == 0 and abs(x[MID_LEFT]) < 1e-8


def test_floor_stops_a_whisker_that_comes_too_low() -> None:
    plant = HeadPlant(NOTHING, 1, QUIET)
    for t in range(WHISK // 2):
        _, x, y = plant.step(t, (0.0, 0.0, 0.060, 0.0), whisking(plant, t))
    assert (y[:6] < 1e-5).all()
    assert (y[6:] > 1e-4).all() and not x.any()
    assert (
        plant.state[h.PSI, 6:] > plant.params.geometry.phi_start[6:] - plant.state[h.THETA, 6:]
    ).all()


def test_contact_does_not_chatter_along_a_maze() -> None:
    plant = HeadPlant(wall_boxes(load_maze("board7x5")), 5, QUIET)
    whisks, jumps, contact = 20, 0, 0
    before = plant.state[h.MOMENT_Y].copy()
    for t in range(whisks * WHISK):
        plant.step(t, (0.09 + 0.05 * t * TICK, 0.09, NOSE_HEIGHT, 0.0), whisking(plant, t))
        now = plant.state[h.MOMENT_Y]
        jumps += int((np.abs(now - before) > 1e-4).sum())
        contact += int((plant.state[h.PEG] >= 0).sum())
        before = now.copy()
    # Slips, landings and corners passed, a few per whisk of eighteen whiskers; chatter would be
    # hundreds.
    assert 0 < jumps < 2 * whisks
    assert contact > 0.1 * whisks * WHISK * WHISKERS


def test_watchdog_retracts_after_twenty_milliseconds_without_command() -> None:
    plant = HeadPlant(NOTHING, 1, QUIET)
    out = np.full(WHISKERS, 0.3, dtype=np.float32)
    for t in range(1000):
        plant.step(t, ORIGIN, out)
    held = [plant.step(1000 + t, ORIGIN, None)[0] for t in range(WATCHDOG_TICKS - 1)]
    np.testing.assert_allclose(held[-1], 0.3, atol=1e-3)
    theta = np.array([plant.step(1039 + t, ORIGIN, None)[0] for t in range(1000)])
    assert (np.diff(theta, axis=0) > -1.02 * plant.params.retract_speed * TICK).all()
    np.testing.assert_allclose(theta[-1], 0.0, atol=1e-4)
    back = [plant.step(2039 + t, ORIGIN, out)[0] for t in range(500)]
    np.testing.assert_allclose(back[-1], 0.3, atol=1e-3)


def test_head_that_never_got_a_command_stays_at_its_start_angles() -> None:
    plant = HeadPlant(NOTHING, 1, QUIET)
    for t in range(200):
        theta, _, _ = plant.step(t, ORIGIN, None)
    assert not theta.any()


def test_speed_and_travel_limits_hold() -> None:
    params = HeadPlantParams(encoder_noise=0.0, servo_speed=3.0)
    plant = HeadPlant(NOTHING, 1, params)
    wild = np.where(np.arange(WHISKERS) % 2, 3e38, -3e38).astype(np.float32)
    raised = (0.0, 0.0, 0.2, 0.0)
    theta = np.array([plant.step(t, raised, wild)[0] for t in range(1000)], dtype=np.float64)
    assert np.abs(np.diff(theta, axis=0)).max() <= 3.0 * TICK * 1.001
    high = params.geometry.swing + params.stop_margin
    np.testing.assert_allclose(theta[-1, 1::2], high[1::2], atol=1e-5)
    np.testing.assert_allclose(theta[-1, ::2], -params.stop_margin, atol=1e-5)


def test_sensor_chain_mixes_clips_and_counts() -> None:
    params = HeadPlantParams(
        encoder_noise=0.0,
        sensor_noise=0.0,
        sensor_cross_talk=0.1,
        sensor_full_scale=2e-4,
        sensor_resolution=1e-6,
    )
    plant = HeadPlant(wall_across(0.060), 1, params)
    _, x, y = run(plant, lambda t: ORIGIN, WHISK // 2)
    assert y[:, MID_LEFT].max() == np.float32(2e-4)
    counts = np.concatenate([x, y]).astype(np.float64) / 1e-6
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-4)
    free = 2  # front ring, touches nothing
    np.testing.assert_allclose(x[:, free], 0.1 * y[:, free], atol=1.1e-6)


def test_drift_is_a_random_walk_of_the_bias() -> None:
    params = HeadPlantParams(sensor_noise=0.0, sensor_drift=1e-4, sensor_resolution=0.0)
    plant = HeadPlant(NOTHING, 2, params)
    x = np.array([plant.step(t, ORIGIN, None)[1] for t in range(8000)], dtype=np.float64)
    steps = np.diff(x, axis=0)
    moving = np.flatnonzero(steps.any(axis=1)) + 1
    assert set(moving % DRIFT_TICKS) == {0}
    assert steps[moving - 1].std() == pytest.approx(1e-4 * math.sqrt(0.1), rel=0.15)


@pytest.mark.parametrize(
    ("tick", "pose", "command", "word"),
    [
        (5, ORIGIN, np.zeros(18, dtype=np.float32), "tick: expected 1"),
        (1, ORIGIN, np.zeros(17, dtype=np.float32), "command"),
        (1, ORIGIN, np.zeros(18, dtype=np.float64), "float64"),
        (1, ORIGIN, np.full(18, np.nan, dtype=np.float32), "whisker 0"),
        (1, ORIGIN, np.full(18, np.inf, dtype=np.float32), "whisker 0"),
        (1, (0.0, math.nan, 0.0, 0.0), np.zeros(18, dtype=np.float32), "pose"),
        (1, (0.0, 0.0, 0.0, 1e300), np.zeros(18, dtype=np.float32), "pose"),
    ],
)
def test_bad_input_is_refused_and_changes_nothing(tick, pose, command, word) -> None:
    plant, twin = HeadPlant(NOTHING, 1), HeadPlant(NOTHING, 1)
    good = np.full(18, 0.1, dtype=np.float32)
    plant.step(0, ORIGIN, good)
    twin.step(0, ORIGIN, good)
    with pytest.raises(PlantError, match=word) as error:
        plant.step(tick, pose, command)
    assert "\n" not in str(error.value)
    a, b = plant.step(1, ORIGIN, None), twin.step(1, ORIGIN, None)
    assert [v.tobytes() for v in a] == [v.tobytes() for v in b]


@pytest.mark.parametrize(
    "change",
    [
        {"servo_stiffness": 0.0},
        {"servo_damping": math.nan},
        {"shaft_tip_diameter": (0.9e-3, 0.4e-3, 0.4e-3)},
        {"shaft_base_diameter": (1e-3, 1e-3)},
        {"sensor_noise": -1e-5},
        {"sensor_full_scale": math.inf},
        {"beam": "rubber"},
        {"friction": -0.1},
        {"rate": 0.0},
    ],
)
def test_impossible_parameters_are_refused(change) -> None:
    with pytest.raises(PlantError, match=next(iter(change))) as error:
        HeadPlantParams(**change)
    assert "\n" not in str(error.value)


def test_beam_forms_feel_alike_and_the_table_most_like_the_exact_one() -> None:
    felt = {}
    for beam in ("linear", "table", "exact"):
        params = HeadPlantParams(
            beam=beam, encoder_noise=0.0, sensor_noise=0.0, sensor_resolution=0.0, rate=250.0
        )
        plant = HeadPlant(wall_across(0.0755), 1, params)
        angle = plant.params.geometry.swing[:, None] * np.sin(np.linspace(0, 0.5 * np.pi, 125)) ** 2
        felt[beam] = np.array(
            [plant.step(t, ORIGIN, angle[:, t].astype(np.float32))[2] for t in range(125)]
        )
    scale = np.abs(felt["exact"]).max()
    assert scale > 1e-3
    assert np.abs(felt["table"] - felt["exact"]).max() < 1e-3 * scale
    assert 5e-3 * scale < np.abs(felt["linear"] - felt["exact"]).max() < 0.5 * scale


def test_exact_beam_skips_exactly_too() -> None:
    boxes = wall_boxes(load_maze("board7x5"))
    params = HeadPlantParams(beam="exact", rate=250.0)
    quick, full = HeadPlant(boxes, 5, params), HeadPlant(boxes, 5, params, skip=False)
    for t in range(60):
        command = whisking(quick, 8 * t + 300)
        a, b = quick.step(t, strolling(8 * t), command), full.step(t, strolling(8 * t), command)
        assert [v.tobytes() for v in a] == [v.tobytes() for v in b], t


def test_standing_still_skips_exactly_and_a_command_wakes_it() -> None:
    boxes = wall_boxes(load_maze("board7x5"))
    quick, full = HeadPlant(boxes, 5), HeadPlant(boxes, 5, skip=False)
    settled = 0
    for t in range(6000):
        # Down onto the walls, a rest, further down, a rest elsewhere.
        share = (0.8, 0.8, 1.0, 1.0, 0.5, 0.5)[t // 1000]
        pose = START if t < 5000 else (0.095, 0.09, NOSE_HEIGHT, 0.1)
        command = (share * quick.params.geometry.swing).astype(np.float32)
        a, b = quick.step(t, pose, command), full.step(t, pose, command)
        assert [v.tobytes() for v in a] == [v.tobytes() for v in b], t
        assert quick.state.tobytes() == full.state.tobytes(), t
        settled += int((quick._memo[h.SETTLED] > 0).sum())
    assert settled > 3000 and (quick.state[h.PEG] >= 0).any()


def test_memo_can_be_forgotten_at_any_time() -> None:
    boxes = wall_boxes(load_maze("board7x5"))
    plant, forgetful = HeadPlant(boxes, 5), HeadPlant(boxes, 5)
    for t in range(1500):
        if t % 7 == 0:
            forgetful._memo[:] = 0.0
        a = plant.step(t, strolling(t), whisking(plant, t))
        b = forgetful.step(t, strolling(t), whisking(plant, t))
        assert [v.tobytes() for v in a] == [v.tobytes() for v in b], t


def test_undamped_free_whisker_keeps_its_energy() -> None:
    params = HeadPlantParams(
        shaft_damping=0.0, encoder_noise=0.0, sensor_noise=0.0, sensor_resolution=0.0
    )
    plant = HeadPlant(NOTHING, 1, params)
    table = head_table(params)
    plant.state[h.RING_X], plant.state[h.RING_X2] = 1e-3, -4e-4
    plant.state[h.RING_Y], plant.state[h.RING_Y2] = 7e-4, 3e-4

    def energy() -> np.ndarray:
        total = np.zeros((4, WHISKERS))
        for k, step in enumerate((h.FIRST_QQ, h.SECOND_QQ, h.FIRST_QQ, h.SECOND_QQ)):
            square = -table[step + 2] / table[step + 1]  # omega^2, as VQ = -omega^2 QV
            row = h.RING_X + 2 * k
            total[k] = square * plant.state[row] ** 2 + plant.state[row + 1] ** 2
        return total

    ring(plant.state, plant._memo, table, 50)
    before = energy()
    ring(plant.state, plant._memo, table, 1_000_000)
    np.testing.assert_allclose(energy(), before, rtol=1e-9)


def test_friction_drags_the_shaft_along_a_wall_and_is_off_by_default() -> None:
    # Seen from above the wall lies along x; the head moves along it with the whisker pressed on.
    felt = {}
    for mu in (0.0, 0.3):
        params = HeadPlantParams(
            friction=mu, encoder_noise=0.0, sensor_noise=0.0, sensor_resolution=0.0
        )
        plant = HeadPlant(wall_across(0.060), 1, params)
        command = (0.9 * plant.params.geometry.swing).astype(np.float32)
        samples = []
        for t in range(4000):
            s = max(0, t - 1500) if t < 2700 else 2 * 2700 - 1500 - t
            pose = (0.05 * TICK * s, 0.0, NOSE_HEIGHT, 0.0)
            samples.append([v[MID_LEFT] for v in plant.step(t, pose, command)])
        felt[mu] = np.array(samples, dtype=np.float64)
    # Nothing but the rounding of the azimuth, whose cosine is 6e-17.
    assert np.abs(felt[0.0][:, 1]).max() < 1e-18
    x, y = felt[0.3][:, 1], felt[0.0][:, 2]
    load = (y - weight_term(plant, felt[0.0][:, :1])[:, MID_LEFT])[1400]
    assert np.abs(x[:1499]).max() < 1e-9
    # Moving forward (to the right of a whisker that points left) the tip lags to its left; the
    # force grows while it sticks and stays while it slides, and turns round with the head.
    assert (np.diff(x[1502:1530]) > 0).all()
    np.testing.assert_allclose(x[2300:2690], 0.3 * load, rtol=0.05)
    np.testing.assert_allclose(x[3600:3900], -0.3 * load, rtol=0.05)


def test_rate_of_ticks_changes_less_than_the_noise() -> None:
    # The same commands, a thousand a second, and samples at the same times.
    felt, pegs = {}, {}
    for rate in (1000, 2000, 4000, 16000):
        params = HeadPlantParams(
            rate=float(rate), encoder_noise=0.0, sensor_noise=0.0, sensor_resolution=0.0
        )
        plant = HeadPlant(wall_across(0.060), 1, params)
        per_ms = rate // 1000
        y, peg_of = [], []
        for t in range(rate // 2):
            _, _, sampled = plant.step(t, ORIGIN, whisking(plant, 2 * (t // per_ms)))
            if t % per_ms == per_ms - 1:
                y.append(sampled)
                peg_of.append(plant.state[h.PEG].copy())
        felt[rate], pegs[rate] = np.array(y), np.array(peg_of)
    fine = pegs[16000]
    touches = (fine >= 0).any(axis=0)
    lets_go = ((fine[:-1] >= 0) & (fine[1:] < 0)).any(axis=0)
    assert touches.sum() > 2 and lets_go.any() and (touches & ~lets_go).any()
    error = {r: np.abs(felt[r] - felt[16000])[:, ~lets_go].max() for r in (1000, 2000, 4000)}
    noise = HeadPlantParams().sensor_noise
    assert error[2000] < 0.5 * noise and error[4000] < 0.5 * error[2000] < 0.25 * error[1000]
    # A whisker slips off within a tick of the right one.
    for rate in (1000, 2000, 4000):
        assert (pegs[rate] != fine).sum(axis=0).max() <= 1


numbers = st.floats(-POSE_LIMIT, POSE_LIMIT)
near_numbers = st.floats(-0.4, 0.4)


@settings(max_examples=300, deadline=None)
@given(
    boxes=st.lists(
        st.tuples(
            near_numbers,
            st.floats(1e-9, 0.5),
            near_numbers,
            st.floats(1e-9, 0.5),
            st.floats(1e-6, 0.5),
        ),
        max_size=5,
    ),
    steps=st.lists(
        st.tuples(
            st.tuples(
                st.one_of(near_numbers, numbers),
                st.one_of(near_numbers, numbers),
                st.one_of(st.floats(-0.1, 0.2), numbers),
                numbers,
            ),
            st.floats(width=32, allow_nan=False, allow_infinity=False),
        ),
        min_size=1,
        max_size=30,
    ),
    stiffness=st.sampled_from([1e-3, 0.3, 1e3]),
)
def test_no_finite_input_breaks_the_numbers(boxes, steps, stiffness) -> None:
    array = np.array([[x, x + w, y, y + d, t] for x, w, y, d, t in boxes]).reshape(-1, 5)
    params = HeadPlantParams(servo_stiffness=stiffness)
    table, scene = head_table(params), build_scene(array, 0.16)
    quick = HeadPlant(array, 1, params)
    full = HeadPlant(array, 1, params, skip=False)
    assert np.isfinite(table).all() and len(scene.boxes) == len(array)
    for t, (pose, angle) in enumerate(steps):
        command = np.full(WHISKERS, angle, dtype=np.float32)
        a, b = quick.step(t, pose, command), full.step(t, pose, command)
        assert np.isfinite(quick.state).all()
        for u, v in zip(a, b, strict=True):
            assert np.isfinite(u).all()
            assert u.tobytes() == v.tobytes()
