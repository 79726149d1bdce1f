"""Options that several commands share, and the conversion of their values.

It loads nothing that takes long, since commands that only print a help import it too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import rich_click as click

if TYPE_CHECKING:
    from bilprov.analyzer.output.json_lines import JsonLine
    from bilprov.spec.protocol import Protocol

Command = TypeVar("Command", bound=Callable[..., Any])


def line_options(command: Command) -> Command:
    """Add the line options `baud`, `parity`, `stopbits`; None stands for the grammar's value."""
    options = (
        click.option("--baud", type=click.IntRange(1), help="Bits/s; the grammar's unless given."),
        click.option(
            "--parity",
            type=click.Choice(list("NEOMS"), case_sensitive=False),
            help="None, even, odd, mark or space; the grammar's unless given.",
        ),
        click.option(
            "--stopbits", type=click.Choice(["1", "1.5", "2"]), help="The grammar's unless given."
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def filter_option(command: Command) -> Command:
    """Add `--filter EXPR`, as `expression`."""
    from bilprov.analyzer.output.filter_names import HELP

    return click.option("--filter", "expression", metavar="EXPR", help=HELP)(command)


def sender_option(command: Command) -> Command:
    """Add `--from` (host or device), as `sender`."""
    return click.option(
        "--from",
        "sender",
        type=click.Choice(["host", "device"]),
        default="host",
        show_default=True,
        help="Who sent the bytes.",
    )(command)


def text_format_option(command: Command) -> Command:
    """Add `--format` (text or json), as `style`."""
    return click.option(
        "--format",
        "style",
        type=click.Choice(["text", "json"]),
        default="text",
        show_default=True,
        help="For people or for programs.",
    )(command)


def session_format_option(command: Command) -> Command:
    """Add `--format` (live, lines or jsonl), as `style`, None if it is not given."""
    return click.option(
        "--format",
        "style",
        type=click.Choice(["live", "lines", "jsonl"]),
        help="A picture (on a terminal), text lines (in a pipe), or JSON lines.",
    )(command)


def timeout_option(command: Command) -> Command:
    """Add `--truncation-timeout MS`, as `truncation_timeout`, None if it is not given."""
    return click.option(
        "--truncation-timeout",
        metavar="MS",
        type=click.FloatRange(0, min_open=True, max=60_000),
        help="Longest pause inside a frame, in milliseconds; the grammar's unless given.",
    )(command)


def judge_option(command: Command) -> Command:
    """Add `--judge`, as `judged`."""
    return click.option(
        "--judge",
        "judged",
        is_flag=True,
        help="Judge the device by what passes: at the end what was covered, and violations.",
    )(command)


def compiled(expression: str | None, protocol: Protocol) -> Callable[[JsonLine], bool] | None:
    """Compile a filter expression; None if there is none. Raises FilterError."""
    if expression is None:
        return None
    from bilprov.analyzer.output.filter import compile_filter

    return compile_filter(expression, protocol)


def note(sentence: str) -> None:
    """Print a note on standard error, so that standard output holds nothing but the records."""
    click.echo(sentence, err=True)
