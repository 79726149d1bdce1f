"""Options that several commands share, and the conversion of their values.

It loads nothing that takes long, since commands that only print a help import it too.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import click
import msgspec

from bilprov.analyzer.cli.command import asked_here, flag, group, option, refuse
from bilprov.analyzer.cli.settings import PortName
from bilprov.spec.errors import one_line

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter
    from bilprov.analyzer.output.outputs import Format, Window
    from bilprov.analyzer.output.row_columns import RowStyle
    from bilprov.analyzer.transport.line_settings import LineSettings
    from bilprov.analyzer.transport.signals import Stopper
    from bilprov.spec.protocol import Protocol


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


_FILTER = """\
Show only the rows for which EXPR holds, like "faulty and latency > 20ms". Names: the fields of the
grammar, id len data sequence response latency latency_ns answers agrees name direction kind hex
bytes judgement faulty faults reason t t_ns time state.* fields.*. Signs: == != < <= > >= in
contains & and or not; names in any case. docs/filters.md explains them."""


# Options of several commands that are one field each.
port_option = partial(option, metavar="PORT", type=PortName())
output_option = partial(option, "-o", "--output")
sender_option = partial(
    option,
    "--from",
    type=click.Choice(["host", "device"]),
    default="host",
    help="Who sent the bytes.",
)
request_option = partial(
    option,
    metavar="REQUEST",
    help="What --from device answers: an instruction with its fields, or requests in hex.",
)
text_format_option = partial(
    option,
    "--format",
    type=click.Choice(["text", "json"]),
    default="text",
    help="For people or for programs.",
)
filter_option = partial(option, "--filter", metavar="EXPR", help=_FILTER)
timeout_option = partial(
    option,
    metavar="MS",
    type=milliseconds,
    help="Longest pause inside a frame, in milliseconds; the grammar's unless given.",
)
max_drive_option = partial(
    option,
    metavar="S",
    type=Finite(0),
    default=30.0,
    help="Stop the robot after driving so long without a new instruction; 0 for no limit.",
)
half_duplex_option = partial(
    flag, "One tap was on a wire with both directions: separate them, as sniff --half-duplex."
)
only_reading_option = partial(
    flag,
    "Send only what the grammar knows to change nothing. A device that can be stopped is stopped "
    "all the same.",
)
yes_option = partial(flag, "The robot may move: do not ask.")

LINE = ("baud", "parity", "stopbits")
"""The names of `LineOptions`."""
SENDING_LINE = (*LINE, "echo")
"""The names of `SendingLineOptions`."""


class FormatOption(msgspec.Struct, frozen=True):
    """The format in which something is shown."""

    style: str = text_format_option()


class LineOptions(msgspec.Struct, frozen=True):
    """The settings of a serial line; None stands for the grammar's value."""

    baud: int | None = option(type=click.IntRange(1), help="Bits/s; the grammar's unless given.")
    parity: str | None = option(
        type=click.Choice(list("NEOMS"), case_sensitive=False),
        help="None, even, odd, mark or space; the grammar's unless given.",
    )
    stopbits: str | None = option(
        type=click.Choice(["1", "1.5", "2"]), help="The grammar's unless given."
    )

    def settings(self, protocol: Protocol) -> LineSettings:
        """The settings of the line. Raises ValueError."""
        from bilprov.analyzer.transport.line_settings import line_settings

        stopbits = None if self.stopbits is None else float(self.stopbits)
        return line_settings(protocol, self.baud, self.parity, stopbits)


class SendingLineOptions(LineOptions, frozen=True):
    """The settings of a serial line that is sent on."""

    echo: bool = flag(
        "What is sent comes back, as on a bus whose adapter hears itself: take that echo away."
    )

    def settings(self, protocol: Protocol) -> LineSettings:
        """The settings of the line. Raises ValueError."""
        from dataclasses import replace

        return replace(super().settings(protocol), echo=self.echo)


class RowOptions(msgspec.Struct, frozen=True):
    """What is shown of each row, and how its time is."""

    time_style: str | None = option(
        "--time",
        metavar="STYLE",
        type=click.Choice(["relative", "delta", "absolute", "utc"]),
        help="How times are shown: relative, seconds since the start (the usual); delta, since the "
        "row before; absolute, date and time of day here; utc, the same in UTC.",
    )
    columns: str | None = option(
        metavar="NAME,...",
        help="What is shown of each row, like time,name,rgb,latency: keys of the JSON lines, "
        "state.speed and so on, id, len, data, and fields of instructions.",
    )

    def style(self, protocol: Protocol, format: str | None = None) -> RowStyle:
        """What was asked for of each row, in a format.

        Raises UsageError where the format has no choice of columns or times, or a time is to be
        written that is not among the columns; a setting is left alone there. Raises ColumnError for
        what is no column.
        """
        from bilprov.analyzer.output import row_columns

        if format == "jsonl":
            if asked_here("time_style") or asked_here("columns"):
                raise click.UsageError(
                    "--time and --columns are for lines and csv: a JSON line has all its keys, and "
                    "t in seconds since the start"
                )
            return row_columns.RowStyle()
        known, chosen = row_columns.columns_of(protocol), None
        if self.columns is not None:
            chosen = row_columns.chosen_columns(self.columns, known)
        if asked_here("time_style") and chosen and row_columns.TIME not in chosen:
            raise click.UsageError(
                f"--time {self.time_style} is how the column time is written: name it in --columns "
                "too"
            )
        time = row_columns.TimeStyle(self.time_style) if self.time_style else None
        return row_columns.RowStyle(time, chosen)


