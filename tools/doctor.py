"""`vibrissa doctor`: what this machine offers a live run, and what would make it better."""

from __future__ import annotations

from vibrissa.tools.console import Json, print_json, stdout, table


def doctor(as_json: Json = False) -> None:
    """Show this machine, its versions and its real-time privileges, with advice.

    Nothing is changed. A run starts without any of the privileges; ticks are late more often then.
    """
    from vibrissa.tools.machine import advice, machine

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
