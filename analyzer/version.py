"""The version of the installed kit."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def kit_version() -> str:
    """The installed version, `0` when run from a bare checkout."""
    try:
        return version("bilprov")
    except PackageNotFoundError:
        return "0"
