"""Steppers in processes of their own, reached over real sockets: the lockstep workers.

A worker is asked for a batch of steps at a time and answers with the digest and the output frames
of each. Because it runs the same `Stepper` as every other executor, it gives the same bytes.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import msgpack
import zmq

from vibrissa.messages.codec import header
from vibrissa.processes import realtime
from vibrissa.processes.config import Experiment
from vibrissa.processes.node import Step, Stepper
from vibrissa.processes.rebuild import Replacements, make_stepper
from vibrissa.processes.results import RunError

ANSWER_S = 120


class Result(NamedTuple):
    """What came of one step of a batch; `error` says why the node could not take it, if so."""

    digest: int
    outputs: Sequence[bytes]
    error: str = ""


def run(stepper: Stepper, frames: Iterable[bytes]) -> list[Result]:
    """The results of a batch, which ends with the first step that fails."""
    results = []
    for frame in frames:
        try:
            step = stepper.step(frame)
        except Exception as error:
            results.append(Result(stepper.digest, (), f"{type(error).__name__}: {error}"))
            break
        results.append(Result(step.digest, step.outputs))
    return results


class LocalRunner:
    """Steps a node in this process."""

    def __init__(self, stepper: Stepper) -> None:
        self.name = stepper.name
        self._stepper = stepper
        self._frames: Sequence[bytes] = ()

    def submit(self, frames: Sequence[bytes]) -> None:
        """Hand over a batch."""
        self._frames = frames

    def collect(self) -> list[Result]:
        """What came of the batch."""
        results = run(self._stepper, self._frames)
        self._frames = ()
        return results


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

    def collect(self) -> list[Result]:
        if not self._asked:
            return []
        for _ in range(ANSWER_S * 10):
            if self._socket.poll(100):
                answer = msgpack.unpackb(self._socket.recv())
                if isinstance(answer, str):
                    raise RunError(f"{self.name}: {answer}")
                return [Result(*result) for result in answer]
            if self._process.poll() is not None:
                break
        raise RunError(f"{self.name}: its worker process gave no answer")

    def step(self, frame: bytes) -> Step:
        """One step at a time, for a `Group` whose members are elsewhere."""
        topic, source, epoch, seq, t = header(frame)
        self.submit([frame])
        ((digest, outputs, error),) = self.collect()
        if error:
            raise RunError(f"{self.name}: {error}")
        return Step((topic, source, epoch), seq, t, outputs, digest)


class Workers:
    """Worker processes for nodes, started one by one and ended together."""

    def __init__(self, experiment: Experiment, replacements: Replacements) -> None:
        self._replacements = replacements
        self._folder = Path(tempfile.mkdtemp(prefix="vibrissa-"))
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._processes: list[subprocess.Popen[bytes]] = []
        (self._folder / "experiment.json").write_text(experiment.model_dump_json())

    def start(self, names: Iterable[str]) -> list[RemoteRunner]:
        """A running, answering worker for each node."""
        runners = [self._start(name) for name in names]
        for runner in runners:
            runner.submit([b""])
            runner.collect()  # an empty frame asks "are you there?"
        return runners

    def _start(self, name: str) -> RemoteRunner:
        socket = self._context.socket(zmq.PAIR)
        socket.set(zmq.SNDHWM, 0)
        socket.bind(f"ipc://{self._folder}/{name}")
        command = [sys.executable, "-m", "vibrissa.processes.lockstep", name, str(self._folder)]
        command += [self._replacements[name]] if name in self._replacements else []
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(command, env=environment)
        self._processes.append(process)
        return RemoteRunner(name, process, socket)

    def close(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait()
        self._context.destroy(linger=0)
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


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
        socket.send(msgpack.packb(run(stepper, filter(None, frames))))


if __name__ == "__main__":
    main()
