"""`bilprov send`: sends instructions, bytes, or what is typed, and shows the answers."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from queue import SimpleQueue
from typing import Literal

import click

from bilprov.analyzer.cli.options import (
    asked_here,
    line_options,
    max_drive_option,
    timeout_option,
)
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.line_settings import line_settings, timeout_in_ns
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.dut.probes import PROBES
from bilprov.conformance.dut.target import BOARD, SIM
from bilprov.spec.protocol import Protocol


@click.command()
@click.argument("target", metavar="PORT|sim", type=PortName())
@click.argument("items", nargs=-1, metavar="[ITEM]...")
@click.option("--together", is_flag=True, help="Send the ITEMs without waiting for the answers.")
@click.option(
    "--expect",
    "expectations",
    multiple=True,
    metavar="ANSWER,...",
    help="The answer to each ITEM, in order: names or numbers, none for no answer. "
    "Exit code 0 if exactly these come, else 1.",
)
@click.option(
    "--format", "style", type=click.Choice(["lines", "jsonl"]), default="lines", show_default=True
)
@click.option(
    "--probe",
    help=f"Without ITEMs, what sees the robot: {', '.join(kind.form for kind in PROBES)} (the "
    "default for a port) or sim (the target sim's own).",
)
@click.option("--yes", is_flag=True, help="The robot may move: do not ask.")
@max_drive_option
@click.option(
    "--wait",
    is_flag=True,
    help="With ITEMs: wait for a port that is not there yet, and for one that is unplugged "
    "meanwhile.",
)
@line_options
@timeout_option
@click.pass_obj
def send(
    grammar: str | None,
    target: str,
    items: tuple[str, ...],
    together: bool,
    expectations: tuple[str, ...],
    style: Literal["lines", "jsonl"],
    probe: str | None,
    yes: bool,
    max_drive: float,
    wait: bool,
    baud: int | None,
    parity: str | None,
    stopbits: str | None,
    truncation_timeout: float | None,
) -> int:
    """Send instructions or bytes to a device, or drive it by hand.

    Examples:
      bilprov send /dev/ttyUSB0 Forward pause=500 "Speed 80" "81 05"
      bilprov send sim

    Each ITEM is an instruction (Forward, "Speed 255", "LED rgb=5"), bytes in hex ("93 00"), or
    pause=MS; they are sent one after the other. The device is homed first, and again however the
    command ends. sim is the built-in simulator.

    Without ITEMs you type them, and see each answer and the state. A line holds ITEMs or words
    (help lists them), with ; between them. Tab completes, the arrows recall earlier lines. Ctrl-C
    stops the robot, at rest it leaves; Ctrl-D leaves; Ctrl-Z stops the robot and suspends. Where
    there is no terminal the lines come from standard input.

    With --wait the robot at a port that was unplugged and is there again is stopped first; what
    follows the instruction or pause that was under way is then sent, and the exit code is 1.

    Exit code: 0 each instruction was answered, and as some reading of the document allows; 1 an
    answer is missing, is not a code of the grammar or is not allowed, bytes came without an
    instruction, or not all was done, for example because it drove too long (--max-drive) or a pause
    was cut short; 2 the port cannot be used, nobody answers, or an ITEM is not valid. Driving by
    hand on a terminal: 0.
    """
    protocol = load_protocol(grammar)
    settings = line_settings(protocol, baud, parity, stopbits)
    timeout = timeout_in_ns(protocol, truncation_timeout)
    others = ("probe",) if items else ("together", "expectations", "wait")
    for name in filter(asked_here, others):
        option = "expect" if name == "expectations" else name
        use = "only for driving by hand: leave out the ITEMs" if items else "only for ITEMs"
        raise click.UsageError(f"--{option} is {use}")
    if target.startswith(BOARD):
        raise click.UsageError(
            f"{target} is for conform: start `bilprov simulate --firmware FILE.elf` and "
            "name the pty that it prints"
        )
    with ExitStack() as stack:
        port = target
        if target == SIM:
            if probe not in (None, SIM) and asked_here("probe"):
                raise click.UsageError(f"sim brings its own probe; --probe {probe} is for ports")
            port, probe = stack.enter_context(_simulator(protocol))
            yes = True  # it moves nothing
        if items:
            from bilprov.analyzer.cli.send import send_items

            return send_items(
                protocol,
                port,
                items,
                settings,
                timeout,
                together=together,
                expectations=expectations,
                style=style,
                yes=yes,
                max_drive=max_drive,
                wait=wait,
            )
        from bilprov.conformance.cli.shell.session import drive

        return drive(
            protocol,
            port,
            settings,
            timeout,
            probe=probe,
            style=style,
            yes=yes,
            max_drive=max_drive,
        )


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