class WindowOptions(msgspec.Struct, frozen=True):
    """From when to when a capture is read, in s since its start."""

    start: float | None = option(type=Finite(0), help="Begin at this second of the capture.")
    end: float | None = option(type=Finite(0), help="End before this second of the capture.")

    def window(self, duration: float | None = None) -> Window:
        """The window of time; it ends at `end` or after the duration (s), whichever is first.

        Raises UsageError for an end that is not after the start.
        """
        from bilprov.analyzer.output.outputs import Window

        if self.start is not None and self.end is not None and self.end <= self.start:
            raise click.UsageError(f"--end {self.end:g} is not after --start {self.start:g}")
        lasting = None if duration is None else (self.start or 0) + duration
        ends = [end for end in (self.end, lasting) if end is not None]
        bounds = (self.start, min(ends, default=None))
        return Window(*(None if s is None else round(s * 1e9) for s in bounds))


class ShownOptions(msgspec.Struct, frozen=True):
    """What a session shows, and in which form."""

    expression: str | None = filter_option()
    format: Format | None = option(
        type=click.Choice(["live", "lines", "jsonl", "csv"]),
        help="A screen (on a terminal), text lines (in a pipe), JSON lines, or CSV.",
    )
    rows: RowOptions = group(RowOptions)
    count: int | None = option(type=click.IntRange(1), help="End after so many frames were shown.")
    plain: bool = flag("Text lines on a terminal too, unless --format is given.")
    judged: bool = flag(
        "Judge the device by the traffic; coverage and violations are shown at the end.", "--judge"
    )

    def style(self, *, in_lines: bool = False) -> Format:
        """The format that was chosen; not the screen where it is to be `in_lines`.

        Raises UsageError where a screen is asked for and cannot be.
        """
        from bilprov.analyzer.output.outputs import has_terminal

        if self.format == "live" and (in_lines or not has_terminal()):
            raise click.UsageError(
                "--format live needs a terminal to show a screen on and to take keys from; it does "
                "not go with --to or --judge: use --format lines"
            )
        return self.format or ("lines" if self.plain or in_lines or not has_terminal() else "live")


def only_for_ports(names: Iterable[str], target: str) -> None:
    """Raise UsageError for the first option that is typed, though the target is no port."""
    refuse(names, f"is for ports; {target} is not a port")


@contextmanager
def refused(kind: type[click.ClickException] = click.ClickException) -> Iterator[None]:
    """Raise what the block raises as ValueError, in one sentence, as a mistake of the user."""
    try:
        yield
    except ValueError as error:
        raise kind(str(error)) from None


def only_for_bytes() -> None:
    """Raise UsageError if --from is typed, though the bytes are of a capture."""
    refuse(["sender"], "is for bytes: a capture has their directions")


def compiled(expression: str | None, protocol: Protocol) -> Filter | None:
    """Compile a filter expression; None if there is none. Raises FilterError."""
    if expression is None:
        return None
    from bilprov.analyzer.filters.filter import compile_filter

    return compile_filter(expression, protocol)


def note(*sentences: str) -> None:
    """Print notes on standard error, so that standard output holds nothing but the records.

    Each is made safe to show; one line, which a terminal shows broken between words. Empty ones are
    left out.
    """
    for sentence in filter(None, sentences):
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


def above_latency(timeout: int, *ports: str) -> int:
    """The ns of silence after which a frame is cut: no less than adapters cause by themselves."""
    from bilprov.analyzer.transport.machine import Machine
    from bilprov.captures.schemas import MS

    least = Machine().least_pause(*ports)
    if timeout < least:
        note(
            f"a frame is cut after {least / MS:g} ms of silence instead of {timeout / MS:g} ms, "
            "because an adapter holds bytes back nearly so long"
        )
    return max(timeout, least)


def note_hindrances(*names: str) -> None:
    """Print a note for what makes opened ports slow or unsafe; URLs and ptys have nothing."""
    from bilprov.analyzer.doctor.examination import notes

    for name in names:
        note(*notes(name))


class NotConfirmed(click.ClickException):
    """The user has not allowed the device to move. The message is one sentence, exit code 2."""

    exit_code = 2


def confirm_effect(
    protocol: Protocol, what: str, words: str, *, yes: bool, option: str = "--yes"
) -> None:
    """Ask whether the device may do what is sent, and return if it may or that changes nothing.

    `what` says what will be done, like `the device at /dev/ttyUSB0 will move as recorded`, and
    `words` what that may change (`effect_words`), "" for nothing. `yes` is the value of the
    command's `--yes` (or of the option named `option`). Raises NotConfirmed if the answer is no, or
    if there is no terminal to ask on.
    """
    if yes or not words:
        return
    what = f"{what}: {words}"
    may = "may move" if protocol.wheels else "may"
    room = "Is there room, and may it move?" if protocol.wheels else "May it?"
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise NotConfirmed(f"{what}: there is no terminal to ask on, so give {option} if it {may}")
    if not click.confirm(_wrapped(one_line(f"{what}. {room}")), err=True):
        end = " move" if protocol.wheels else " be changed"
        raise NotConfirmed(f"nothing was sent: the device may not{end}")


def require_reading(protocol: Protocol, frames: Iterable[bytes]) -> None:
    """Raise UsageError for the first frame that is not known to change nothing."""
    from bilprov.spec.by_effect import change_by

    for frame in frames:
        why = change_by(protocol, frame)
        if why:
            raise click.UsageError(f"{why}: --only-reading sends what changes nothing")
