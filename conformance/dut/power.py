"""Power switches for a robot on a port: they switch it off and on again."""

from __future__ import annotations

import subprocess
from collections.abc import Callable

Power = Callable[[], None]
"""Switches the robot off and on; returns once it has its power again. Raises PowerError."""

_PATIENCE = 60  # s that a command may take


class PowerError(Exception):
    """The power switch did not work; the message says why, in one sentence."""


def by_command(command: str) -> Power:
    """A power switch that runs a shell command, which switches the power off and on again."""

    def cycle() -> None:
        nothing = subprocess.DEVNULL
        try:
            subprocess.run(command, shell=True, check=True, timeout=_PATIENCE, stdin=nothing)
        except (OSError, subprocess.SubprocessError) as error:
            raise PowerError(f"the power switch {command!r} did not work: {error}") from error

    return cycle
