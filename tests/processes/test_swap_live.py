"""Live runs in which controllers are swapped and go wrong; what is asserted is read from the log.

The machine may be busy, so nothing is said about when something happens, and a controller without a
fault may be late now and then; what may never happen is told in ticks and messages.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.processes.live import children
from tests.processes.swaps import Live, events, experiment, faulty, live, owners, samples, swap
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes import supervisor
from vibrissa.processes.client import RefusedError
from vibrissa.processes.config import Experiment
from vibrissa.processes.realtime import SHADOW_NICE, privileges
from vibrissa.processes.table import SLOTS
from vibrissa.processes.verify import verify

PATIENCE_TICKS = 20
"""Samples without an answer after which the built-in controller takes over."""


@pytest.fixture(autouse=True)
def run_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Short paths for sockets, and no process left."""
    folder = Path(tempfile.mkdtemp(prefix="runs-"))
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield
    shutil.rmtree(folder)
    assert children() == {}


def slot_of(run: Live, name: str) -> str:
    with run.client() as client:
        return next(r["slot"] for r in client.controllers()["loaded"] if r["controller"] == name)


def at_once(*actions: Any) -> list[Any]:
    """What actions give, or the refusals they raise, done in threads of their own."""
    found: list[Any] = [None] * len(actions)
    start = threading.Barrier(len(actions))

    def do(number: int) -> None:
        start.wait()
        try:
            found[number] = actions[number]()
        except RefusedError as refusal:
            found[number] = refusal

    threads = [threading.Thread(target=do, args=(i,)) for i in range(len(actions))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def load(run: Live, name: str) -> Any:
    def action() -> str:
        with run.client() as client:
            return client.load(name)

    return action


def nothing_lost(made: Experiment, out: Path, summary: dict[str, Any]) -> None:
    """Sampling and recording went on, everything said arrived, and the log re-runs."""
    ticks = samples(out)
    assert ticks == list(range(ticks[-1] + 1)) and summary["ticks"] == len(ticks)
    assert all(m["lost"] == 0 for m in summary["messages"].values())
    reader = LogReader(out / "run.mcap")
    assert sum(1 for _ in reader) and reader.complete
    verdict = verify(out / "run.mcap")
    assert verdict.identical, verdict.first_difference
    assert not [note for note in verdict.notes if "to the last complete steps" in note]


def test_newcomers_that_fail_are_refused_by_name_and_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = experiment(
        tmp_path,
        duration=300.0,
        broken="tests.controller_that_throws_on_import:Broken",
        hasty=faulty("ThrowsAtOnce"),
        mortal=faulty("KilledInShadow"),
        noisy=faulty("Floods"),
        never=faulty("NeverReady"),
    )
    out = tmp_path / "run"
    with live(made, out) as run:
        broken, hasty, mortal, noisy = at_once(
            *(load(run, name) for name in ("broken", "hasty", "mortal", "noisy"))
        )
        assert isinstance(broken, RefusedError) and isinstance(hasty, RefusedError)
        assert "broken could not be loaded" in str(
            broken
        ) and "OSError: calibration table not found" in str(broken)
        assert "hasty could not be loaded: ZeroDivisionError: no first step" in str(hasty)
        for answer in (mortal, noisy):
            assert isinstance(answer, str) and answer.endswith("answers in shadow")
        run.told("lost", mortal.split("(")[1].split(")")[0], "SIGKILL")
        run.told("lost", noisy.split("(")[1].split(")")[0], "flooded")
        monkeypatch.setattr(supervisor, "LOAD_S", 2.0)
        (never,) = at_once(load(run, "never"))
        assert "never could not be loaded" in str(never) and "was not ready after 2 s" in str(never)
        with run.client() as client, pytest.raises(RefusedError, match="unknown controller 'x'"):
            client.swap("x")
    summary = run.summary
    assert summary["cause"] == "interrupted by the operator"
    assert set(owners(out).values()) <= {"whisk", "retract"}
    told = events(out)
    assert not [why for _, kind, why in told if kind == "switched"]
    assert all(why.startswith("sampler whisk#0") for _, kind, why in told if kind == "fallback")
    assert {why.split()[0] for _, kind, why in told if kind == "lost"} <= set(SLOTS)
    nothing_lost(made, out, summary)


def test_whatever_happens_to_the_active_controller_the_drives_are_never_without_one(
    tmp_path: Path,
) -> None:
    faults = {
        "killed": "Killed",
        "stopped": "Stopped",
        "late": "Late",
        "stale": "SaysStaleTicks",
        "forger": "Forger",
    }
    made = experiment(tmp_path, duration=300.0, **{n: faulty(f) for n, f in faults.items()})
    out = tmp_path / "run"
    slots = {}
    with live(made, out) as run, run.client() as client:
        at_once(load(run, "forger"), load(run, "stale"))
        for name in ("stale", "late", "killed", "stopped"):
            client.load(name)
            slots[name] = slot_of(run, name)
            swap(client, name)
            run.told("fallback", f"{slots[name]}#0")
            swap(client, "open_loop")
            if name in ("stale", "late"):
                client.unload(name)
        slots["forger"] = slot_of(run, "forger")
        scheduled_as_told(run, client, slots["forger"])
        run.told("refused", "of whisk:", "found #1000000")
        one_of_two_wins(run)
    told = events(out)
    got = owners(out)
    ticks = samples(out)
    for name in ("killed", "stopped", "late", "stale"):
        fallen = [tick for tick, kind, why in told if kind == "fallback" and slots[name] in why]
        switched = [tick for tick, kind, why in told if kind == "switched" and slots[name] in why]
        assert fallen and fallen[0] > switched[0], name
        last = max(tick for tick, who in got.items() if who == slots[name] and tick < fallen[0])
        missed = [tick for tick in ticks if last < tick < fallen[0]]
        assert len(missed) <= PATIENCE_TICKS, (name, last, fallen[0])
        assert got[fallen[0]] == "retract", name
    lost = [why for _, kind, why in told if kind == "lost"]
    assert [name for name in ("killed", "stopped") if any(slots[name] in why for why in lost)] == [
        "killed",
        "stopped",
    ]
    assert all(what in owners_in_order(got) for what in slots.values())
    nothing_lost(made, out, run.summary)


def owners_in_order(got: dict[int, str]) -> list[str]:
    """Who had the drives, one after the other."""
    order: list[str] = []
    for _, who in sorted(got.items()):
        if not order or order[-1] != who:
            order.append(who)
    return order


def scheduled_as_told(run: Live, client: Any, slot: str) -> None:
    """A slot runs under SCHED_FIFO while it has the drives, and only then."""
    if not privileges()["SCHED_FIFO"][0]:
        swap(client, slot)
        swap(client, "open_loop")
        return
    pid = run.supervisor.children[slot].popen.pid
    threads = [int(name) for name in os.listdir(f"/proc/{pid}/task")]

    def ordinary() -> bool:
        return all(
            os.sched_getscheduler(t) == os.SCHED_OTHER
            and os.getpriority(os.PRIO_PROCESS, t) == SHADOW_NICE
            for t in threads
        )

    def promoted() -> bool:
        return all(
            os.sched_getscheduler(t) == os.SCHED_FIFO
            and os.sched_getparam(t).sched_priority == SLOTS[slot].priority
            for t in threads
        )

    assert len(threads) > 1 and ordinary()
    swap(client, slot)
    run.until(promoted)
    swap(client, "open_loop")
    run.until(ordinary)


def one_of_two_wins(run: Live) -> None:
    """Two clients ask for the next whisk cycle; the later hears who was first, and when."""

    def ask() -> str:
        with run.client() as client:
            return client.swap("forger", when="cycle")

    for _ in range(20):
        answers = at_once(ask, ask)
        won = [answer for answer in answers if isinstance(answer, str)]
        refusals = [str(answer) for answer in answers if isinstance(answer, RefusedError)]
        if len(won) == 1 and any("already switching: to whisk." in text for text in refusals):
            return
        with run.client() as client:
            swap(client, "open_loop")
    pytest.fail("the two requests never met")
