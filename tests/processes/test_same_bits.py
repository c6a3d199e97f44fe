"""A data set and a verify give the same bytes on machines of other kinds."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import Recorded
from tests.processes.simulated_bytes import digests

SCRIPT = Path(__file__).with_name("simulated_bytes.py")
NO_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-FMA4"}
OLDEST = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", **NO_FMA}


@pytest.fixture(scope="module")
def here(simulated_run: Recorded, tmp_path_factory) -> list[str]:
    return digests(simulated_run.log, tmp_path_factory.mktemp("here") / "run")


@pytest.mark.parametrize(
    "environment",
    [
        NO_FMA,
        OLDEST,
        {"OPENBLAS_NUM_THREADS": "1"},
        {"OPENBLAS_NUM_THREADS": "2"},
    ],
)
def test_other_machines_give_the_same_bytes(
    environment: dict[str, str], here: list[str], simulated_run: Recorded, tmp_path: Path, request
) -> None:
    if environment is OLDEST:  # what is compiled for it must not land in the usual cache
        cache = request.config.cache.mkdir("numba-generic")
        environment = {**OLDEST, "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(simulated_run.log), str(tmp_path / "run")],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert here[2].startswith("True")
    assert done.stdout.splitlines() == here
