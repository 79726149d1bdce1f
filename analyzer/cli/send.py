"""`bilprov send`: sends instructions, or any bytes, to a device and shows its answers."""

from __future__ import annotations

from typing import Literal

import click

from bilprov.analyzer.cli.options import (
    confirm_motion,
    line_options,
    note,
    note_hindrances,
    timeout_option,
)
from bilprov.analyzer.cli.typed_input import bytes_from_hex, encoded
from bilprov.analyzer.columns.decoder import Records
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.outputs import stream_output
from bilprov.analyzer.replay.target import Target
from bilprov.analyzer.transport.line_settings import line_settings, timeout_in_ns
from bilprov.analyzer.transport.ports import open_port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.spec.protocol import Protocol

_PAUSE = "pause="


@click.command()
@click.argument("port", metavar="PORT")
@click.argument("items", nargs=-1, required=True, metavar="ITEM...")
@click.option("--together", is_flag=True, help="Send without waiting for the answers.")
@click.option(
    "--format", "style", type=click.Choice(["lines", "jsonl"]), default="lines", show_default=True
)
@click.option("--yes", is_flag=True, help="The robot may move: do not ask.")
@line_options
@timeout_option
@click.pass_obj
def send(
    grammar: str | None,
    port: str,
    items: tuple[str, ...],
    together: bool,
    style: Literal["lines", "jsonl"],
    yes: bool,
    baud: int | None,
    parity: str | None,
    stopbits: str | None,
    truncation_timeout: float | None,
) -> int:
    """Send instructions or bytes to a device, one after the other.

    Each ITEM is an instruction (Forward, "Speed 255", "LED rgb=5"), bytes in hex ("93 00"), or
    pause=MS. The device is homed first and on every way out. Exit code: 0 everything was answered,
    1 something was not, 2 the port cannot be used or nobody answers.
    """
    protocol = load_protocol(grammar)
    try:
        steps = [step(protocol, item) for item in items]
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    settings = line_settings(protocol, baud, parity, stopbits)
    timeout = timeout_in_ns(protocol, truncation_timeout)
    opened = open_port(port, settings)
    with opened:
        note_hindrances(port)
        confirm_motion(f"the robot at {port} will do what is sent", yes=yes)
        output = stream_output(style)
        with (
            Stopper() as stopper,
            Target(
                protocol, opened, timeout, stopper, lambda record: output.show(Records([record]))
            ) as target,
        ):
            target.begin()
            for what in steps:
                if stopper.stopped:
                    break
                if isinstance(what, float):
                    target.wait(what)
                    continue
                target.send(what)
                if not together:
                    target.settle()
            target.finish()
    frames, answers = target.run.frames, target.run.answers
    if len(answers) < len(frames):
        note(f"{len(frames) - len(answers)} of {len(frames)} instructions were not answered")
        return 1
    return 0


def step(protocol: Protocol, item: str) -> bytes | float:
    """Parse an item of the command line into bytes to send, or a pause in s. Raises ValueError."""
    if item.startswith(_PAUSE):
        try:
            pause = float(item.removeprefix(_PAUSE))
        except ValueError:
            pause = -1.0
        if not 0 <= pause <= 60_000:
            raise ValueError(f"{item!r} is no pause; write pause=MS with 0 to 60000 milliseconds")
        return pause / 1000
    name, *words = item.split()
    if any(spec.name.lower() == name.lower() for spec in protocol.instructions):
        return encoded(protocol, name, words)
    try:
        return bytes_from_hex(item)
    except ValueError as error:
        names = ", ".join(spec.name for spec in protocol.instructions)
        raise ValueError(f"{error}, or an instruction: {names}") from error
