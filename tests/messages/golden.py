"""Writes the frames that `test_golden.py` compares: `python -m tests.messages.golden`.

Only what is new is added: a type whose layout changes needs a new version number first.
"""

from __future__ import annotations

import json
from pathlib import Path

from tests.messages.strategies import frame, plain
from vibrissa.messages.codec import CODECS, Codec

GOLDEN = Path(__file__).parent / "golden_frames.json"


def title(codec: Codec) -> str:
    return f"{codec.type.__name__} v{codec.version}"


def entry(codec: Codec) -> dict[str, object]:
    """A frame of a topic, its fields in order, and the values in it."""
    raw = frame(plain(codec.topic))
    return {"topic": codec.topic, "fields": list(codec.fields), "frame": raw.hex()}


def golden() -> dict[str, dict[str, object]]:
    """What is committed: type and version -> topic, fields, frame."""
    found: dict[str, dict[str, object]] = json.loads(GOLDEN.read_text())
    return found


def main() -> None:
    found = golden() if GOLDEN.exists() else {}
    for codec in CODECS.values():
        if title(codec) not in found:
            found[title(codec)] = entry(codec)
    GOLDEN.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
