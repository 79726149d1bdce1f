"""Asks the user, once and on a terminal, before a real device moves; scripts pass --yes."""

from __future__ import annotations

import sys

import rich_click as click


class NotConfirmed(click.ClickException):
    """The user has not allowed the device to move. The message is one sentence, exit code 2."""

    exit_code = 2


def confirm_motion(what: str, *, yes: bool, option: str = "--yes") -> None:
    """Ask whether the device may move, and return if it may.

    `what` says what will move, like `the device at /dev/ttyUSB0 will drive as recorded`; `yes` is
    the value of the command's `--yes` (or of the option named `option`). Raises NotConfirmed if the
    answer is no, or if there is no terminal to ask on.
    """
    if yes:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise NotConfirmed(
            f"{what}: there is no terminal to ask on, so say {option} if it may move"
        )
    if not click.confirm(f"{what}. Is there room, and may it move?", err=True):
        raise NotConfirmed("nothing was sent: the device may not move")
