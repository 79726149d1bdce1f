"""Lines from a pipe, a file or a plain terminal: done as they come, with plain output."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli.shell.driving import Driving
from bilprov.spec.errors import UserError

_PIECE = 1 << 12  # bytes
_LONGEST = 1 << 16  # bytes of a line
_TURN = 0.5  # s


class ScriptError(UserError):
    """A line that cannot be done; the message names it and says why."""


def do_lines(driving: Driving, stopper: Stopper) -> bool:
    """Do the lines of standard input until its end, `quit`, or a signal.

    Returns whether each line was done to its end. Raises ScriptError for a mistake, LinkError and
    ProbeError.
    """
    done = True
    for number, line in enumerate(_lines(driving, stopper), start=1):
        try:
            done &= driving.do(line.decode(errors="backslashreplace"))
        except ValueError as error:
            if not sys.stdin.isatty():
                raise ScriptError(f"line {number}: {error}") from error
            note(f"{error}; see help")  # typed by somebody who can type it again
        if driving.over:
            break
    return done


def _lines(driving: Driving, stopper: Stopper) -> Iterator[bytes]:
    """Yield lines as they come; meanwhile the robot is attended to."""
    descriptor = sys.stdin.fileno()
    held = b""
    while not stopper.stopped:
        if not driving.attend(_TURN, [descriptor]):
            continue
        data = os.read(descriptor, _PIECE)
        *lines, held = (held + data).split(b"\n")
        if not data and held:
            lines, held = [held], b""
        for line in lines:
            if stopper.stopped:
                return
            yield line
        if not data:
            return
        if len(held) > _LONGEST:
            raise ScriptError(f"a line is longer than {_LONGEST} bytes; end lines with a newline")
