"""Options that several commands share, and the conversion of their values.

It loads nothing that takes long, since commands that only print a help import it too.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from bilprov.analyzer.cli.settings import naming_file
from bilprov.spec.errors import one_line

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter
    from bilprov.analyzer.output.outputs import Format
    from bilprov.analyzer.output.row_columns import RowStyle
    from bilprov.analyzer.replay.rotation import Rotation
    from bilprov.analyzer.transport.signals import Stopper
    from bilprov.spec.protocol import Protocol

Command = TypeVar("Command", bound=Callable[..., Any])


class Finite(click.FloatRange):
    """A range of numbers, the type of every option that takes one; without a `max` up to 1e10.

    That many seconds still fit into a capture. It leaves out nan, which click's own lets pass.
    """

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The number of an option's value."""
        number: float = super().convert(value, param, ctx)
        if not abs(number) <= 1e10:
            most = 1e10 if self.max is None else self.max
            self.fail(f"{value} is not a number up to {most:g}", param, ctx)
        return number


# Times in ms that something is divided by, or that mean nothing where they are 0 ns.
milliseconds = Finite(0.001, 60_000)


class RotateAt(click.ParamType):  # type: ignore[type-arg]  # takes arguments since click 8.5
    """A size or a time at which a part of a recording is full, as a Rotation."""

    name = "SIZE|TIME"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Rotation:
        """The Rotation of an option's value."""
        from bilprov.analyzer.replay.rotation import rotation_at

        try:
            return rotation_at(str(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)


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


_FILTER = """\
Show only the rows for which EXPR holds, like "faulty and latency > 20ms". Names: the fields of the
grammar, id len data sequence response latency answers agrees name direction kind hex judgement
faulty faults reason t time state.motion (speed, steering, led, moving). Signs: == != < <= > >= in
contains & and or not; names in any case. docs/filters.md explains them."""


def filter_option(command: Command) -> Command:
    """Add `--filter EXPR`, as `expression`."""
    return click.option("--filter", "expression", metavar="EXPR", help=_FILTER)(command)


# Who sent the bytes, as `sender`.
sender_option = click.option(
    "--from",
    "sender",
    type=click.Choice(["host", "device"]),
    default="host",
    show_default=True,
    help="Who sent the bytes.",
)

# The format of a text command (text or json), as `style`.
text_format_option = click.option(
    "--format",
    "style",
    type=click.Choice(["text", "json"]),
    default="text",
    show_default=True,
    help="For people or for programs.",
)

# The format of a session (live, lines, jsonl or csv), as `style`, None if it is not given.
session_format_option = click.option(
    "--format",
    "style",
    type=click.Choice(["live", "lines", "jsonl", "csv"]),
    help="A screen (on a terminal), text lines (in a pipe), JSON lines, or CSV.",
)

# Whether text lines are asked for, as `plain`.
plain_option = click.option(
    "--plain", is_flag=True, help="Text lines on a terminal too: the same as --format lines."
)


def session_style(style: Format | None, plain: bool) -> Format:
    """The format of a session, from --format and --plain.

    Raises UsageError where they contradict each other, or where there is no terminal for a screen.
    """
    from bilprov.analyzer.output.outputs import chosen_format, has_terminal

    if plain and style not in (None, "lines"):
        raise click.UsageError(f"--plain is --format lines: give it or --format {style}, not both")
    if style == "live" and not has_terminal():
        raise click.UsageError(
            "--format live needs a terminal to show a screen on and to take keys from; for a pipe "
            "use --format lines"
        )
    return "lines" if plain else chosen_format(style)


def row_options(command: Command) -> Command:
    """Add `--time` and `--columns`, whose values `row_style` takes."""
    command = click.option(
        "--columns",
        metavar="NAME,...",
        help="What is shown of each row, like time,name,rgb,latency: keys of the JSON lines, "
        "state.speed and so on, id, len, data, and fields of instructions.",
    )(command)
    return click.option(
        "--time",
        "time_style",
        metavar="STYLE",
        type=click.Choice(["relative", "delta", "absolute", "utc"]),
        help="How times are shown: relative, seconds since the start (the usual); delta, since the "
        "row before; absolute, date and time of day here; utc, the same in UTC.",
    )(command)


def row_style(
    time_style: str | None, columns: str | None, protocol: Protocol, style: str | None = None
) -> RowStyle:
    """What was asked for of each row, in the format `style`.

    Raises UsageError where the format has no choice of columns or times, or a time is to be
    written that is not among the columns; a setting is left alone there. Raises ColumnError for
    what is no column.
    """
    from bilprov.analyzer.output.row_columns import TIME, RowStyle, TimeStyle, chosen_columns

    if style == "jsonl":
        if asked_here("time_style") or asked_here("columns"):
            raise click.UsageError(
                "--time and --columns are for lines and csv: a JSON line has all its keys, and t "
                "in seconds since the start"
            )
        return RowStyle()
    with naming_file("columns"):
        chosen = None if columns is None else chosen_columns(columns, protocol)
    if asked_here("time_style") and chosen and TIME not in chosen:
        raise click.UsageError(
            f"--time {time_style} is how the column time is written: name it in --columns too"
        )
    return RowStyle(TimeStyle(time_style) if time_style else None, chosen)


def asked_here(parameter: str) -> bool:
    """Whether a parameter has its value from the command line.

    A setting is for many uses of a command: where one has no use for it, it is no mistake.
    """
    source = click.get_current_context().get_parameter_source(parameter)
    return source is ParameterSource.COMMANDLINE


# In ms, as `truncation_timeout`, None if it is not given.
timeout_option = click.option(
    "--truncation-timeout",
    metavar="MS",
    type=milliseconds,
    help="Longest pause inside a frame, in milliseconds; the grammar's unless given.",
)

# In s, as `max_drive`.
max_drive_option = click.option(
    "--max-drive",
    metavar="S",
    type=Finite(0),
    default=30.0,
    show_default=True,
    help="Stop the robot after driving so long without a new instruction; 0 for no limit.",
)

# Whether the device is judged by what passes, as `judged`.
judge_option = click.option(
    "--judge",
    "judged",
    is_flag=True,
    help="Judge the device by the traffic; coverage and violations are shown at the end.",
)


def compiled(expression: str | None, protocol: Protocol) -> Filter | None:
    """Compile a filter expression; None if there is none. Raises FilterError."""
    if expression is None:
        return None
    from bilprov.analyzer.filters.filter import compile_filter

    with naming_file("expression"):
        return compile_filter(expression, protocol)


def note(sentence: str) -> None:
    """Print a note on standard error, so that standard output holds nothing but the records.

    It is made safe to show; one line, which a terminal shows broken between words.
    """
    click.echo(_wrapped(one_line(sentence)), err=True)


def _wrapped(text: str) -> str:
    """The text broken between words where standard error is a terminal, unchanged elsewhere."""
    if not sys.stderr.isatty():
        return text
    from shutil import get_terminal_size
    from textwrap import fill

    width = get_terminal_size().columns
    return fill(text, width, break_long_words=False, break_on_hyphens=False)


def note_suspension(stopper: Stopper) -> None:
    """Print a note if a run ends because Ctrl-Z has suspended it."""
    if stopper.suspended:
        note("the program was suspended: the robot was stopped first, and the run ends here")


def note_hindrances(*names: str) -> None:
    """Print a note for what makes opened ports slow or unsafe; URLs and ptys have nothing."""
    from bilprov.analyzer.doctor.system import notes

    for name in names:
        for sentence in notes(name):
            note(sentence)


class NotConfirmed(click.ClickException):
    """The user has not allowed the device to move. The message is one sentence, exit code 2."""

    exit_code = 2


def confirm_motion(protocol: Protocol, what: str, *, yes: bool, option: str = "--yes") -> None:
    """Ask whether the device may move, and return if it may or no instruction moves it.

    `what` says what will move, like `the device at /dev/ttyUSB0 will drive as recorded`; `yes` is
    the value of the command's `--yes` (or of the option named `option`). Raises NotConfirmed if the
    answer is no, or if there is no terminal to ask on.
    """
    from bilprov.spec.movement import all_movement

    if yes or not all_movement(protocol).motions:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise NotConfirmed(
            f"{what}: there is no terminal to ask on, so give {option} if it may move"
        )
    if not click.confirm(_wrapped(one_line(f"{what}. Is there room, and may it move?")), err=True):
        raise NotConfirmed("nothing was sent: the device may not move")
