"""Who runs where in a live run: processes, the nodes they host, and their endpoints."""

from __future__ import annotations

import collections
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from vibrissa.messages.topics import TOPICS
from vibrissa.messages.transport import BUNDLE
from vibrissa.processes.table import ALL_SLOTS, PUBLISHED_BY_HOSTS, ROWS

SUPERVISOR_SAYS = ("run.calibration", "run.event", "run.order")
SUPERVISOR_HEARS = (
    "head.owner",
    "head.shadow",
    "node.answer",
    "node.event",
    "node.telemetry",
    "rig.event",
    "slam.owner",
    "whisk.calibration",
    "whisk.failure",
)


@dataclass(frozen=True, slots=True)
class Layout:
    """The processes of a run and their endpoints; every process reads the same one."""

    hosts: dict[str, list[str]]
    """process name -> nodes it hosts, in order."""
    endpoints: dict[str, str]
    """process name, "supervisor", "recorder" or "control" -> endpoint."""
    experiment: str = field(repr=False)
    """The experiment as JSON."""
    log: str
    """Path of the log the recorder writes."""
    metadata: dict[str, str]
    """What the log says about the run."""
    controllers: dict[str, str] = field(default_factory=dict)
    """slot -> the controller its process is to be warm for"""
    devices: dict[str, str] = field(default_factory=dict)
    """"head" and "arm" -> URL to open; "tell" -> port at which an emulated head takes its pose"""

    def write(self, path: Path) -> None:
        path.write_text(json.dumps(asdict(self)))

    @staticmethod
    def read(path: Path) -> Layout:
        return Layout(**json.loads(path.read_text()))

    def says(self, process: str) -> list[str]:
        """Topics a process publishes."""
        if process == "supervisor":
            return list(SUPERVISOR_SAYS)
        if process == "recorder":
            return []
        nodes = self.hosts.get(process, [process])
        return sorted({t for n in nodes for t in ROWS[n].says} | set(PUBLISHED_BY_HOSTS))

    def hears(self, process: str) -> list[str]:
        """Topics a process subscribes to at the others."""
        if process == "supervisor":
            return list(SUPERVISOR_HEARS)
        if process == "recorder":
            return [t.name for t in TOPICS.values() if t.recorded]
        nodes = self.hosts.get(process, [process])
        wanted = {t for n in nodes for t in ROWS[n].hears}
        return sorted(t for t in wanted if self.speakers(t) - {process})

    def speakers(self, topic: str) -> set[str]:
        """Processes that publish a topic; a host's own events reach its nodes directly."""
        if topic in PUBLISHED_BY_HOSTS:
            return set()
        return {p for p in self._publishers() if topic in self.says(p)}

    def _publishers(self) -> list[str]:
        """Everybody who may publish in this run, slots that are empty yet included."""
        return list(dict.fromkeys(["supervisor", *self.hosts, *ALL_SLOTS]))

    def bundled(self, process: str) -> bool:
        """Whether a process takes what it hears in bundles: nothing in it reacts at once."""
        nodes = self.hosts.get(process, [])
        return process == "recorder" or (
            bool(nodes) and all(ROWS[n].pacing == "drain" for n in nodes)
        )

    def connections(self, process: str) -> list[str]:
        """Endpoints a process must connect to for what it hears."""
        if process == "recorder":
            names = self._publishers()
        else:
            wanted = {p for t in self.hears(process) for p in self.speakers(t)} - {process}
            names = [p for p in self._publishers() if p in wanted]
        return [self.endpoints[name] for name in names]

    def audience(self, process: str) -> dict[str, int]:
        """How many listeners each topic of a process must have before the run may start."""
        listeners = [p for p in ("supervisor", "recorder", *self.hosts) if p != process]
        endpoint = self.endpoints[process]
        heard: collections.Counter[str] = collections.Counter()
        for other in listeners:
            if endpoint in self.connections(other):
                said = [t for t in self.hears(other) if t in self.says(process)]
                heard.update([BUNDLE] if self.bundled(other) else said)
        return dict(heard)
