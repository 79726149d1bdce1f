"""`bilprov lab line`: connects two ends by a line that drops, flips, doubles and delays bytes."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar

import click

from bilprov.analyzer.cli.options import Finite, line_options, note
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.taps.ends import SERVED, End, open_end, require_two_ends
from bilprov.analyzer.taps.impairment import LONGEST, ImpairedDirection, LineFaults, Noise
from bilprov.analyzer.taps.relay import join
from bilprov.analyzer.transport.line_settings import LineSettings, line_settings
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.text import printable

_TIME = re.compile(r"(\d+(?:\.\d*)?(?:e[-+]?\d+)?|\.\d+)\s*(ms|s|)", re.ASCII | re.IGNORECASE)

Command = TypeVar("Command", bound=Callable[..., Any])


def nanoseconds(text: str) -> int:
    """Convert a time like `5ms`, `0.2s`, or a number of ms, to ns. Raises ValueError."""
    match = _TIME.fullmatch(text.strip())
    value = float(match[1]) * (1e9 if match[2].lower() == "s" else 1e6) if match else math.inf
    if value > LONGEST:
        raise ValueError(
            f"{printable(text)!r} is not such a time; write 5ms, 0.2s or a number of milliseconds, "
            f"from 0 to {LONGEST // 10**9}s"
        )
    return round(value)


def _in_ns(ctx: click.Context, param: click.Parameter, value: str) -> int:
    try:
        return nanoseconds(value)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


def _rate(name: str, text: str, default: float = 0.0) -> Callable[[Command], Command]:
    return click.option(name, metavar="RATE", type=Finite(0, 1), default=default, help=text)


def _time(name: str, text: str) -> Callable[[Command], Command]:
    return click.option(name, metavar="TIME", default="0", callback=_in_ns, help=text)


SERVED_IN_WORDS = ", or ".join(kind.help for kind in SERVED)

HELP = f"""\
Connect A and B through a line that loses, changes, doubles and delays bytes, both ways.

Examples:
  bilprov lab line --drop 1e-4 --delay 5ms /dev/ttyUSB0 pty
  bilprov lab line --flip 1e-3 listen:127.0.0.1:5000 pty

A and B are each a device that is opened (a path or a pyserial URL), {SERVED_IN_WORDS}. What was
made is printed, one line each, A before B: the pty's path, or socket://HOST:PORT. Without faults
every byte passes unchanged and at once. What arrives at a listening end without a client is lost;
at a pty it waits for the program that opens it, as in a driver's buffer. A listening end takes one
client at a time and closes others; other machines reach it only if HOST allows that, as in
listen:0.0.0.0:5000, with a warning.

A RATE is how likely a byte is hit, 0 to 1: 1e-4 is one in ten thousand. A TIME is 5ms, 0.2s,
or a number of milliseconds. The order of the bytes is kept. The same seed and the same bytes
give the same faults, in each direction by itself.

To test a device behind it, give bilprov conform the path that is printed.

Exits with status 0 after Ctrl-C or SIGTERM, with 2 if an end is lost; either way standard error
shows how many bytes went each way, and how many of them were hit, and how.
"""


@click.command(help=HELP)
@click.argument("a", metavar="A", type=PortName())
@click.argument("b", metavar="B", type=PortName())
@_rate("--drop", "Bytes that vanish.")
@_rate("--flip", "Bytes with one bit flipped.")
@_rate("--double", "Bytes that come twice.")
@_time("--delay", "How long late bytes are held back.")
@_time("--jitter", "And up to this much longer.")
@_rate("--late", "Bytes that are late; all of them unless given.", 1.0)
@click.option(
    "--seed", type=int, default=1, show_default=True, help="Selects the bytes that are hit."
)
@line_options
@click.pass_obj
def line(
    grammar: str | None,
    a: str,
    b: str,
    drop: float,
    flip: float,
    double: float,
    delay: int,
    jitter: int,
    late: float,
    seed: int,
    baud: int | None,
    parity: str | None,
    stopbits: str | None,
) -> int:
    """Connect two ends through an impaired line; the command's help is `HELP`."""
    try:
        require_two_ends(a, b)
        faults = LineFaults(Noise(flip, drop, double), delay, jitter, late)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    settings = line_settings(load_protocol(grammar), baud, parity, stopbits)
    there, back = (
        ImpairedDirection(faults, seed, "A to B"),
        ImpairedDirection(faults, seed, "B to A"),
    )
    with Stopper() as stopper, ExitStack() as stack:
        ends = _opened((a, b), settings, stack)
        if not any(end.served for end in ends):  # otherwise the printed names say that it is ready
            note(f"{a} and {b} are joined")
        try:
            join(ends, (there, back), stop=stopper, note=note)
        finally:
            note(f"{there.account()}; {back.account()}")
    return 0


def _opened(names: tuple[str, str], settings: LineSettings, stack: ExitStack) -> tuple[End, End]:
    """Open both ends; print the names of new ptys and listeners, and who else reaches them."""

    def opened(name: str) -> End:
        try:
            end = open_end(name, settings)
        except ValueError as error:
            raise click.UsageError(str(error)) from error
        stack.callback(end.close)
        return end

    ends = opened(names[0]), opened(names[1])
    for end in ends:
        if end.warning:
            note(end.warning)
        if end.served:
            click.echo(end.served)
    return ends
