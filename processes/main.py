"""Entry point of the processes of a live run: `python -m vibrissa.processes.main NAME DIR`."""

from __future__ import annotations

import sys
from pathlib import Path

from vibrissa.messages.errors import MessageError
from vibrissa.messages.log_format import LogError
from vibrissa.processes.layout import Layout
from vibrissa.processes.results import RunError


def main() -> None:
    """Run the named process of the layout in the given run directory."""
    name, folder = sys.argv[1], Path(sys.argv[2])
    layout = Layout.read(folder / "layout.json")
    try:
        if name == "recorder":
            from vibrissa.processes import recorder

            recorder.main(layout)
        else:
            from vibrissa.processes import host

            host.main(name, layout)
    except (MessageError, LogError, RunError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
