"""Live runs in which controllers are swapped and go wrong; what is asserted is read from the log.

The machine may be busy, so nothing is said about when something happens, and a controller without a
fault may be late now and then; what may never happen is told in ticks and messages.
"""

from __future__ import annotations

import functools
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.controllers_for_tests import Ailing
from tests.processes.live import children
from tests.processes.swaps import Live, events, experiment, faulty, live, owners, samples, swap
from vibrissa.messages.log_reader import LogReader
from vibrissa.messages.types import TICK_NS
from vibrissa.processes import supervisor
from vibrissa.processes.client import RefusedError
from vibrissa.processes.realtime import SHADOW_NICE, privileges
from vibrissa.processes.table import SLOTS
from vibrissa.processes.verify import verify
from vibrissa.tools.machine import with_room

pytestmark = pytest.mark.live

TOGETHER = [["rig", "sampler", "whisk"], ["arm", "slam"]]
"""Where newcomers with processes of their own leave no room for one per node."""
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


def nothing_lost(out: Path, summary: dict[str, Any]) -> None:
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
    with live(with_room(made, TOGETHER), out) as run:
        broken, hasty, mortal, noisy = at_once(
            *(load(run, name) for name in ("broken", "hasty", "mortal", "noisy"))
        )
        assert isinstance(broken, RefusedError) and isinstance(hasty, RefusedError)
        assert "broken could not be loaded" in str(
            broken
        ) and "OSError: calibration table not found" in str(broken)
        assert "hasty could not be loaded: ZeroDivisionError: no first step" in str(hasty)
        assert isinstance(mortal, str) and mortal.endswith("answers in shadow")
        run.told("lost", mortal.split("(")[1].split(")")[0], "SIGKILL")
        # it may flood before it is loaded
        assert "answers in shadow" in str(noisy) or "failed as soon as it was loaded" in str(noisy)
        run.told("lost", "flooded")
        monkeypatch.setattr(supervisor, "LOAD_S", 2.0)
        (never,) = at_once(load(run, "never"))
        assert "never could not be loaded" in str(never) and "was not ready after 2 s" in str(never)
        with run.client() as client, pytest.raises(RefusedError, match="unknown controller 'x'"):
            client.swap("x")
    assert run.summary["cause"] == "interrupted by the operator"
    assert set(owners(out).values()) <= {"whisk", "retract"}
    told = events(out)
    assert not [why for _, kind, why in told if kind == "switched"]
    assert all(why.startswith("sampler whisk#0") for _, kind, why in told if kind == "fallback")
    assert {why.split()[0] for _, kind, why in told if kind == "lost"} <= set(SLOTS)
    nothing_lost(out, run.summary)


def test_a_first_controller_that_is_late_stale_or_stopped_is_replaced_within_its_ticks(
    tmp_path: Path,
) -> None:
    made = experiment(
        tmp_path,
        duration=300.0,
        swaps=((10**6, "rcp"),),  # loaded before the start, never due
        controller="ailing",
        ailing=faulty("Ailing"),
    )
    out = tmp_path / "run"
    with live(made, out) as run:
        run.until(lambda: any(e["kind"] == "lost" for e in run.supervisor.events))
    nothing_lost(out, run.summary)
    falls = all_in_time(out)
    got = owners(out)
    calibrated = calibration_tick(out)
    for begins in (Ailing.LATE, Ailing.STALE, Ailing.STILL):
        wrong = calibrated + begins
        if got.get(wrong - 1) == "whisk":  # on a busy machine it may have lost the drives before
            fallen = next(tick for tick, _ in falls if tick >= wrong)
            assert fallen <= wrong + PATIENCE_TICKS + 1, (begins, wrong, fallen)
    assert {who for _, who in falls} == {"whisk#0:"}


def all_in_time(out: Path) -> list[tuple[int, str]]:
    """(tick, who) of every fallback: nobody kept the drives longer than he may without answering.

    Those of a busy machine count as well.
    """
    got, ticks, told = owners(out), samples(out), events(out)
    falls = [(tick, why.split()[1]) for tick, kind, why in told if kind == "fallback"]
    for tick, who in falls:
        slot = who.partition("#")[0]
        began = [t for t, kind, why in told if kind in ("routed", "switched") and who in why]
        last = max(t for t in [*began, *(t for t in got if got[t] == slot)] if t < tick)
        missed = sum(last < t < tick for t in ticks)
        assert missed <= PATIENCE_TICKS and got[tick] == "retract", (who, last, tick)
    return falls


def calibration_tick(out: Path) -> int:
    return next(
        record.t // TICK_NS
        for record in LogReader(out / "run.mcap")
        if record.topic == "whisk.calibration"
    )


def swap_or_skip(client: Any, name: str) -> str:
    """Swap; a newcomer that a machine with other work never lets be on time proves nothing."""
    try:
        return swap(client, name)
    except RefusedError as refusal:
        if any(word in str(refusal) for word in ("not ready", "stale", "active already")):
            pytest.skip(f"the machine is too busy for a controller in shadow: {refusal}")
        raise


def test_a_slot_is_scheduled_by_what_it_has_and_killed_within_its_ticks(tmp_path: Path) -> None:
    made = experiment(tmp_path, duration=300.0, swaps=((10**6, "forger"),), forger=faulty("Forger"))
    out = tmp_path / "run"
    with live(with_room(made, TOGETHER), out) as run, run.client() as client:
        run.told("registered", "whisk.1#0")
        if privileges()["SCHED_FIFO"][0]:
            scheduled_as_told(run, client)
        one_of_two_wins(run, client)
        swap_or_skip(client, "open_loop")
        swap_or_skip(client, "forger")
        slot = slot_of(client, "forger")
        run.told("refused", "of whisk:", "found #1000000")
        os.kill(run.supervisor.children[slot].popen.pid, signal.SIGKILL)
        run.told("lost", slot, "SIGKILL")
    assert f"{slot}#0:" in [who for _, who in all_in_time(out)]
    nothing_lost(out, run.summary)


def slot_of(client: Any, name: str) -> str:
    """The slot of a loaded controller."""
    loaded = client.controllers()["loaded"]
    return str(next(row["slot"] for row in loaded if row["controller"] == name))


def scheduled_as_told(run: Live, client: Any) -> None:
    """A slot runs under SCHED_FIFO while it has the drives, and only then."""
    swap_or_skip(client, "forger")
    slot = slot_of(client, "forger")
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

    assert len(threads) > 1
    run.until(promoted)
    swap_or_skip(client, "open_loop")
    run.until(ordinary)


def one_of_two_wins(run: Live, client: Any) -> None:
    """Two clients ask for the next whisk cycle; the later hears who was first, and when."""
    heard = []
    with run.client() as one, run.client() as other:
        for _ in range(20):
            answers = at_once(
                *(functools.partial(c.swap, "forger", when="cycle") for c in (one, other))
            )
            won = [answer for answer in answers if isinstance(answer, str)]
            refusals = [str(answer) for answer in answers if isinstance(answer, RefusedError)]
            if len(won) == 1 and any("already switching: to whisk." in text for text in refusals):
                return
            heard.append(answers)
            if won:
                swap_or_skip(client, "open_loop")
            run.ticks_from_now(400)  # a newcomer that was late has caught up by then
    pytest.fail(f"the two requests never met: {heard}")
