"""Entry point of the processes of a live run: `python -m vibrissa.processes.main NAME DIR`."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path

import zmq

from vibrissa.messages.errors import MessageError
from vibrissa.messages.log_format import LogError
from vibrissa.processes.control import ControlLine
from vibrissa.processes.layout import Layout
from vibrissa.processes.results import RunError
from vibrissa.processes.table import DEVICES
from vibrissa.rig.devices.errors import DeviceError


def main() -> None:
    """Run the named process of the layout in the given run directory."""
    name, folder = sys.argv[1], Path(sys.argv[2])
    own = folder / f"layout-{name}.json"
    layout = Layout.read(own if own.exists() else folder / "layout.json")
    try:
        if name == "recorder":
            from vibrissa.processes import recorder

            recorder.main(layout)
        elif DEVICES.keys() & layout.hosts.get(name, []):
            from vibrissa.processes import pump

            pump.main(name, layout)
        else:
            from vibrissa.processes import host

            host.main(name, layout)
    except (MessageError, LogError, RunError, DeviceError) as error:
        report_failure(layout.endpoints["control"], name, str(error))
        sys.exit(2)
    except Exception as error:
        traceback.print_exc()
        report_failure(layout.endpoints["control"], name, f"{type(error).__name__}: {error}")
        sys.exit(1)


def report_failure(endpoint: str, name: str, cause: str) -> None:
    """Tell the supervisor why this process can't run."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    line = ControlLine(context, endpoint, name)
    line.say("fault", cause=cause[:400])
    line.close()
    context.term()


if __name__ == "__main__":
    main()
