"""`bilprov send`: sends instructions, bytes, or what is typed, and shows the answers."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from queue import SimpleQueue

import click
from msgspec.structs import replace

from bilprov.analyzer.cli.command import asked_here, command, protocol_in_use
from bilprov.analyzer.cli.options import SENDING_LINE, above_latency, only_for_ports
from bilprov.analyzer.transport.line_settings import timeout_in_ns
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli.shell.options import SendOptions
from bilprov.conformance.dut.target import BOARD, SIM
from bilprov.spec.protocol import Protocol


@command(SendOptions, only_with={"items": ("together", "unhomed", "expectations", "wait")})
def send(options: SendOptions) -> int:
    """Examples:
      bilprov send /dev/ttyUSB0 Forward pause=500 "Speed 80" "81 05"
      bilprov send sim

    Each ITEM is an instruction (Forward, "Speed 255", "LED rgb=5", "ReadCoils 0 8 address=17"),
    bytes in hex ("93 00"), or pause=MS; they are sent one after the other. The device is homed
    first (not with --unhomed), and again however the command ends. sim is the built-in simulator.

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
    protocol, target, items = protocol_in_use(), options.target, options.items
    settings = options.line.settings(protocol)
    timeout = above_latency(timeout_in_ns(protocol, options.truncation_timeout), target)
    if target.startswith(BOARD):
        raise click.UsageError(
            f"{target} is for conform: start `bilprov simulate --firmware FILE.elf` and "
            "name the pty that it prints"
        )
    with ExitStack() as stack:
        if target == SIM:
            only_for_ports((*SENDING_LINE, "wait"), SIM)
            typed = options.probe if asked_here("probe") else None
            if typed and (typed != SIM or not protocol.wheels):
                raise click.UsageError(
                    f"sim brings its own probe where it is a car: leave out --probe {typed}"
                )
            port, own = stack.enter_context(_simulator(protocol))
            # Items are shown with looks only where these are asked for, as at a port.
            probe = own if protocol.wheels and (typed or not items) else None
            options = replace(options, target=port, probe=probe, yes=True)  # it moves nothing
        from bilprov.conformance.cli.shell.items import drive, send_items

        done = send_items if items else drive
        return done(protocol, options, settings, timeout)


@contextmanager
def _simulator(protocol: Protocol) -> Iterator[tuple[str, str]]:
    """Serve the reference device in a thread; gives the names of its port and of its probe."""
    from bilprov.analyzer.simulated.device import SimulatedDevice
    from bilprov.analyzer.transport.server import serve
    from bilprov.conformance.dut.simulator import Simulator

    lines: SimpleQueue[str] = SimpleQueue()
    # The thread ends before the stop is closed: a closed descriptor wakes no selector.
    with closing(Stopper()) as stop, ThreadPoolExecutor(max_workers=1) as pool:
        served = pool.submit(
            serve,
            Simulator(protocol) if protocol.wheels else SimulatedDevice(protocol),
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
