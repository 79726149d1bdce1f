"""Opens the robot and its probe, asks whether it may move, and has done what is typed."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from bilprov.analyzer.cli.options import confirm_effect, note_each, note_hindrances, note_suspension
from bilprov.analyzer.client.probes import PROBES, Probe, open_probe
from bilprov.analyzer.replay.answers import UNANSWERED_STOPS
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli.shell.driving import Driving
from bilprov.spec.by_effect import effect_words
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.conformance.cli.send import SendOptions


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
            from bilprov.conformance.cli.shell.piped import do_lines

            done = do_lines(driving, stopper)
            driving.target.finish()
    told = [] if driving.target.answered_stops else [UNANSWERED_STOPS]
    if not interactive:
        check = driving.check
        told += filter(None, (check.unasked_words, check.wrong_words, check.missing_words))
    note_each(told)
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
        eye = open_probe(options.probe or PROBES[-1].name, port, protocol)
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
