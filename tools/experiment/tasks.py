"""The two kinds of task, recording and mapping, their cache, and their share-out over processes."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import zipfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from vibrissa.slam.pose_cells import PoseCellError
from vibrissa.tools.experiment import mapping, recording
from vibrissa.tools.experiment.cache import key_of, load, store
from vibrissa.tools.experiment.mapping import MapCase, run_map
from vibrissa.tools.experiment.recording import Recording, RigCase, record
from vibrissa.tools.experiment.scores import Trace, recognition, scores, touch_quality

RIG_COST: Final = 1.0 / 300.0
"""Rough cost of a second of robot time and of mapping a whisk, s; only for the time left."""
MAP_COST: Final = 0.5e-3
MAP_BATCH: Final = 12


@dataclass(frozen=True)
class Mapped:
    """A finished SLAM run: its scores and, on demand, its trace."""

    rig: RigCase
    case: MapCase
    scores: dict[str, Any]


@dataclass(frozen=True)
class Work:
    """A data set and the SLAM runs over it: what one process does in one go."""

    rig: RigCase
    maps: tuple[MapCase, ...] = ()


def rig_key(rig: RigCase) -> str:
    return key_of("rig", rig.key(), recording.__file__)


def map_key(rig: RigCase, case: MapCase) -> str:
    return key_of("map", case.key(), mapping.__file__, rig_key(rig))


def recorded(folder: Path, rig: RigCase) -> Recording:
    """The data set, from the cache or else made now."""
    stored = load(folder, rig_key(rig))
    if stored is not None:
        return Recording(**stored)
    made = record(rig)
    store(folder, rig_key(rig), made.arrays())
    return made


def mapped(folder: Path, rig: RigCase, case: MapCase) -> dict[str, Any]:
    """The scores of a SLAM run, from the cache or else made now."""
    stored = load(folder, map_key(rig, case))
    if stored is not None:
        return _scores_of(stored)
    try:
        trace = run_map(recorded(folder, rig), case)
    except PoseCellError as error:
        of = f"{rig.controller}, seed {rig.seed}"
        where = f"{of}, {case.image}, noise {case.noise}, control {case.control}"
        raise PoseCellError(f"{where}: {error}") from None
    found = scores(trace)
    store(
        folder,
        map_key(rig, case),
        {
            "experience": trace.experience,
            "reckoned": trace.reckoned,
            "truth": trace.truth,
            "circuit": trace.circuit,
            "map_poses": trace.map_poses,
            "templates": np.array(trace.templates),
            "scores": np.array(json.dumps(found)),
        },
    )
    return found


def trace_of(folder: Path, rig: RigCase, case: MapCase) -> Trace:
    """The trace of a SLAM run that was made before."""
    mapped(folder, rig, case)
    stored = load(folder, map_key(rig, case))
    assert stored is not None
    fields = {name: stored[name] for name in Trace.__dataclass_fields__ if name != "templates"}
    return Trace(**fields, templates=int(stored["templates"]))


def quality(recording_: Recording, circuits: int = 0) -> dict[str, dict[str, Any]]:
    """Image quality of a data set by kind of image, with impingement and slips under `touch`."""
    if circuits:
        recording_ = recording_.chosen(recording_.circuit < circuits)
    found: dict[str, dict[str, Any]] = {
        kind: recognition(recording_.image(kind), recording_.truth, recording_.circuit)
        for kind in recording.IMAGES
    }
    found["touch"] = touch_quality(recording_.impingement, recording_.slips)
    return found


def _scores_of(stored: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(str(stored["scores"]))
    return found


def _prepare() -> None:
    os.nice(5)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers


def _do(folder: Path, work: Work) -> Work:
    if not work.maps or any(not _has(folder, map_key(work.rig, case)) for case in work.maps):
        recorded(folder, work.rig)
    for case in work.maps:
        mapped(folder, work.rig, case)
    return work


def _has(folder: Path, key: str) -> bool:
    file = folder / f"{key}.npz"
    return file.is_file() and zipfile.is_zipfile(file)


def cost(work: Work, seconds: float) -> float:
    """Rough cost of work on a data set of that many seconds of robot time, s of processor time."""
    whisks = seconds  # one per second
    return seconds * RIG_COST + len(work.maps) * whisks * MAP_COST


def missing(folder: Path, works: Iterable[Work]) -> list[Work]:
    """What of the work is not in the cache yet, in batches of a size that shares out well."""
    left = []
    for work in works:
        maps = [case for case in work.maps if not _has(folder, map_key(work.rig, case))]
        made = _has(folder, rig_key(work.rig))
        if not made:
            left.append(Work(work.rig, tuple(maps[:MAP_BATCH])))
            maps = maps[MAP_BATCH:]
        left += [
            Work(work.rig, tuple(maps[k : k + MAP_BATCH])) for k in range(0, len(maps), MAP_BATCH)
        ]
    return left


def run_all(
    folder: Path,
    works: Sequence[Work],
    jobs: int,
    seconds: Callable[[RigCase], float],
    on_done: Callable[[float], None],
) -> None:
    """Do all work that the cache lacks, over `jobs` processes, and tell the cost of each done.

    A data set is made before anything else is done with it. Raises what a task raised; what was
    finished by then is kept, and so it is on an interrupt.
    """
    todo = sorted(missing(folder, works), key=lambda w: -cost(w, seconds(w.rig)))
    if jobs == 1:
        for work in todo:
            _do(folder, work)
            on_done(cost(work, seconds(work.rig)))
        return
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(jobs, context, initializer=_prepare) as pool:
        running: dict[Future[Work], Work] = {}
        making: set[str] = set()
        try:
            while todo or running:
                for work in list(todo):
                    if len(running) >= jobs:
                        break
                    key = rig_key(work.rig)
                    if key in making:
                        continue
                    if not _has(folder, key):
                        making.add(key)
                    todo.remove(work)
                    running[pool.submit(_do, folder, work)] = work
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    work = running.pop(future)
                    making.discard(rig_key(work.rig))
                    future.result()
                    on_done(cost(work, seconds(work.rig)))
        except BaseException:
            for child in set(multiprocessing.active_children()) - others:
                child.terminate()  # what it was writing never appears in the cache
            pool.shutdown(wait=False, cancel_futures=True)
            raise
