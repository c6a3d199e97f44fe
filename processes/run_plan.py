"""What a live run stands on: its folders, its signals, and who is where."""

from __future__ import annotations

import contextlib
import shutil
import signal
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from vibrissa.processes import provenance
from vibrissa.processes.config import Experiment
from vibrissa.processes.kinds import scheduled_slots
from vibrissa.processes.layout import Layout
from vibrissa.processes.results import RunError
from vibrissa.processes.table import ALL_SLOTS, DEVICES, PROCESSES


@contextlib.contextmanager
def run_folder(out: Path, recorded: Callable[[], bool]) -> Iterator[Path]:
    """Make the directory of a run; gives a private one for its sockets.

    A run that ends with RunError leaves no directory, unless something was recorded.
    """
    try:
        out.mkdir(parents=True)
    except FileExistsError:
        raise RunError(f"{out}: exists; a run never overwrites another") from None
    except OSError as error:
        raise RunError(f"{out}: {error.strerror}") from None
    folder = Path(tempfile.mkdtemp(prefix="vibrissa-"))
    try:
        yield folder
    except RunError:
        with contextlib.suppress(OSError):
            if not recorded():
                (out / "run.mcap").unlink(missing_ok=True)
            out.rmdir()
        raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def on_signals(interrupt: Callable[[], None]) -> Iterator[None]:
    """Call `interrupt` for Ctrl-C and for a polite kill."""
    with contextlib.ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM):
            with contextlib.suppress(ValueError):  # not the main thread: nothing to catch
                old = signal.signal(number, lambda *_: interrupt())
                stack.callback(signal.signal, number, old)
        yield


def layout_of_run(
    experiment: Experiment, folder: Path, out: Path, devices: Mapping[str, str]
) -> Layout:
    """Processes, end points and log of a live run. Raises RunError for a port in use."""
    run = experiment.run
    of_rig = "rig" if experiment.rig.virtual else "head-device"
    groups = [
        [of_rig if n == "rig" else n for n in PROCESSES if n in group] for group in run.together
    ]
    together = {n: "+".join(group) for group in groups for n in group}
    nodes = [name for name in PROCESSES if experiment.rig.virtual or name != "rig"]
    alone = nodes if experiment.rig.virtual else [*DEVICES, *nodes]
    hosts = {host: host.split("+") for host in (together.get(name, name) for name in alone)}
    names = ["control", "supervisor", "recorder", *hosts, *ALL_SLOTS]
    if run.transport == "tcp":
        endpoints = {n: f"tcp://127.0.0.1:{run.tcp_port + i}" for i, n in enumerate(names)}
        for name, endpoint in endpoints.items():
            _check_free(name, int(endpoint.rpartition(":")[2]))
    else:
        endpoints = {n: f"ipc://{folder}/{n}" for n in names}
    text = experiment.model_dump_json()
    meta = provenance.metadata(text, "live")
    meta |= {"nodes": ",".join([*nodes, *scheduled_slots(experiment)])}
    meta["run_id"] = f"{meta['config_hash'][:12]}-{time.time_ns():x}"
    log = str(out.absolute() / "run.mcap")
    return Layout(hosts, endpoints, text, log, meta, devices=dict(devices))


def _check_free(name: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise RunError(
                f"run.tcp_port: port {port} (for {name}) can't be used: {error.strerror}"
            ) from None
