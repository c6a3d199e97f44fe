"""`vibrissa calibrate` over an emulated wire: a file of that head, with its noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vibrissa.processes.calibration_file import from_text
from vibrissa.processes.config import load_experiment
from vibrissa.tools.free_whisking import measure, only_whisking

pytestmark = pytest.mark.live

FILE = """\
[whisk]
period = 2.0
[head]
moment_noise = 2e-5
[rig]
head = "serial:emulated"
arm = "rtde:not-asked"
emulate = true
sample_ticks = 4000
command_ticks = 4000
news_ticks = 4000
state_ticks = 4000
setpoint_ticks = 4000
"""


def test_free_whisking_over_a_serial_line_makes_a_calibration_of_that_head(
    tmp_path: Path,
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(FILE)
    asked = only_whisking(load_experiment(path), 1)
    assert asked.rig.arm == "virtual", "the arm is left alone"
    head, text = measure(asked)
    found, of = from_text(text, "what was written")
    assert head == of == "VIB-EMU-1" and found.samples == asked.period_ticks
    assert found.sigma_y == pytest.approx(2e-5, rel=1.0)  # noise, and some weight
    np.testing.assert_allclose(found.threshold_y, 20 * found.sigma_y, rtol=1e-5)
