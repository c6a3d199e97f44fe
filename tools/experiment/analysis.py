"""From finished runs to results: tables, paired effects, the odometry question, sensitivity."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from vibrissa.tools.experiment.design import (
    CONTROLLERS,
    EFFECTS,
    INJECTIONS,
    NOISE,
    PAPER,
    SENSITIVITY_CIRCUITS,
    THRESHOLDS,
    Point,
    Scale,
    figure4_maps,
    main_maps,
    main_rig,
    straight_rig,
    tuning_works,
    variant_work,
    variants,
)
from vibrissa.tools.experiment.mapping import MapCase
from vibrissa.tools.experiment.recording import IMAGES
from vibrissa.tools.experiment.scores import RELATIONS
from vibrissa.tools.experiment.statistics import (
    geometric_mean,
    paired,
    reading,
    summarise,
)
from vibrissa.tools.experiment.tasks import mapped, quality, recorded

BY: Final = ("whisk", "experience")
EM_SETS: Final = tuple(f"{by}_{relations}" for by in BY for relations in RELATIONS)
PRINTED_EM: Final = "em_experience_interval"
"""The reading of EM whose size is nearest to the paper's numbers; the figures show it."""
TABLE_SCORES: Final = (
    "arr",
    "arcr",
    "arcr_and_not",
    "returns",
    "right",
    "earlier",
    "earlier_right",
    "templates",
    "experiences",
    *(f"em_{name}" for name in EM_SETS),
    *(f"odo_{name}" for name in EM_SETS),
)

Row = dict[str, Any]


def tune(folder: Path, scale: Scale) -> tuple[dict[str, Point], list[Row]]:
    """The working point of every kind of image, and the grid it was chosen from.

    Chosen is the point with the most right less wrong returns to earlier circuits, summed over the
    tuning seeds and both control schemes, so that neither scheme is favoured; the lowest threshold
    among equals.
    """
    sums: dict[tuple[str, float, float], list[tuple[float, float]]] = {}
    for work in tuning_works(scale):
        for case in work.maps:
            found = mapped(folder, work.rig, case)
            earlier = found["earlier"] or 0.0
            right = earlier * (found["earlier_right"] or 0.0)
            key = (case.image, case.threshold, case.inject)
            sums.setdefault(key, []).append((right, earlier - right))
    grid, points = [], {}
    for image in IMAGES:
        best = -math.inf
        for threshold in THRESHOLDS:
            for inject in INJECTIONS:
                runs = sums[(image, threshold, inject)]
                right = sum(r for r, _ in runs) / len(runs)
                wrong = sum(w for _, w in runs) / len(runs)
                row = {"image": image, "threshold": threshold, "inject": inject}
                grid.append(row | {"earlier_right": right, "earlier_wrong": wrong})
                if right - wrong > best:
                    best = right - wrong
                    points[image] = Point(threshold, inject)
    return points, grid


def main_runs(folder: Path, scale: Scale, points: dict[str, Point]) -> list[Row]:
    """One row per seed, control scheme, image, noise and control, with all scores."""
    rows = []
    for seed in scale.seeds:
        for controller in CONTROLLERS:
            rig = main_rig(scale, seed, controller)
            for case in main_maps(seed, points, scale.noises):
                rows.append(_labels(case, controller) | mapped(folder, rig, case))
    return rows


def _labels(case: MapCase, controller: str) -> Row:
    return {
        "seed": case.seed,
        "controller": controller,
        "image": case.image,
        "noise": case.noise,
        "control": case.control,
    }


def values(rows: Iterable[Row], score: str, **labels: str) -> list[float]:
    """A score of every row with these labels, in the order of the rows; NaN where undefined."""
    return [
        math.nan if row.get(score) is None else float(row[score])
        for row in rows
        if all(row[name] == value for name, value in labels.items())
    ]


def table(rows: list[Row]) -> list[Row]:
    """Mean, spread and interval of every score for every condition."""
    found = []
    conditions = dict.fromkeys(
        (row["noise"], row["controller"], row["image"], row["control"]) for row in rows
    )
    for noise, controller, image, control in conditions:
        labels = {"noise": noise, "controller": controller, "image": image, "control": control}
        summaries = {
            score: asdict(summarise(values(rows, score, **labels))) for score in TABLE_SCORES
        }
        paper = PAPER.get((controller, image), {}) if control == "none" else {}
        found.append({**labels, "scores": summaries, "paper": paper})
    return found


def effects(rows: list[Row], noises: Iterable[str]) -> list[Row]:
    """The paper's comparisons, paired by seed, under each noise and each reading of EM.

    `sign` is the paper's (+1 rises, -1 falls, 0 where the paper says constant or nothing).
    """
    found = []
    for noise in noises:
        for effect in EFFECTS:
            scores = [f"em_{name}" for name in EM_SETS] if effect.score == "em" else [effect.score]
            for score in scores:
                a, b = (
                    values(rows, score, noise=noise, controller=c, image=i, control="none")
                    for c, i in (effect.a, effect.b)
                )
                difference = paired(a, b)
                found.append(
                    {
                        "noise": noise,
                        "effect": effect.name,
                        "score": score,
                        "a": summarise(a).mean,
                        "b": summarise(b).mean,
                        "sign": effect.sign,
                        **asdict(difference.summary),
                        "up": difference.up,
                        "down": difference.down,
                        "reading": reading(difference, effect.sign),
                    }
                )
    return found


