"""`vibrissa bench`: measurements that name what they are compared with, in one form for all.

A bench returns rows (everything it measured), targets (the figures it was to reach, missed ones
included) and, where there is a front or a distribution to show, a figure. Speeds are ratios against
a floor or a peer measured in the same call.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import operator
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from vibrissa.tools.console import Json, print_json, progress_bar, stdout, table, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COMPARE: Final[dict[str, Callable[[float, float], bool]]] = {
    "==": operator.eq,
    "<=": operator.le,
    "<": operator.lt,
    ">=": operator.ge,
}


@dataclasses.dataclass(frozen=True, slots=True)
class Target:
    """A figure and what it should be: `relation` ("<=", "<", ">=", "==") to `bound`."""

    name: str
    value: float
    unit: str
    relation: str
    bound: float

    @property
    def met(self) -> bool:
        """Whether it is what it should be; NaN (not measured) never is."""
        return _COMPARE[self.relation](self.value, self.bound)

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "value": self.value,
            "unit": self.unit,
            "target": f"{self.relation} {self.bound:g}",
            "met": self.met,
        }


@dataclasses.dataclass(frozen=True, slots=True)
class Bench:
    """What a bench found. Rows are flat and may differ in their columns."""

    name: str
    rows: Sequence[dict[str, Any]]
    targets: Sequence[Target]
    figure: Figure | None = None

    def to_json(self) -> dict[str, Any]:
        from vibrissa.tools.machine import machine

        return {
            "bench": self.name,
            "machine": machine(),
            "rows": list(self.rows),
            "targets": [target.to_json() for target in self.targets],
        }


Run = Callable[..., Bench]
"""A bench: (directory for what it writes, seconds of logical time, progress) -> Bench; those with
a short form take quick=True as well."""

BENCHES: Final[dict[str, str]] = {
    "live": "vibrissa.tools.bench_live:bench",
    "replay": "vibrissa.tools.bench_replay:bench",
    "faults": "vibrissa.tools.bench_faults:bench",
    "devices": "vibrissa.tools.bench_devices:bench",
    "swap": "vibrissa.tools.bench_swap:bench",
    "rig": "vibrissa.tools.bench_rig:bench",
    "slam": "vibrissa.tools.bench_slam:bench",
    "slam-stress": "vibrissa.tools.bench_slam_stress:bench",
    "experiment": "vibrissa.tools.bench_experiment:bench",
    "touch": "vibrissa.tools.bench_touch:bench",
}
"""name -> where its function is, imported when it is asked for."""


def load(name: str) -> Run:
    """The bench of that name. Raises typer.BadParameter for an unknown one."""
    if name not in BENCHES:
        raise typer.BadParameter(f"no bench {name!r}; there are {', '.join(BENCHES)}")
    module, _, attribute = BENCHES[name].partition(":")
    function: Run = getattr(importlib.import_module(module), attribute)
    return function


def bench(
    name: Annotated[str, typer.Argument(help=f"One of {', '.join(BENCHES)}.")],
    duration: Annotated[
        float, typer.Option(min=1.0, help="Seconds of logical time of each run it makes.")
    ] = 60.0,
    out: Annotated[
        Path | None,
        typer.Option(help="Directory for bench-NAME.json, its picture and its logs; kept."),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Small sizes, to see that a bench works (slam, touch, rig, devices)."
        ),
    ] = False,
    swaps: Annotated[
        int | None, typer.Option(min=1, help="How many swaps to make (swap only).")
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure, and compare with what was aimed at.

    Every ratio is against a floor or a peer measured in the same call. Missed targets are printed
    like the others; the exit code is 0 when the measurement was made.
    """
    function = load(name)
    options: dict[str, Any] = {"quick": True} if quick else {}
    if swaps is not None:
        options["swaps"] = swaps
    for option in options.keys() - inspect.signature(function).parameters.keys():
        raise typer.BadParameter(f"bench {name} has no --{option}; try a short --duration")
    with tempfile.TemporaryDirectory(prefix="vibrissa-bench-") as scratch:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
        with progress_bar() as on_progress:
            result = function(out or Path(scratch), duration, on_progress, **options)
        found = result.to_json()
        if out is not None:
            write_json(out / f"bench-{name}.json", found)
            if result.figure is not None:
                result.figure.savefig(out / f"bench-{name}.png", dpi=120)
    if as_json:
        print_json(found)
    else:
        print_bench(result)


VERBS = ((bench, "vibrissa bench live --duration 60 --out runs/bench"),)


def print_bench(result: Bench) -> None:
    """Rows and targets as tables for people."""
    console = stdout()
    for columns in dict.fromkeys(tuple(row) for row in result.rows):
        rows = [row for row in result.rows if tuple(row) == columns]
        words = sum(isinstance(rows[0][column], str) for column in columns)
        made = table("", columns, text_columns=words)
        for row in rows:
            made.add_row(*(_cell(row[column]) for column in columns))
        console.print(made)
    made = table(f"bench {result.name}", ("target", "value", "unit", "aim", "met"), text_columns=1)
    for target in result.targets:
        made.add_row(
            target.name,
            _cell(target.value),
            target.unit,
            f"{target.relation} {target.bound:g}",
            "[green]yes[/green]" if target.met else "[red]no[/red]",
        )
    console.print(made)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
    return "-" if value is None else str(value)
