"""`vibrissa doctor`: what this machine offers a live run, and what would make it better."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vibrissa.tools.console import Json, print_json, stdout, table


def doctor(
    rig: Annotated[
        Path | None, typer.Option(help="Experiment file whose devices to look at instead.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show this machine, its versions and its real-time privileges, with advice.

    Nothing is changed. A run starts without any of the privileges; ticks are late more often then.
    With --rig, its devices are opened and asked who they are: nothing is told to move. Exit code 2
    when one can't be used.
    """
    from vibrissa.tools.machine import advice, machine

    if rig is not None:
        from vibrissa.tools.probe import probe

        found = probe(rig)
        if as_json:
            print_json(found)
            return
        for device, lines_of in found.items():
            for key, value in lines_of.items():
                stdout().print(f"{device} {key}: {value}", markup=False)
        return

    facts, lines = machine(), advice()
    if as_json:
        print_json({**facts, "advice": lines})
        return
    console = stdout()
    overview = table("machine", ("what", "found"), text_columns=2)
    for key, value in facts.items():
        if not isinstance(value, dict):
            overview.add_row(key, str(value))
    console.print(overview)
    console.print("  ".join(f"{n} {v}" for n, v in facts["versions"].items()), markup=False)
    for name, granted in facts["privileges"].items():
        console.print(f"{name}: " + ("[green]granted[/green]" if granted else "[red]no[/red]"))
    for line in lines:
        console.print(f"- {line}", markup=False)
    if not lines:
        console.print("[green]nothing stands in the way of a live run[/green]")


VERBS = ((doctor, "vibrissa doctor --json"),)
