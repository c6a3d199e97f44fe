"""A client of a live run, for scripts and notebooks; the command line uses it too.

from vibrissa.processes.client import Client

with Client() as run:
    run.swap("open_loop", when="cycle")
    run.rollback()
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zmq

from vibrissa.processes.control import ControlLine
from vibrissa.processes.registry import control_endpoint, live_endpoints
from vibrissa.processes.results import RunError

LOOK_S = 1.0
PATIENCE_S = 180.0
"""Loading a controller may include compiling it."""


class RefusedError(RunError):
    """A request that the run refused, with its reason; nothing has changed."""


class Client:
    """Asks a live run to do something; methods raise RefusedError with the reason of a refusal.

    They raise RunError when there is no such run, or none any more.
    """

    def __init__(self, run: Path | None = None) -> None:
        """Connect to the run that writes to directory `run`, or to the only live one."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        name = f"client-{os.getpid()}-{id(self):x}"
        try:
            self._endpoint = control_endpoint(run)
            self._line = ControlLine(self._context, self._endpoint, name)
        except Exception:
            self._context.destroy(linger=0)
            raise

    def start(self) -> str:
        """The operator's explicit start of a run with real devices, which waits for it."""
        return self._ask("start")[0]

    def controllers(self) -> dict[str, Any]:
        """What is installed and what is loaded, with the state and record of each."""
        return self._ask("controllers")[1]

    def load(self, name: str, *, node: str = "whisk", **parameters: float | bool | str) -> str:
        """Have a controller answer in shadow, or (node "slam") a SLAM, beside the active one."""
        return self._ask("load", name=name, node=node, parameters=_as_json(parameters))[0]

    def swap(
        self,
        name: str,
        when: str = "now",
        blend: float = 0.0,
        *,
        node: str = "whisk",
        **parameters: float | bool | str,
    ) -> str:
        """Give the drives to a controller, loading it first if need be.

        when: "now" or "cycle" (at the start of the next whisk cycle); blend: s. With node "slam",
        make another SLAM the run's from the next whisk cycle on; with node "arm", `name` is the
        circuits (letters C and A) that take the place of those that have not begun.
        """
        return self._ask(
            "swap",
            name=name,
            node=node,
            when=when,
            blend=blend,
            parameters=_as_json(parameters),
        )[0]

    def rollback(self) -> str:
        """Give the drives back to the previous controller."""
        return self._ask("rollback")[0]

    def unload(self, name: str, *, node: str = "whisk") -> str:
        """End a controller (node "slam": a SLAM) in shadow."""
        return self._ask("unload", name=name, node=node)[0]

    def set(self, node: str, key: str, value: float | bool | str) -> str:
        """Change a parameter of a running node."""
        return self._ask("set", node=node, key=key, value=json.dumps(value))[0]

    def close(self) -> None:
        """Let go of the run, which goes on."""
        self._line.close()
        self._context.destroy(linger=0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _ask(self, verb: str, **arguments: Any) -> tuple[str, dict[str, Any]]:
        self._line.say("ask", verb=verb, arguments=arguments)
        deadline = time.monotonic() + PATIENCE_S
        while (answer := self._line.hear(LOOK_S)) is None:
            if self._endpoint not in live_endpoints():
                raise RunError(f"{verb}: the run has ended")
            if time.monotonic() > deadline:
                raise RunError(f"{verb}: the run did not answer within {PATIENCE_S:g} s")
        if not answer["accepted"]:
            raise RefusedError(answer["text"])
        return answer["text"], answer["data"]


def _as_json(parameters: dict[str, float | bool | str]) -> str:
    return json.dumps(parameters) if parameters else ""