def side_effects(rows: list[Row], qualities: list[Row]) -> list[Row]:
    """What RCP changes besides: other scores, the images, what the whiskers go through."""
    found = []
    compared: list[tuple[str, str, list[Row], dict[str, str]]] = []
    for image in IMAGES:
        for score in ("arcr", "right", "earlier", "earlier_right", "templates"):
            labels = {"image": image, "noise": NOISE, "control": "none"}
            compared.append((image, score, rows, labels))
        for score in ("auc", "same", "top1"):
            compared.append((image, score, qualities, {"image": image}))
    for score in ("impingement_deg", "slips"):
        compared.append(("whiskers", score, qualities, {"image": "touch"}))
    for of, score, source, labels in compared:
        a, b = (values(source, score, controller=c, **labels) for c in CONTROLLERS)
        difference = paired(a, b)
        found.append(
            {
                "of": of,
                "score": score,
                "open_loop": summarise(a).mean,
                "rcp": summarise(b).mean,
                **asdict(difference.summary),
                "up": difference.up,
                "down": difference.down,
            }
        )
    return found


def qualities(folder: Path, scale: Scale) -> list[Row]:
    """Image quality, impingement and slips of every main data set."""
    found = []
    for seed in scale.seeds:
        for controller in CONTROLLERS:
            made = quality(recorded(folder, main_rig(scale, seed, controller)))
            for image, row in made.items():
                found.append({"seed": seed, "controller": controller, "image": image, **row})
    return found


def against_odometry(rows: list[Row]) -> list[Row]:
    """EM of the map over EM of its own odometry: geometric mean, and in how many runs below 1."""
    found = []
    conditions = dict.fromkeys(
        (row["noise"], row["controller"], row["image"], row["control"]) for row in rows
    )
    for noise, controller, image, control in conditions:
        if noise == "none":
            continue  # odometry without error can't be beaten
        labels = {"noise": noise, "controller": controller, "image": image, "control": control}
        ratios = {}
        for name in EM_SETS:
            em, odo = (values(rows, f"{by}_{name}", **labels) for by in ("em", "odo"))
            both = [e / o for e, o in zip(em, odo, strict=True) if o > 0.0 and math.isfinite(e)]
            ratios[name] = {
                "ratio": geometric_mean(both),
                "wins": sum(r < 1.0 for r in both),
                "runs": len(both),
            }
        found.append({**labels, "ratios": ratios})
    return found


def figure4(folder: Path, scale: Scale, points: dict[str, Point]) -> list[Row]:
    """Scores of plain, kidnapped and reversed runs, with the paired difference to plain."""
    runs: list[Row] = []
    for seed in scale.seeds:
        for image, behaviours in figure4_maps(scale, seed, points).items():
            for behaviour, case in behaviours.items():
                rig = (
                    main_rig(scale, seed, "rcp")
                    if behaviour == "reversed"
                    else straight_rig(scale, seed)
                )
                labels = {"seed": seed, "image": image, "behaviour": behaviour}
                runs.append(labels | mapped(folder, rig, case))
    found = []
    for image, behaviour in dict.fromkeys((run["image"], run["behaviour"]) for run in runs):
        row: Row = {"image": image, "behaviour": behaviour}
        for score in ("arr", "arcr", "earlier", "earlier_right", *(f"em_{n}" for n in EM_SETS)):
            plain = values(runs, score, image=image, behaviour="plain")
            these = values(runs, score, image=image, behaviour=behaviour)
            difference = paired(plain, these)
            row[score] = asdict(summarise(these))
            row[f"{score}_change"] = asdict(difference.summary) | {
                "up": difference.up,
                "down": difference.down,
            }
        found.append(row)
    return found


def sensitivity(folder: Path, scale: Scale, points: dict[str, Point]) -> list[Row]:
    """One row per variant, control scheme and kind of image: means over the seeds."""
    found = []
    for variant in variants() if scale.sensitivity_seeds else ():
        for controller in variant.controllers:
            runs: list[Row] = []
            for seed in scale.sensitivity_seeds:
                work = variant_work(scale, variant, seed, controller, points)
                made = quality(recorded(folder, work.rig), SENSITIVITY_CIRCUITS)
                for case in work.maps:
                    seen = made[case.image] | made["touch"] | {"image": case.image}
                    runs.append(seen | mapped(folder, work.rig, case))
            for image in IMAGES:
                row: Row = {
                    "what": variant.what,
                    "value": variant.value,
                    "controller": controller,
                    "image": image,
                }
                for score in ("auc", "same", "impingement_deg", "slips", "arr", "earlier",
                              "earlier_right", "templates", PRINTED_EM):  # fmt: skip
                    row[score] = summarise(values(runs, score, image=image)).mean
                em, odo = (
                    values(runs, f"{by}_whisk_interval", image=image) for by in ("em", "odo")
                )
                row["em_over_odometry"] = geometric_mean(
                    [e / o for e, o in zip(em, odo, strict=True)]
                )
                found.append(row)
    return found


def analyse(folder: Path, scale: Scale, points: dict[str, Point], grid: list[Row]) -> Row:
    """Everything that results.json holds about the runs."""
    rows = main_runs(folder, scale, points)
    seen = qualities(folder, scale)
    return {
        "scale": asdict(replace(scale)),
        "working_points": {image: asdict(point) for image, point in points.items()},
        "tuning_grid": grid,
        "table": table(rows),
        "effects": effects(rows, scale.noises),
        "side_effects": side_effects(rows, seen),
        "against_odometry": against_odometry(rows),
        "figure4": figure4(folder, scale, points),
        "sensitivity": sensitivity(folder, scale, points),
        "quality": seen,
        "runs": rows,
    }
