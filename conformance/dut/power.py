"""What switches a robot on a port off and on again."""

from __future__ import annotations

import subprocess
from collections.abc import Callable

Power = Callable[[], None]
"""Off and on; returns once the robot has its power again. Raises PowerError."""

_PATIENCE = 60  # s that a command may take


class PowerError(Exception):
    """A switch that did not work, in one sentence."""


def by_command(command: str) -> Power:
    """The switch that a shell command is: it takes the power away and gives it back."""

    def cycle() -> None:
        nothing = subprocess.DEVNULL
        try:
            subprocess.run(command, shell=True, check=True, timeout=_PATIENCE, stdin=nothing)
        except (OSError, subprocess.SubprocessError) as error:
            raise PowerError(f"the power switch {command!r} did not work: {error}") from error

    return cycle
