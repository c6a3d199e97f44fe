"""Nodes rebuilt for a re-run: from the experiment in a log, some of them replaced by the user's."""

from __future__ import annotations

import importlib
from collections.abc import Mapping

from vibrissa.messages.log_format import LogError
from vibrissa.messages.log_reader import LogReader
from vibrissa.processes import provenance
from vibrissa.processes.config import Experiment
from vibrissa.processes.node import Node, Stepper
from vibrissa.processes.results import RunError, UnusableLogError
from vibrissa.processes.table import PROCESSES, build

Replacements = Mapping[str, str]
"""node -> "module:Class" as a person typed it; never taken from a log or a socket."""


def make_stepper(name: str, experiment: Experiment, replacements: Replacements) -> Stepper:
    """A fresh stepper of a node, the user's class where one is named. Raises UnusableLogError."""
    if name not in replacements:
        try:
            return Stepper(name, build(name, experiment))
        except (ValueError, RunError) as error:
            raise UnusableLogError(f"{name} can't be made from the experiment: {error}") from None
    return Stepper(name, load_node(name, replacements[name], experiment))


def load_node(name: str, target: str, experiment: Experiment) -> Node:
    """Make "module:Class" with the experiment. Raises UnusableLogError with the reason."""
    module, colon, attribute = target.partition(":")
    where = f"--replace {name}={target}"
    if not colon or not module or not attribute:
        raise UnusableLogError(f"{where}: expected NODE=module:Class")
    try:
        made = getattr(importlib.import_module(module), attribute)(experiment)
    except (ImportError, AttributeError) as error:
        raise UnusableLogError(f"{where}: {error}") from None
    if not callable(getattr(made, "step", None)):
        raise UnusableLogError(f"{where}: {attribute} has no method step(message)")
    node: Node = made
    return node


def check_replacements(replacements: Replacements) -> None:
    """Raises UnusableLogError when a replacement names no node of the table."""
    for name in replacements:
        if name not in PROCESSES:
            raise UnusableLogError(f"--replace {name}=...: expected one of {', '.join(PROCESSES)}")


def experiment_of(reader: LogReader) -> Experiment:
    """The experiment a log was made with. Raises UnusableLogError when it is not what it was."""
    text = reader.metadata.get("experiment", "")
    if provenance.config_hash(text) != reader.metadata.get("config_hash"):
        raise UnusableLogError(
            f"{reader.path}: the experiment in the log does not match its config hash"
        )
    try:
        return Experiment.model_validate_json(text)
    except ValueError as error:
        first = str(error).splitlines()[0]
        raise UnusableLogError(
            f"{reader.path}: its experiment is not one of this version: {first}"
        ) from None


def open_log(path: object, *, allow_cut: bool = False) -> LogReader:
    """A reader, with every way a file can be unusable as an UnusableLogError."""
    try:
        return LogReader(str(path), allow_cut=allow_cut)
    except FileNotFoundError:
        raise UnusableLogError(f"{path}: no such file") from None
    except (OSError, LogError) as error:
        text = str(error)
        raise UnusableLogError(text if str(path) in text else f"{path}: {text}") from None
