"""Verbs for a run that goes on: which controllers there are, which has the drives, swap, set."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.tools.console import Json, fail, note, print_json, stdout, table

if TYPE_CHECKING:
    from vibrissa.processes.client import Client

Run = Annotated[
    Path | None,
    typer.Option("--run", help="Directory of the live run. Default: the only one that goes on."),
]
Name = Annotated[str, typer.Argument(help="A controller, or a slot such as whisk.2.")]
Params = Annotated[
    list[str] | None,
    typer.Option("--param", metavar="KEY=VALUE", help="Parameter of the controller; repeatable."),
]
Of = Annotated[
    str,
    typer.Option("--node", help="Whose: whisk (a controller), slam, or for swap arm (circuits)."),
]
REFUSED = 1
"""Exit code of a request that the run refused; nothing has changed then."""


def controllers(run: Run = None, as_json: Json = False) -> None:
    """Show the controllers that can be asked for, and those that a live run has loaded.

    Of each loaded one: the ticks in a row it answered on time, answers that came late, how far
    apart its commands are from those of the active one (rad, since it last missed a tick), and when
    its answer was ready after the tick was due (us, mean of the last second).
    """
    from vibrissa.processes.config import load_experiment
    from vibrissa.processes.controllers import available
    from vibrissa.processes.registry import live_endpoints

    if run is None and not live_endpoints():
        note("no live run: installed controllers only")
        found: dict[str, Any] = {"installed": available(load_experiment()), "loaded": []}
    else:
        with _client(run) as client:
            found = client.controllers()
    if as_json:
        print_json(found)
        return
    installed = table("installed", ("controller", "from"), text_columns=2)
    for name, origin in found["installed"].items():
        installed.add_row(name, origin)
    stdout().print(installed)
    if not found["loaded"]:
        return
    columns = ("slot", "controller", "state", "fresh", "late", "apart mean", "max", "ready us")
    loaded = table("loaded", columns, text_columns=3)
    keys = ("fresh_ticks", "late", "mean_divergence", "max_divergence", "ready_us")
    for row in found["loaded"]:
        values = [str(row.get(key, "-")) for key in keys]
        loaded.add_row(row["slot"], row["controller"], row["state"], *values)
    stdout().print(loaded)


def load(
    name: Name,
    param: Params = None,
    node: Of = "whisk",
    run: Run = None,
    as_json: Json = False,
) -> None:
    """Have a controller answer in shadow: on the same live data, recorded, not routed.

    With --node slam, a SLAM, which is handed over everything seen so far.
    With --param a new instance is loaded, whatever is loaded already. Exit code 1 when the run
    refuses, 2 when there is no such run.
    """
    parameters = _parameters(param)
    _ask(run, as_json, lambda client: client.load(name, node=node, **parameters))


def swap(
    name: Name,
    at_cycle: Annotated[
        bool,
        typer.Option("--at-cycle/--now", help="At the start of the next whisk cycle, or at once."),
    ] = False,
    blend: Annotated[float, typer.Option(help="s to go from the old commands to the new.")] = 0.0,
    param: Params = None,
    node: Of = "whisk",
    run: Run = None,
    as_json: Json = False,
) -> None:
    """Give the drives to a controller, loading it first if it is not in shadow yet.

    With --node slam, make another SLAM the run's from the next whisk cycle on. With --node arm,
    NAME is the circuits (letters C and A) in place of those that have not begun.

    The one before stays in shadow for `vibrissa rollback`. Exit code 1 when the run refuses: the
    newcomer is not on time, too far from the last command, another swap is under way, ...
    """
    parameters = _parameters(param)
    when = "cycle" if at_cycle else "now"
    _ask(run, as_json, lambda client: client.swap(name, when, blend, node=node, **parameters))


def rollback(run: Run = None, as_json: Json = False) -> None:
    """Give the drives back to the controller that the last swap replaced."""
    _ask(run, as_json, lambda client: client.rollback())


def unload(name: Name, node: Of = "whisk", run: Run = None, as_json: Json = False) -> None:
    """End a controller that is in shadow. The run's first controller stays."""
    _ask(run, as_json, lambda client: client.unload(name, node=node))


def set_(
    key: Annotated[str, typer.Argument(metavar="NODE.KEY", help="For instance rcp.gain.")],
    value: Annotated[str, typer.Argument(help="A number, true, false, or a word.")],
    run: Run = None,
    as_json: Json = False,
) -> None:
    """Change a parameter of a running controller; it checks the range. Recorded with its tick."""
    from vibrissa.processes.results import RunError

    node, dot, name = key.rpartition(".")
    if not (node and dot and name):
        raise RunError(f"{key!r}: expected NODE.KEY, for instance rcp.gain")
    _ask(run, as_json, lambda client: client.set(node, name, _value(value)))


def _client(run: Path | None) -> Client:
    from vibrissa.processes.client import Client

    return Client(run)


def _ask(run: Path | None, as_json: bool, request: Any) -> None:
    """Put one request to a run and print what came of it."""
    from vibrissa.processes.client import RefusedError

    with _client(run) as client:
        try:
            text, accepted = request(client), True
        except RefusedError as refusal:
            text, accepted = str(refusal), False
    if as_json:
        print_json({"accepted": accepted, "text": text})
    elif accepted:
        stdout().print(text, markup=False)
    if not accepted:
        fail(text)
        raise typer.Exit(REFUSED)


def _parameters(texts: list[str] | None) -> dict[str, Any]:
    from vibrissa.processes.results import RunError

    found = {}
    for text in texts or ():
        key, equals, value = text.partition("=")
        if not (equals and key.isidentifier()):
            raise RunError(f"--param {text}: expected KEY=VALUE")
        found[key] = _value(value)
    return found


def _value(text: str) -> float | bool | str:
    """A number or true or false where it reads as one, else the text itself."""
    try:
        value = json.loads(text)
    except ValueError:
        return text
    return value if isinstance(value, (bool, int, float)) else text


VERBS = (
    (controllers, "vibrissa controllers --json"),
    (load, "vibrissa load rcp --param gain=5"),
    (swap, "vibrissa swap open_loop --at-cycle --blend 0.1"),
    (rollback, "vibrissa rollback"),
    (unload, "vibrissa unload open_loop"),
    (set_, "vibrissa set rcp.gain 4"),
)
