"""Steppers in processes of their own, reached over real sockets: the lockstep workers.

A worker is asked for a batch of steps at a time and answers with the digest and the output frames
of each. Because it runs the same `Stepper` as every other executor, it gives the same bytes.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgpack
import zmq

from vibrissa.messages.codec import header
from vibrissa.processes import realtime
from vibrissa.processes.config import Experiment
from vibrissa.processes.node import Step, Stepper
from vibrissa.processes.rebuild import Replacements, make_stepper
from vibrissa.processes.results import RunError

ANSWER_S = 120


class LocalRunner:
    """Steps a node in this process."""

    def __init__(self, stepper: Stepper) -> None:
        self.name = stepper.name
        self._stepper = stepper
        self._frames: Sequence[bytes] = ()

    def submit(self, frames: Sequence[bytes]) -> None:
        """Hand over a batch."""
        self._frames = frames

    def collect(self) -> list[tuple[int, Sequence[bytes]]]:
        """(digest, outputs) of every step of the batch."""
        step = self._stepper.step
        results = [step(frame) for frame in self._frames]
        self._frames = ()
        return [(r.digest, r.outputs) for r in results]


class RemoteRunner:
    """Steps a node in a worker process."""

    def __init__(self, name: str, process: subprocess.Popen[bytes], socket: zmq.Socket[bytes]):
        self.name = name
        self._process = process
        self._socket = socket
        self._asked = False

    def submit(self, frames: Sequence[bytes]) -> None:
        self._asked = bool(frames)
        if frames:
            self._socket.send(msgpack.packb(list(frames)))

    def collect(self) -> list[tuple[int, Sequence[bytes]]]:
        if not self._asked:
            return []
        for _ in range(ANSWER_S * 10):
            if self._socket.poll(100):
                answer = msgpack.unpackb(self._socket.recv())
                if isinstance(answer, str):
                    raise RunError(f"{self.name}: {answer}")
                return [(digest, outputs) for digest, outputs in answer]
            if self._process.poll() is not None:
                break
        raise RunError(f"{self.name}: its worker process gave no answer")

    def step(self, frame: bytes) -> Step:
        """One step at a time, for a `Group` whose members are elsewhere."""
        topic, source, epoch, seq, t = header(frame)
        self.submit([frame])
        ((digest, outputs),) = self.collect()
        return Step((topic, source, epoch), seq, t, outputs, digest)


@contextlib.contextmanager
def workers(
    names: Iterable[str], experiment: Experiment, replacements: Replacements
) -> Iterator[dict[str, RemoteRunner]]:
    """A running worker for each node, ended on leaving."""
    folder = Path(tempfile.mkdtemp(prefix="vibrissa-"))
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    runners: dict[str, RemoteRunner] = {}
    processes = []
    try:
        (folder / "experiment.json").write_text(experiment.model_dump_json())
        for name in names:
            socket = context.socket(zmq.PAIR)
            socket.set(zmq.SNDHWM, 0)
            endpoint = f"ipc://{folder}/{name}"
            socket.bind(endpoint)
            command = [sys.executable, "-m", "vibrissa.processes.lockstep", name, str(folder)]
            command += [replacements[name]] if name in replacements else []
            environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
            process = subprocess.Popen(command, env=environment)
            processes.append(process)
            runners[name] = RemoteRunner(name, process, socket)
        for runner in runners.values():
            runner.submit([b""])
            runner.collect()  # an empty frame asks "are you there?"
        yield runners
    finally:
        for process in processes:
            process.kill()
            process.wait()
        context.destroy(linger=0)
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    """Entry point of a worker: NODE FOLDER [module:Class]."""
    realtime.die_with_parent()
    name, folder, *replaced = sys.argv[1:]
    experiment = Experiment.model_validate_json((Path(folder) / "experiment.json").read_text())
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.PAIR)
    socket.set(zmq.SNDHWM, 0)
    socket.connect(f"ipc://{folder}/{name}")
    try:
        stepper = make_stepper(
            name, experiment, dict.fromkeys([name], *replaced) if replaced else {}
        )
    except RunError as error:
        socket.recv()
        socket.send(msgpack.packb(str(error)))
        socket.close()
        context.term()
        return
    while True:
        frames = msgpack.unpackb(socket.recv())
        answers: list[tuple[int, Sequence[bytes]]] = []
        for frame in frames:
            if frame:
                step = stepper.step(frame)
                answers.append((step.digest, step.outputs))
        socket.send(msgpack.packb(answers))


if __name__ == "__main__":
    main()
