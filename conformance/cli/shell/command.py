"""`bilprov shell`: opens the robot and its probe, asks whether it may move, and lets one drive."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from queue import SimpleQueue

import click

from bilprov.analyzer.cli.options import (
    asked_here,
    confirm_motion,
    line_options,
    max_drive_option,
    note,
    note_hindrances,
    note_suspension,
    timeout_option,
)
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.line_settings import line_settings, timeout_in_ns
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.text import printable
from bilprov.conformance.dut.probes import PROBES, open_probe
from bilprov.conformance.dut.target import BOARD, SIM
from bilprov.spec.movement import all_movement, movement_words
from bilprov.spec.protocol import Protocol


@click.command()
@click.argument("target", metavar="PORT|sim")
@click.option(
    "--probe",
    help=f"What sees the robot: {', '.join(kind.form for kind in PROBES)} (a port's unless given) "
    "or sim (the target sim's own).",
)
@max_drive_option
@click.option("--yes", is_flag=True, help="The robot may move: do not ask.")
@line_options
@timeout_option
@click.pass_obj
def shell(
    grammar: str | None,
    target: str,
    probe: str | None,
    max_drive: float,
    yes: bool,
    baud: int | None,
    parity: str | None,
    stopbits: str | None,
    truncation_timeout: float | None,
) -> int:
    """Drive a device by hand: type instructions, see each answer and the state.

    A line holds instructions as for `send` (Forward, Speed 255, LED rgb=5), bytes in hex (93 00),
    pauses (pause=500) or words (help lists them), with ; between them. Tab completes, the arrows
    recall earlier lines. Ctrl-C stops the robot, at rest it leaves; Ctrl-D leaves; Ctrl-Z stops
    the robot and suspends. The device is homed first and on every way out.

    Without a terminal the lines come from standard input. Exit code there: as for `send`, and 1
    where a line was not done to its end, 2 for a line that says nothing.
    """
    from bilprov.analyzer.output.outputs import stream_output
    from bilprov.analyzer.replay.answers import UNANSWERED_STOPS
    from bilprov.analyzer.transport.ports import open_port
    from bilprov.conformance.cli.shell.driving import Driving

    protocol = load_protocol(grammar)
    settings = line_settings(protocol, baud, parity, stopbits)
    timeout = timeout_in_ns(protocol, truncation_timeout)
    if target.startswith(BOARD):
        raise click.UsageError(
            f"{printable(target)} is for conform: start `bilprov emulate FILE --pty` and name the "
            "pty that it prints"
        )
    with ExitStack() as stack:
        port = target
        if target == SIM:
            if probe not in (None, SIM) and asked_here("probe"):
                raise click.UsageError(f"sim brings its own probe; --probe {probe} is for ports")
            port, probe = stack.enter_context(_simulator(protocol))
        opened = stack.enter_context(open_port(port, settings))
        eye = open_probe(PROBES[-1].name if probe is None else probe, opened)
        if eye is not None:
            stack.callback(eye.close)
        if target != SIM:
            note_hindrances(port)
            words = movement_words(protocol, all_movement(protocol))
            confirm_motion(protocol, f"the robot at {port} will do what is typed: {words}", yes=yes)
        output = stream_output("lines")
        stopper = stack.enter_context(Stopper())
        driving = Driving(protocol, opened, timeout, stopper, output, eye, max_drive)
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


@contextmanager
def _simulator(protocol: Protocol) -> Iterator[tuple[str, str]]:
    """Serve the reference device in a thread; gives the names of its port and of its probe."""
    from bilprov.analyzer.transport.server import serve
    from bilprov.conformance.dut.simulator import Simulator

    lines: SimpleQueue[str] = SimpleQueue()
    # The thread ends before the stop is closed: a closed descriptor wakes no selector.
    with closing(Stopper()) as stop, ThreadPoolExecutor(max_workers=1) as pool:
        served = pool.submit(
            serve,
            Simulator(protocol),
            pty=True,
            listen=None,
            probe_listen="127.0.0.1:0",
            announce=lines.put,
            stop=stop,
        )
        served.add_done_callback(lambda _: lines.put(""))
        port, probe = lines.get(), lines.get()
        if served.done():
            served.result()  # raises why it could not be served
        try:
            yield port, probe.removeprefix("probe ")
        finally:
            stop.stop()
