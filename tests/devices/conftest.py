"""One bench per kind of device, shared by the tests of a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from tests.devices.benches import MAKERS, HeadBench


@pytest.fixture(scope="module")
def head_benches() -> Iterator[Callable[[str], HeadBench]]:
    made: dict[str, HeadBench] = {}

    def get(name: str) -> HeadBench:
        if name not in made:
            made[name] = MAKERS[name]()
        return made[name]

    yield get
    for bench in made.values():
        bench.close()
