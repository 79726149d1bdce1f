"""`bilprov lab line`: connects two ends by a line that drops, flips, doubles and delays bytes."""

from __future__ import annotations

from functools import partial

import click
import msgspec

from bilprov.analyzer.cli.command import argument, command, group, option, protocol_in_use
from bilprov.analyzer.cli.options import LINE, Finite, LineOptions, note, only_for_ports, refused
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.taps.relay import PTY, ImpairedDirection, Noise, join, open_end
from bilprov.analyzer.transport.machine import same_line
from bilprov.analyzer.transport.port import PtyPair
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import MS

_rate = partial(option, metavar="RATE", type=Finite(0, 1), default=0.0)


_time = partial(option, metavar="MS", type=Finite(0, 60_000), default=0.0)


class ImpairedOptions(msgspec.Struct, frozen=True):
    """The options of `lab line`."""

    a: str = argument(metavar="A", type=PortName())
    b: str = argument(metavar="B", type=PortName())
    drop: float = _rate(help="Bytes that vanish.")
    flip: float = _rate(help="Bytes with one bit flipped.")
    double: float = _rate(help="Bytes that come twice.")
    delay: float = _time(help="How long bytes are held back.")
    jitter: float = _time(help="And up to this much longer.")
    seed: int = option(default=1, help="Selects the bytes that are hit.")
    line: LineOptions = group(LineOptions)


@command(ImpairedOptions)
def line(options: ImpairedOptions) -> int:
    """Examples:
      bilprov lab line --drop 1e-4 --delay 5 /dev/ttyUSB0 pty
      bilprov lab line --flip 1e-3 pty pty

    Between A and B bytes are lost, changed, doubled and delayed, both ways. A and B are each a
    device that is opened (a path or a pyserial URL), or pty: a pseudo terminal is made for a
    program to open, and its path printed, A before B. Without faults every byte passes unchanged
    and at once. What arrives at a pty waits for the program that opens it, as in a driver's buffer.

    A RATE is how likely a byte is hit, 0 to 1: 1e-4 is one in ten thousand. Times are in
    milliseconds. The order of the bytes is kept. The same seed and the same bytes give
    the same faults, in each direction by itself.

    To test a device behind it, give bilprov conform the path that is printed.

    Exits with status 0 after Ctrl-C or SIGTERM, with 2 if an end is lost; either way standard error
    shows how many bytes went each way, and how many of them were hit, and how.
    """
    a, b = options.a, options.b
    if a == b == PTY:
        only_for_ports(LINE, PTY)
    if a != PTY and same_line(a, b):  # to open it twice would only report that it is in use
        raise click.UsageError(f"both ends are {b}; a line joins two, so give another one")
    with refused(click.UsageError):
        noise = Noise(options.flip, options.drop, options.double)
    opened = options.line.settings(protocol_in_use())
    held = {"delay": round(options.delay * MS), "jitter": round(options.jitter * MS)}
    there, back = (
        ImpairedDirection(noise, options.seed, name, **held) for name in ("A to B", "B to A")
    )
    with Stopper() as stopper, open_end(a, opened) as one, open_end(b, opened) as two:
        for end in (one, two):
            if isinstance(end, PtyPair):
                click.echo(end.name)
        if PTY not in (a, b):  # otherwise the printed names say that it is ready
            note(f"{a} and {b} are joined")
        try:
            join((one, two), (there, back), stop=stopper, note=note)
        finally:
            note(f"{there.account()}; {back.account()}")
    return 0
