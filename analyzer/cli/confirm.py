"""Asks before a real device moves: once, on a terminal; a script says --yes."""

from __future__ import annotations

import sys

import rich_click as click


class NotConfirmed(click.ClickException):
    """Nobody said that the device may move. The message is one sentence; the exit code is 2."""

    exit_code = 2


def confirm_motion(what: str, *, yes: bool, option: str = "--yes") -> None:
    """Return if the device may be moved.

    `what` says what will move, like `the device at /dev/ttyUSB0 will drive as recorded`; `yes` is
    the command's `--yes`, or what `option` calls it. Raises NotConfirmed where the answer is no,
    and where there is no terminal to ask on.
    """
    if yes:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise NotConfirmed(
            f"{what}: there is no terminal to ask on, so say {option} if it may move"
        )
    if not click.confirm(f"{what}. Is there room, and may it move?", err=True):
        raise NotConfirmed("nothing was sent: the device may not move")
