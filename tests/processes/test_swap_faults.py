"""A controller goes wrong while it has the drives: who takes over, and at which tick."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.processes.swaps import events, experiment, faulty, identical, owners
from vibrissa.processes.simulate import simulate

PERIOD = 800
SWAP_CYCLE = 2
GETS_DRIVES = SWAP_CYCLE * PERIOD
GOES_WRONG = GETS_DRIVES + 100


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("ThrowsWhenActive", "RuntimeError: whisker motors are on fire (controllers_for_tests.py,"),
        ("SaysNaN", "whisker 4 (front ring) commanded to nan rad, expected in [0, 6.3]"),
        ("SaysTooMuch", "whisker 0 (front ring) commanded to 1.62833 rad"),
        ("SaysFarTooMuch", "whisker 0 (front ring) commanded to 1e+06 rad, expected in [0, 6.3]"),
        ("SaysTooLittle", "wrong length: command of shape (17,), expected (18,)"),
        ("SaysNothing", "wrong length: command of shape (), expected (18,)"),
        ("SaysWords", "answered with str, expected 18 angles"),
    ],
)
def test_what_no_drive_may_get_is_answered_in_the_same_tick(
    fault: str, cause: str, tmp_path: Path
) -> None:
    made = experiment(tmp_path, duration=1.6, swaps=((SWAP_CYCLE, "bad"),), bad=faulty(fault))
    out = tmp_path / "run"
    summary = simulate(made, out)
    told = events(out)
    switched = [tick for tick, kind, _ in told if kind == "switched"]
    fallen = [(tick, why) for tick, kind, why in told if kind == "fallback"]
    assert switched == [GETS_DRIVES]
    ((tick, why),) = fallen
    assert tick == GOES_WRONG
    assert cause in why
    got = owners(out)
    assert list(got) == list(range(made.ticks)) and summary["ticks_answered"] == made.ticks
    assert {got[t] for t in range(GETS_DRIVES, GOES_WRONG)} == {"whisk.1"}
    assert {got[t] for t in range(GOES_WRONG, made.ticks)} == {"retract"}
    assert identical(out)


def test_a_controller_that_fails_is_named_once_and_never_asked_again(tmp_path: Path) -> None:
    made = experiment(
        tmp_path, duration=1.6, swaps=((SWAP_CYCLE, "bad"),), bad=faulty("ThrowsWhenActive")
    )
    simulate(made, tmp_path / "run")
    failures = [(t, why) for t, kind, why in events(tmp_path / "run") if kind == "failed"]
    assert [(t, why.split()[0]) for t, why in failures] == [(GOES_WRONG, "whisk.1")]


@pytest.mark.parametrize(
    ("fault", "cause"),
    [("ThrowsAtOnce", "ZeroDivisionError: no first step"), ("ThrowsInShadow", "RuntimeError")],
)
def test_a_newcomer_that_fails_in_shadow_never_gets_the_drives(
    fault: str, cause: str, tmp_path: Path
) -> None:
    late = 4  # cycles: after the failure in shadow
    made = experiment(tmp_path, duration=2.4, swaps=((late, "bad"),), bad=faulty(fault))
    out = tmp_path / "run"
    summary = simulate(made, out)
    told = events(out)
    assert [why for _, kind, why in told if kind == "failed" and cause in why]
    assert not [why for _, kind, why in told if kind in ("switched", "fallback")]
    assert {name for tick, name in owners(out).items() if tick < made.retract_tick} == {"whisk"}
    assert summary["cause"] == "completed"
    assert identical(out)


def test_after_a_fallback_another_controller_takes_over_as_scheduled(tmp_path: Path) -> None:
    made = experiment(
        tmp_path,
        duration=2.6,
        swaps=((SWAP_CYCLE, "bad"), (SWAP_CYCLE + 2, "open_loop")),
        bad=faulty("SaysNaN"),
    )
    simulate(made, tmp_path / "run")
    got = owners(tmp_path / "run")
    back = (SWAP_CYCLE + 2) * PERIOD
    assert got[back - 1] == "retract"
    assert {got[t] for t in range(back, made.retract_tick)} == {"whisk"}
    assert identical(tmp_path / "run")


def test_a_run_whose_last_controller_failed_ends_and_says_so(tmp_path: Path) -> None:
    folder = tmp_path / "e"
    folder.mkdir()
    path = experiment(folder, duration=2.0, bad=faulty("ThrowsInShadow"))
    alone = path.model_copy(update={"whisk": path.whisk.model_copy(update={"controller": "bad"})})
    summary = simulate(alone, tmp_path / "run")
    assert not summary["ok"]
    assert "no controller left: RuntimeError" in summary["cause"]
    assert summary["ticks"] < alone.ticks
    assert identical(tmp_path / "run")
