"""The simulated rig gives the same bytes on machines of other kinds and with nothing skipped."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("simulated_stretch.py")
NO_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA"}


def digest(how: str, environment: dict[str, str]) -> str:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), how],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


@pytest.fixture(scope="module")
def here() -> str:
    return digest("skip", {})


@pytest.mark.parametrize(
    "environment", [NO_FMA, {"OPENBLAS_NUM_THREADS": "1"}, {"OPENBLAS_NUM_THREADS": "2"}]
)
def test_other_libraries_give_the_same_bytes(here: str, environment: dict[str, str]) -> None:
    assert digest("skip", environment) == here


def test_a_processor_of_the_oldest_kind_gives_the_same_bytes(here: str, request) -> None:
    # Compiled code of another processor must not land in the cache of this one.
    cache = request.config.cache.mkdir("numba-generic")
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(cache)}
    assert digest("skip", generic) == here


def test_skipping_nothing_gives_the_same_bytes(here: str) -> None:
    assert digest("everything", {}) == here


def test_the_check_can_fail() -> None:
    # A cosine of the C library differs where its FMA variant is switched off.
    if digest("libm", {}) == digest("libm", NO_FMA):
        pytest.skip("this machine's C library has no FMA variant")
