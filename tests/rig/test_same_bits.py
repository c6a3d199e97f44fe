"""The simulated rig gives the same bytes with other libraries and with nothing skipped.

On a processor of the oldest kind, see tests/processes/test_same_bits.py.
"""

import os
import subprocess
import sys
from pathlib import Path

import llvmlite.binding
import pytest

SCRIPT = Path(__file__).with_name("simulated_stretch.py")
# Of glibc from 2.33 and before; names it doesn't know are passed over.
NO_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-FMA4"}
HAS_FMA = llvmlite.binding.get_host_cpu_features().get("fma", False)


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


@pytest.fixture(scope="module")
def oldest(request) -> dict[str, str]:
    """A processor of the oldest kind. What is compiled for it must not land in the usual cache."""
    cache = request.config.cache.mkdir("numba-generic")
    return {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(cache)}


@pytest.mark.parametrize(
    "environment", [NO_FMA, {"OPENBLAS_NUM_THREADS": "1"}, {"OPENBLAS_NUM_THREADS": "2"}]
)
def test_other_libraries_give_the_same_bytes(here: str, environment: dict[str, str]) -> None:
    assert digest("skip", environment) == here


def test_skipping_nothing_gives_the_same_bytes(here: str) -> None:
    assert digest("everything", {}) == here


@pytest.mark.skipif(not HAS_FMA, reason="a processor without FMA can't tell")
def test_the_check_can_fail(oldest: dict[str, str]) -> None:
    assert digest("libm", NO_FMA) != digest("libm", {})
    assert digest("fused", oldest) != digest("fused", {})
