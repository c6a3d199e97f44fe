"""The layout of frames does not change unless a version number does."""

from __future__ import annotations

import pytest

from tests.messages.golden import entry, golden, title
from tests.messages.strategies import frame, plain, same
from vibrissa.messages.codec import CODECS, decode
from vibrissa.messages.errors import DecodeError

TITLES = {title(codec) for codec in CODECS.values()}
ADD = "add it with: python -m tests.messages.golden"


@pytest.mark.parametrize("topic", CODECS)
def test_a_type_is_laid_out_as_its_version_always_was(topic: str) -> None:
    codec = CODECS[topic]
    assert title(codec) in golden(), f"{title(codec)} is new; {ADD}"
    then = golden()[title(codec)]
    assert entry(codec)["fields"] == then["fields"], f"{title(codec)} needs a new version number"
    if topic == then["topic"]:
        assert entry(codec)["frame"] == then["frame"], f"{title(codec)} needs a new version number"


@pytest.mark.parametrize("name", golden())
def test_a_frame_of_long_ago_reads_as_what_was_written_or_names_its_version(name: str) -> None:
    raw = bytes.fromhex(str(golden()[name]["frame"]))
    if name in TITLES:
        message = plain(str(golden()[name]["topic"]))
        assert same(decode(raw), message) and frame(decode(raw)) == raw
    else:
        with pytest.raises(DecodeError, match="expected version"):
            decode(raw)
