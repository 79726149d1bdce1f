"""Opens the robot and its probe, asks whether it may move, and has done what is typed."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack
from typing import Literal

from bilprov.analyzer.cli.options import confirm_motion, note, note_hindrances, note_suspension
from bilprov.analyzer.client.probes import PROBES, open_probe
from bilprov.analyzer.replay.answers import UNANSWERED_STOPS
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.ports import open_port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli.shell.driving import Driving
from bilprov.spec.movement import all_movement, movement_words
from bilprov.spec.protocol import Protocol


def drive(
    protocol: Protocol,
    port: str,
    settings: LineSettings,
    timeout: int,
    *,
    probe: str | None,
    style: Literal["lines", "jsonl"],
    yes: bool,
    max_drive: float,
) -> int:
    """Have what is typed done by the device at a port, until the end; returns the exit code.

    The values are those of the options of `bilprov send`; `timeout` (ns) is the longest pause
    inside a frame. Raises LinkError and ProbeError.
    """
    with ExitStack() as stack:
        opened = stack.enter_context(open_port(port, settings))
        eye = open_probe(PROBES[-1].name if probe is None else probe, opened)
        if eye is not None:
            stack.callback(eye.close)
        note_hindrances(port)
        words = movement_words(protocol, all_movement(protocol))
        confirm_motion(protocol, f"the robot at {port} will do what is typed: {words}", yes=yes)
        stopper = stack.enter_context(Stopper())
        driving = Driving(protocol, opened, timeout, stopper, style, eye, max_drive)
        with driving:
            driving.begin()
            interactive = _on_terminal()
            if interactive:
                from bilprov.conformance.cli.shell.prompt import Prompt

                Prompt(protocol, driving, stopper).run()
            else:
                from bilprov.conformance.cli.shell.piped import do_lines

                done = do_lines(driving, stopper)
                driving.target.finish()
            note_suspension(stopper)
    told = [] if driving.target.answered_stops else [UNANSWERED_STOPS]
    if not interactive:
        check = driving.check
        told += filter(None, (check.unasked_words, check.wrong_words, check.missing_words))
    for sentence in told:
        note(sentence)
    return 1 if told or not (interactive or done) else 0


def _on_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
