"""Opens the robot and its probe, asks whether it may move, and has done what is typed or piped."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from bilprov.analyzer.cli.options import (
    confirm_effect,
    note,
    note_hindrances,
    note_suspension,
)
from bilprov.analyzer.client.probes import NONE, Probe, open_probe
from bilprov.analyzer.replay.comparison import UNANSWERED_STOPS
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import Port, open_port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli.shell.driving import Driving
from bilprov.conformance.cli.shell.options import SendOptions
from bilprov.spec.by_effect import effect_words
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol


def drive(protocol: Protocol, options: SendOptions, settings: LineSettings, timeout: int) -> int:
    """Have what is typed done by the device at a port, until the end; returns the exit code.

    `timeout` (ns) is the longest pause inside a frame. Raises LinkError and ProbeError.
    """
    words = "" if options.only_reading else effect_words(protocol)
    opened = open_port(options.target, settings)
    with (
        agreed(protocol, options, opened, "what is typed", words) as (eye, stopper),
        Driving(protocol, options, opened, timeout, stopper, eye) as driving,
    ):
        driving.begin()
        interactive = _on_terminal()
        if interactive:
            from bilprov.conformance.cli.shell.prompt import Prompt

            Prompt(protocol, driving, stopper).run()
        else:
            done = do_lines(driving, stopper)
            driving.target.finish()
    told = [] if driving.target.answered_stops else [UNANSWERED_STOPS]
    if not interactive:
        check = driving.check
        told += filter(None, (check.unasked_words, check.wrong_words, check.missing_words))
    note(*told)
    return 1 if told or not (interactive or done) else 0


@contextmanager
def agreed(
    protocol: Protocol, options: SendOptions, port: Port, what: str, words: str
) -> Iterator[tuple[Probe | None, Stopper]]:
    """Open the probe of the robot at a port and ask once whether the robot may move.

    `what` it will do and what that may change are in words. Gives the probe, None for none, and the
    stopper that handles signals until the end of the block, which closes all. Raises ProbeError.
    """
    with ExitStack() as stack:
        stack.enter_context(port)
        eye = open_probe(options.probe or NONE, port, protocol)
        if eye is not None:
            stack.callback(eye.close)
        note_hindrances(options.target)
        what = f"the {protocol.device} at {options.target} will do {what}"
        confirm_effect(protocol, what, words, yes=options.yes)
        stopper = stack.enter_context(Stopper())
        yield eye, stopper
        note_suspension(stopper)


def _on_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty() and os.environ.get("TERM") != "dumb"


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
