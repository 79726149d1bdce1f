"""`bilprov simulate`: serves the reference device, or a board's firmware, on a pty or over TCP."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click
import msgspec

from bilprov.analyzer.cli.command import PATH, command, flag, option, protocol_in_use
from bilprov.analyzer.cli.options import note
from bilprov.analyzer.simulated.device import SimulatedDevice
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.server import serve
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli.options import fault_option, named_device, variant_option
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.conformance.dut.boards.simavr import PacedBoard


def _address_at(ctx: click.Context, param: click.Parameter, text: str | None) -> int | None:
    try:
        return None if text is None else int(text, 0)
    except ValueError:
        raise click.BadParameter(
            f"{text!r} is not an address; write it like 0x7c00 or 31744"
        ) from None


class SimulateOptions(msgspec.Struct, frozen=True):
    """The options of `simulate`."""

    firmware: Path | None = option(
        type=PATH,
        metavar="FILE.elf|.hex",
        help="Run this firmware for an Arduino Uno under simavr instead.",
    )
    start: int | None = option(
        callback=_address_at,
        metavar="ADDRESS",
        help="Start that firmware here, like 0x7c00, and not where its file has it.",
    )
    pty: bool = flag("Serve a pty: the default unless --listen is given.")
    listen: str | None = option(
        metavar="HOST:PORT", help="Serve raw TCP instead of a pty; port 0: any."
    )
    probe_listen: str | None = option(metavar="HOST:PORT", help="Serve the probe over TCP too.")
    fault: str | None = fault_option(
        help="Misbehave in one way; random:SEED or random:SEED.NUMBER draws one."
    )
    variant: str | None = variant_option(help="Read the document in another legal way.")
    list_faults: bool = flag("List the named faults.")
    list_variants: bool = flag("List the legal variants, and mixtures.")


@command(SimulateOptions, only_with={"firmware": ("start",)})
def simulate(options: SimulateOptions) -> int:
    """Examples:
      bilprov simulate --probe-listen 127.0.0.1:0
      bilprov simulate --fault always-0 --listen 127.0.0.1:7000
      bilprov simulate --firmware firmware/build/uno.elf
      bilprov simulate --firmware optiboot.hex --start 0x7c00 --grammar stk500v1

    It is served on a pty, or over TCP. The device conforms, or misbehaves with --fault. Prints one
    line for each thing it serves: the pty's path, socket://HOST:PORT, and probe tcp:HOST:PORT,
    which are what sniff, replay, conform and --probe take.

    With the --grammar of another protocol it is a device of that: one at each address, which
    answers what is due, and from which what was written is read back. Its probe is a line of JSON
    with the state at each address.

    With --firmware it is a board's: an ELF or Intel HEX file for an Arduino Uno (ATmega328P,
    16 MHz), run under simavr. It runs as fast as the wall clock, and bytes take as long as on a
    wire of the grammar's baud. Opening the pty, or connecting, resets the microcontroller, as it
    does on an Arduino; its flash stays as it is. The probe reports what the pins of the car show.
    For conform alone, emulator:simavr:FILE.elf is quicker: it needs no pty and no real time. A
    crash is reported at once; until the next reset the firmware then stays served as a device that
    does not answer, and the exit code is 2 if it ends so.

    One host at a time is served over TCP, and 200 clients of the probe; more are closed. A host
    that does not read loses what exceeds 64 KiB, and so does a client of the probe. 127.0.0.1 is
    this machine alone; an address that others reach comes with a warning.

    Exit code: 0 after Ctrl-C or SIGTERM.
    """
    protocol, firmware = protocol_in_use(), options.firmware
    mine = ("fault", "variant", "list_faults", "list_variants")
    given = [name.replace("_", "-") for name in mine if getattr(options, name)]
    if given and (firmware or not protocol.wheels):
        raise click.UsageError(
            f"--{given[0]} is for the simulated robot car and its family; firmware and other "
            "protocols are served as they are"
        )
    if options.list_faults or options.list_variants:
        from bilprov.conformance.mutation.catalogue import listed_faults, listed_variants

        listed = listed_faults if options.list_faults else listed_variants
        click.echo(listed(protocol))
        return 0
    if firmware is not None and options.probe_listen and not protocol.wheels:
        raise click.UsageError(
            f"the probe of a board sees the pins of the car, which {protocol.name} does not have: "
            "leave out --probe-listen"
        )
    with ExitStack() as stack:
        board = None
        if firmware is not None:
            board = stack.enter_context(_board(protocol, firmware, options.start))
        device: Simulator | SimulatedDevice | PacedBoard | None = board
        if device is None and protocol.wheels:
            fault = named_device(protocol, options.fault, options.variant)
            device = Simulator(protocol, fault)
        stopper = stack.enter_context(Stopper())
        power_on = time.monotonic_ns()
        try:
            serve(
                device or SimulatedDevice(protocol),
                pty=options.pty or options.listen is None,
                listen=options.listen,
                probe_listen=options.probe_listen,
                announce=lambda line: click.echo(line),
                stop=stopper,
                note=note,
                clock=lambda: time.monotonic_ns() - power_on,
                reset=board.reset if board else None,
            )
        except ValueError as error:
            raise click.UsageError(str(error)) from error
    return 2 if board and board.crashed else 0


@contextmanager
def _board(protocol: Protocol, firmware: Path, start: int | None) -> Iterator[PacedBoard]:
    """Run firmware at the pace of the wall clock. Raises EmulatorError if it cannot be run."""
    from bilprov.conformance.dut.boards import EmulatorError
    from bilprov.conformance.dut.boards.simavr import PacedBoard, SimavrBoard

    with closing(SimavrBoard(firmware, start)) as board:
        board.look(0)  # boots it
        if board.crashed:
            raise EmulatorError(
                f"{firmware} crashes before it begins: check that the file is complete, and linked "
                "for an Arduino Uno"
            )
        yield PacedBoard(board, line_settings(protocol, None, None, None).byte_time, note)
