"""The version of the kit, said here alone: pyproject.toml reads it, no installation is asked."""

from __future__ import annotations

__version__ = "0.2.0"


def kit_version() -> str:
    """The version of this code, as captures and reports carry it."""
    return __version__
