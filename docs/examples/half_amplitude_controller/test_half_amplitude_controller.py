"""What every controller has to keep, and what this one is for."""

import numpy as np
import pytest
from half_amplitude_controller import HalfAmplitude

from vibrissa.control.controller import LAST
from vibrissa.control.kinematics import paper_head
from vibrissa.control.whisk_pattern import full_whisk

WHISK = full_whisk(paper_head())
NOTHING = np.zeros(18, np.float32)


def commands(controller, ticks=WHISK.period_ticks, first=0, y=NOTHING):
    theta = NOTHING
    given = []
    for tick in range(first, first + ticks):
        theta = controller.step(tick, theta, NOTHING, y)
        given.append(theta)
    return np.array(given)


def test_commands_stay_within_the_travel_and_the_slew_limit():
    given = commands(HalfAmplitude(WHISK))
    assert given.dtype == np.float32 and given.shape[1] == 18
    assert (given >= 0).all() and (given <= paper_head().swing).all()
    assert np.abs(np.diff(given, axis=0)).max() <= WHISK.slew_limit + 1e-6


def test_it_takes_over_from_what_the_drives_hold():
    controller = HalfAmplitude(WHISK)
    held = np.full(18, 0.4, np.float32)
    controller.activate(700, held, held)
    assert np.array_equal(controller.state[LAST], held.astype(float))
    assert np.abs(commands(controller, 1, 700)[0] - held).max() <= WHISK.slew_limit + 1e-6


def test_it_whisks_with_half_the_amplitude():
    assert commands(HalfAmplitude(WHISK)).max(axis=0) == pytest.approx(paper_head().swing / 2)


def test_a_touched_whisker_goes_no_further_out():
    controller = HalfAmplitude(WHISK)
    out = commands(controller, 500)[-1]
    controller.parameters[-1] = 1e-4
    touched = np.zeros(18, np.float32)
    touched[5] = 1e-3
    later = commands(controller, 100, 500, touched)[-1]
    assert later[5] == out[5]
    assert (np.delete(later, 5) > np.delete(out, 5)).all()


@pytest.mark.parametrize(("name", "value"), [("share", 1.5), ("share", "much"), ("gain", 1.0)])
def test_a_parameter_out_of_range_is_refused(name, value):
    with pytest.raises(ValueError, match=name):
        HalfAmplitude(WHISK).set_parameter(name, value)
