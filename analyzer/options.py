"""Options that several commands share, each said once; click's values in, the kit's values out."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar

import rich_click as click

from analyzer.decode.pairing import MILLISECOND
from analyzer.output.filter_names import HELP as FILTER_HELP
from analyzer.output.json_lines import JsonLine
from analyzer.output.outputs import Format, JsonOutput, LinesOutput, Output
from analyzer.output.statistics import Statistics
from analyzer.transport.line_settings import LineSettings
from spec.protocol import Protocol

Command = TypeVar("Command", bound=Callable[..., Any])


def line_options(command: Command) -> Command:
    """How the line is set: `baud`, `parity`, `stopbits`, None where the grammar's default holds."""
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


def line_settings(
    protocol: Protocol, baud: int | None, parity: str | None, stopbits: str | None
) -> LineSettings:
    """The line as told, the grammar's own where nothing was told."""
    line = protocol.line
    return LineSettings(
        baud=line.baud if baud is None else baud,
        parity=line.parity if parity is None else parity.upper(),
        stopbits=line.stopbits if stopbits is None else float(stopbits),
    )


def filter_option(command: Command) -> Command:
    """`--filter EXPR`, as `expression`."""
    return click.option("--filter", "expression", metavar="EXPR", help=FILTER_HELP)(command)


def timeout_option(command: Command) -> Command:
    """`--truncation-timeout MS`, as `truncation_timeout`, None where it was not given."""
    return click.option(
        "--truncation-timeout",
        metavar="MS",
        type=click.FloatRange(0, min_open=True, max=60_000),
        help="Longest pause inside a frame, in milliseconds; the grammar's unless given.",
    )(command)


def judge_option(command: Command) -> Command:
    """`--judge`, as `judged`."""
    return click.option(
        "--judge",
        "judged",
        is_flag=True,
        help="Judge the device by what passes: at the end what was covered, and violations.",
    )(command)


def timeout_in_ns(protocol: Protocol, milliseconds: float | None) -> int:
    """The truncation time-out in ns, the grammar's own where none was given."""
    if milliseconds is None:
        milliseconds = protocol.timing.truncation_timeout
    return round(milliseconds * MILLISECOND)


def compiled(expression: str | None, protocol: Protocol) -> Callable[[JsonLine], bool] | None:
    """The filter, None where there is none. Raises FilterError."""
    if expression is None:
        return None
    from analyzer.output.filter import compile_filter

    return compile_filter(expression, protocol)


def opened_output(
    style: Format,
    protocol: Protocol,
    statistics: Statistics,
    title: str,
    captured: Callable[[], str] = lambda: "",
) -> Output:
    """The output of that format on standard output."""
    if style == "jsonl":
        return JsonOutput(sys.stdout)
    if style == "lines":
        return LinesOutput(sys.stdout)
    from analyzer.output.live_output import LiveOutput

    return LiveOutput(protocol, statistics, title, captured)


def note(sentence: str) -> None:
    """A sentence beside the output: on standard error, so that standard output stays pure."""
    click.echo(sentence, err=True)
