"""A simulated run and a verify of a recorded one, as digests: run in other environments.

Arguments: the recorded log, and a folder for the simulated one. Prints three digests: the simulated
log, message by message; the same run by whole whisk cycles, its ticks and its views; and what a
verify of the recorded log finds.
"""

import hashlib
import sys
from pathlib import Path

import numpy as np

from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.topics import TOPICS
from vibrissa.processes.cycle import WhiskLoop, setup
from vibrissa.processes.framelog import frame_of
from vibrissa.processes.rebuild import experiment_of, open_log
from vibrissa.processes.simulate import simulate
from vibrissa.processes.verify import verify
from vibrissa.processes.views import views


def digests(log: Path, folder: Path) -> list[str]:
    experiment = experiment_of(open_log(log))
    messages, cycles = hashlib.sha256(), hashlib.sha256()
    simulate(experiment, folder)
    for record in LogReader(folder / "run.mcap"):
        if TOPICS[record.topic].compared:
            messages.update(frame_of(record))
    loop = WhiskLoop(setup(experiment))
    for cycle in loop.cycles():
        for signal in (cycle.theta, cycle.x, cycle.y, cycle.applied, cycle.command):
            cycles.update(signal.tobytes())
        cycles.update(cycle.impingement.tobytes() + cycle.slips.tobytes())
    for view in views(WhiskLoop(setup(experiment))):
        cycles.update(view.images.max_angle_gated.tobytes() + view.images.contact_angle.tobytes())
        cycles.update(np.array(view.truth).tobytes())
    verdict = verify(log)
    found = f"{verdict.identical} {verdict.steps} {verdict.compared_bytes} {verdict.notes}"
    return [messages.hexdigest(), cycles.hexdigest(), found]


if __name__ == "__main__":
    print("\n".join(digests(Path(sys.argv[1]), Path(sys.argv[2]))))
