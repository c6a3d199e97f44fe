"""Results on disk, keyed by a hash of everything that determines them.

A file is written under another name and then renamed, so that an interrupted run leaves no half of
one. The key holds the case, the keys of what it was made from, and a digest of the source code.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.compilation import source_digest

Arrays = dict[str, NDArray[Any]]


def key_of(kind: str, case: Mapping[str, Any], source: str, *parts: str) -> str:
    """32 hexadecimal digits for a case computed by the module in file `source` from `parts`."""
    text = json.dumps([kind, dict(case), source_digest(source), parts], sort_keys=True)
    return f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:32]}"


def load(folder: Path, key: str) -> Arrays | None:
    """The arrays stored under a key; None when there are none, or they can't be read."""
    try:
        with np.load(folder / f"{key}.npz", allow_pickle=False) as stored:
            return dict(stored)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def store(folder: Path, key: str, arrays: Arrays) -> None:
    """Keep arrays under a key, at once or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    scratch = folder / f".{key}-{os.getpid()}"
    with scratch.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    scratch.replace(folder / f"{key}.npz")
