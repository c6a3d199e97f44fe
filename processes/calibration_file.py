"""Calibration files: what free whisking of one head looked like on one day."""

from __future__ import annotations

import json
from typing import Any, Final

from vibrissa.control.calibration import Calibration, CalibrationError
from vibrissa.processes.results import RunError

FORMAT: Final = 1
FIGURES: Final = ("mean_y", "sigma_y", "threshold_y", "mean_dy", "threshold_dy")
VIRTUAL_HEAD: Final = "VIRTUAL"


def to_text(calibration: Calibration, head: str, date: str, run_id: str) -> str:
    """The content of a file: JSON; head is a serial number, date in ISO 8601."""
    figures = {name: getattr(calibration, name).tolist() for name in FIGURES}
    content = {
        "vibrissa_calibration": FORMAT,
        "date": date,
        "head": head,
        "run_id": run_id,
        "samples": calibration.samples,
        **figures,
    }
    return json.dumps(content, indent=1) + "\n"


def from_text(text: str, where: str) -> tuple[Calibration, str]:
    """(calibration, serial number of its head) of a file's content. Raises RunError."""
    try:
        content: Any = json.loads(text)
        if content["vibrissa_calibration"] != FORMAT:
            raise RunError(
                f"{where}: expected calibration format {FORMAT}, "
                f"found {content['vibrissa_calibration']!r}"
            )
        figures = {name: content[name] for name in FIGURES}
        head, samples = content["head"], content["samples"]
        if type(head) is not str or type(samples) is not int:
            raise TypeError("head or samples")
        return Calibration(**figures, samples=samples), head
    except CalibrationError as error:
        raise RunError(f"{where}: {error}") from None
    except (ValueError, TypeError, KeyError) as error:
        raise RunError(f"{where}: expected a file of vibrissa calibrate: {error}") from None
