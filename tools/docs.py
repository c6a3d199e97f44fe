"""Documents that contain tables of the code: `python -m vibrissa.tools.docs [--write]`.

In docs/*.md a generated part stands between `<!-- generated: NAME -->` and `<!-- end -->`. Without
--write nothing is changed, and the exit code is 1 if a part does not match the code.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from vibrissa.messages.topics import TOPICS
from vibrissa.processes.config import Experiment
from vibrissa.processes.table import ALL_SLOTS, PROCESSES, listeners, producers

DOCS: Final = Path(__file__).resolve().parent.parent / "docs"
_PART: Final = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def topics() -> str:
    """The topic table."""
    return _markdown(
        ("topic", "type", "Hz", "said by", "heard by", "recorded", "compared"),
        (
            (
                f"`{topic.name}`",
                f"{topic.type.__name__} v{topic.type.version}",
                f"{topic.rate:g}" if topic.rate else "now and then",
                "every host" if topic.producer == "any" else _speakers(topic.name),
                ", ".join(listeners(topic.name)) or "-",
                _yes(topic.recorded),
                _yes(topic.compared),
            )
            for topic in TOPICS.values()
        ),
    )


def processes() -> str:
    """The process table."""
    return _markdown(
        ("process", "node", "hears", "says", "paced by", "priority", "cores", "stand-in"),
        (
            (
                f"`{row.name}`",
                f"`{row.node}`",
                _names(row.hears),
                _names(row.says),
                row.pacing,
                str(row.priority or "-"),
                row.cores,
                _yes(row.source),
            )
            for row in PROCESSES.values()
        ),
    )


def experiment() -> str:
    """Every key of an experiment file with its default."""
    rows: list[tuple[str, ...]] = []
    for name, info in Experiment.model_fields.items():
        item = next(iter(get_args(info.annotation)), None)  # of a list of tables, [[name]]
        if _is_table(info.annotation):
            rows += _keys(f"{name}.", info.annotation)
        elif _is_table(item):
            rows += _keys(f"[[{name}]] ", item)
        else:
            rows.append(_key(name, info))
    return _markdown(("key", "default", "meaning"), rows)


PARTS: Final[dict[str, Callable[[], str]]] = {
    "topics": topics,
    "processes": processes,
    "experiment": experiment,
}


def renewed(text: str) -> str:
    """A document with its generated parts as the code has them now. KeyError: unknown part."""
    return _PART.sub(lambda part: part[1] + PARTS[part[2]]() + part[3], text)


def outdated() -> list[Path]:
    """The documents that don't match the code."""
    texts = {path: path.read_text() for path in sorted(DOCS.glob("*.md"))}
    return [path for path, text in texts.items() if renewed(text) != text]


def main() -> None:
    """Check the documents, or rewrite them with --write."""
    for path in (wrong := outdated()):
        if "--write" in sys.argv[1:]:
            path.write_text(renewed(path.read_text()))
            print(f"{path}: rewritten")
        else:
            print(f"{path}: does not match the code; 'make docs' rewrites it", file=sys.stderr)
    sys.exit(1 if wrong and "--write" not in sys.argv[1:] else 0)


def _is_table(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _keys(prefix: str, section: Any) -> list[tuple[str, ...]]:
    return [_key(prefix + name, info) for name, info in section.model_fields.items()]


def _key(name: str, info: FieldInfo) -> tuple[str, ...]:
    default = "required" if info.is_required() else f"`{json.dumps(info.default)}`"
    return f"`{name}`", default, info.description or ""


def _markdown(columns: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [columns, tuple("---" for _ in columns), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _speakers(topic: str) -> str:
    found = producers(topic)
    named = [name for name in found if name not in ALL_SLOTS]
    return ", ".join([*named, "slots"] if len(named) < len(found) else named)


def _names(topics: tuple[str, ...]) -> str:
    return ", ".join(f"`{topic}`" for topic in topics) or "-"


def _yes(value: bool) -> str:
    return "yes" if value else "no"


if __name__ == "__main__":
    main()
