"""Odometer files: how far one odometer can be trusted, as driven on one day."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any, Final

from vibrissa.processes.results import RunError
from vibrissa.slam.interface import SlamInputError
from vibrissa.slam.odometer import OdometerNoise

FORMAT: Final = 1


def to_text(
    odometer: OdometerNoise, noise: str, date: str, run_id: str, straights: int, turns: int
) -> str:
    """The content of a file: JSON; noise: the odometry noise model of the run, date in ISO 8601,
    straights and turns: whisks it was learnt from."""
    content = {
        "vibrissa_odometer": FORMAT,
        "date": date,
        "odometry_noise": noise,
        "run_id": run_id,
        "straights": straights,
        "turns": turns,
        "odometer": asdict(odometer),
    }
    return json.dumps(content, indent=1) + "\n"


def from_text(text: str, where: str) -> tuple[OdometerNoise, str]:
    """(noise of the odometer, odometry noise model) of a file's content. Raises RunError."""
    try:
        content: Any = json.loads(text)
        if content["vibrissa_odometer"] != FORMAT:
            raise RunError(
                f"{where}: expected odometer format {FORMAT}, "
                f"found {content['vibrissa_odometer']!r}"
            )
        figures, model = content["odometer"], content["odometry_noise"]
        if type(model) is not str or any(type(v) not in (int, float) for v in figures.values()):
            raise TypeError("a number or name")
        return OdometerNoise(**figures), model
    except SlamInputError as error:
        raise RunError(f"{where}: {error}") from None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise RunError(
            f"{where}: expected a file of vibrissa calibrate odometry: {error}"
        ) from None
