"""The tables of `vibrissa experiment slam` as Markdown: report.md, which docs/slam.md quotes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

from vibrissa.tools.experiment.scores import RELATIONS

LEGEND: Final = (
    "Energy Metric over that of the run's own odometry, consecutive / 20 apart / random pairs:"
    " geometric mean, worst run in brackets, then runs won by relations. Loops: per run, and how"
    " many of them join whisks within 0.1 m."
)


def markdown(table: Sequence[dict[str, Any]]) -> str:
    """A section per group: ratios by row and noise, then intervals and loops of rows with loops."""
    parts = ["# SLAM by touch against its own odometry", LEGEND]
    for group in dict.fromkeys(cell["group"] for cell in table):
        cells = [cell for cell in table if cell["group"] == group]
        noises = list(dict.fromkeys(cell["noise"] for cell in cells))
        names = list(dict.fromkeys(cell["row"] for cell in cells))
        at = {(cell["row"], cell["noise"]): cell for cell in cells}
        runs = sorted({cell["n"] for cell in cells})
        counted = str(runs[0]) if len(runs) == 1 else f"{runs[0]} to {runs[-1]}"
        parts.append(f"## {group} ({counted} runs per cell)")
        told = ([name, *(ratios(at.get((name, noise))) for noise in noises)] for name in names)
        parts.append(grid(["row", *noises], told))
        closed = [n for n in names if any(at[n, k]["loops"] for k in noises if (n, k) in at)]
        told = ([name, *(interval(at.get((name, noise))) for noise in noises)] for name in closed)
        parts.append(grid(["95 % interval; loops", *noises], told))
    return "\n\n".join(parts) + "\n"


def ratios(cell: dict[str, Any] | None) -> str:
    """Ratios, worst runs and wins of a cell."""
    if cell is None:
        return "-"
    values = [cell[relations] for relations in RELATIONS]
    means = " / ".join(short(value["ratio"]) for value in values)
    worst = ", ".join(short(value["worst"]) for value in values)
    wins = " ".join(str(value["wins"]) for value in values)
    ended = f"; {cell['ended']} ended" if cell["ended"] else ""
    return f"{means} ({worst}); {wins}{ended}"


def interval(cell: dict[str, Any] | None) -> str:
    """Bootstrap intervals of a cell's means, its loops and the share of right ones."""
    if cell is None:
        return "-"
    spans = (f"{short(cell[r]['low'])} to {short(cell[r]['high'])}" for r in RELATIONS)
    right = "" if cell["right"] is None else f", {100.0 * cell['right']:.1f} % right"
    return f"{' / '.join(spans)}; {cell['loops']:.0f}{right}"


def short(value: float) -> str:
    """A ratio as people write it: two or three digits."""
    if value >= 10.0:
        return f"{value:.0f}"
    return f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"


def grid(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
