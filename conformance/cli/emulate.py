"""`bilprov emulate`: serves a board's firmware, run under simavr, on a pty or over TCP."""

from __future__ import annotations

import time
from pathlib import Path

import click

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.server import serve
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.dut.boards import EmulatorError
from bilprov.conformance.dut.boards.elf import ARM, architecture
from bilprov.conformance.dut.boards.paced import PacedBoard
from bilprov.conformance.dut.boards.simavr import SimavrBoard
from bilprov.conformance.dut.target import BOARD, QEMU


@click.command()
@click.argument("firmware", metavar="FIRMWARE.elf", type=click.Path(path_type=Path))
@click.option("--pty", is_flag=True, help="Serve a pty; what it does unless --listen is given.")
@click.option("--listen", metavar="HOST:PORT", help="Serve raw TCP; port 0: any.")
@click.option("--probe-listen", metavar="HOST:PORT", help="Serve the probe over TCP too.")
@click.pass_obj
def emulate(
    grammar: str | None,
    firmware: Path,
    pty: bool,
    listen: str | None,
    probe_listen: str | None,
) -> int:
    """Run a board's firmware under simavr, served on a pty or over TCP, until Ctrl-C.

    The firmware is the ELF file for an Arduino Uno (ATmega328P, 16 MHz). It runs as fast as the
    wall clock, and bytes take as long as on a wire of the grammar's baud. Prints one line for each
    thing it serves: the pty's path, socket://HOST:PORT, and probe tcp:HOST:PORT, which are what
    sniff, replay, conform and --probe take. The probe tells what the pins show. The limits for
    clients are those of simulate; an address that other machines reach comes with a warning.

    For conform alone, emulator:simavr:FIRMWARE.elf is quicker: it needs no pty and no real time.

    Ends by Ctrl-C or SIGTERM with 0. Firmware that crashes is told at once, and stays served as a
    robot that does not answer; the exit code is then 2.
    """
    protocol = load_protocol(grammar)
    if architecture(firmware) == ARM:
        raise EmulatorError(
            f"{firmware} is for an ARM, and simavr runs only AVR: QEMU takes it, with "
            f"bilprov conform {BOARD}{QEMU}:{firmware}"
        )
    board = SimavrBoard(firmware)
    try:
        board.look(0)  # boots it
        if board.crashed:
            raise EmulatorError(
                f"{firmware} crashes before it begins: see that the file is whole, and linked for "
                "an Arduino Uno"
            )
        device = PacedBoard(board, line_settings(protocol, None, None, None).byte_time, note)
        power_on = time.monotonic_ns()
        with Stopper() as stopper:
            serve(
                device,
                pty=pty or listen is None,
                listen=listen,
                probe_listen=probe_listen,
                announce=lambda line: click.echo(line),
                stop=stopper,
                note=note,
                clock=lambda: time.monotonic_ns() - power_on,
            )
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    finally:
        board.close()
    return 2 if device.crashed else 0
