"""Vibrissa: closed-loop active touch with deterministic re-runs."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("vibrissa")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]
