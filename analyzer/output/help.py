"""Help pages of the commands: as wide as the terminal, commands by panel, colours on a terminal."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from inspect import cleandoc
from typing import Any

import click

_WIDTH = 80  # columns, where there is no terminal
_WIDEST = 120  # columns; longer lines of prose are hard to read
_TERM_WIDEST = 30  # columns of an option and its value; the help of a longer one begins below it
_SHORT = re.compile(r"-\w")  # how an option begins that has a short spelling
_NAMES = re.compile(r"(?<!\S)--?\w[\w-]*|^\s*\w+")  # an option's spellings, or the first word
HELP_NAMES = ("-h", "--help")
_EXAMPLES = "Examples:"
_OTHERS = "Options"  # the heading of options without one of their own


class Page(click.HelpFormatter):
    """Formats one help page. Where there is no terminal, click.echo drops its colours.

    Unlike click's own it is never wider than the terminal, and breaks no line at a hyphen: names of
    options and their values can be searched for and copied.
    """

    def __init__(self, width: int | None = None, max_width: int | None = None) -> None:
        super().__init__(width=width or min(terminal_width(), _WIDEST))

    def write_usage(self, prog: str, args: str = "", prefix: str | None = None) -> None:
        """Write the usage line."""
        self._write(f"{prog} {args}", f"{prefix or 'Usage:'} ", bold=True)

    def write_heading(self, heading: str) -> None:
        """Write the heading of a panel."""
        self._write("", f"{heading}:", bold=True)

    def write_text(self, text: str) -> None:
        """Write prose; its paragraphs stay, and each is wrapped anew, but for examples."""
        margin = " " * self.current_indent
        for number, paragraph in enumerate(re.split(r"\n\s*\n", text)):
            self.write("\n" if number else "")
            examples = examples_in(paragraph)
            if examples:
                self._write("", f"{margin}{_EXAMPLES}", bold=True)
                self.write("".join(f"{margin}  {line}\n" for line in examples))
            else:
                self._write(" ".join(paragraph.split()), margin)

    def write_dl(
        self, rows: Iterable[tuple[str, str]], col_max: int = _TERM_WIDEST, col_spacing: int = 2
    ) -> None:
        """Write options or commands with their help beside them, the long options in one column."""
        # The range itself stands in brackets behind the help.
        terms, texts = zip(
            *((term.removesuffix(" RANGE"), text) for term, text in rows), strict=True
        )
        if any(map(_SHORT.match, terms)):
            terms = tuple(term if _SHORT.match(term) else f"    {term}" for term in terms)
        widest = min(col_max, self.width // 2 - 4)
        column = max((len(term) for term in terms if len(term) <= widest), default=widest)
        margin = " " * self.current_indent
        for term, text in zip(terms, texts, strict=True):
            if len(term) > widest:
                self._write("", margin + term)
                term = ""
            self._write(text, margin + term.ljust(column + col_spacing))

    def _write(self, text: str, lead: str, *, bold: bool = False) -> None:
        """Write `lead`, its names in colour or bold, and the text wrapped to the right of it."""
        from textwrap import fill

        indent = " " * len(lead)
        wrapped = fill(
            text,
            self.width,
            initial_indent=indent,
            subsequent_indent=indent,
            break_on_hyphens=False,
        )
        # https://no-color.org: any value that is not empty.
        if not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb":
            fg = None if bold else "cyan"
            lead = _NAMES.sub(lambda name: click.style(name[0], fg=fg, bold=bold or None), lead)
        self.write(f"{lead}{wrapped[len(indent) :]}\n")


def terminal_width() -> int:
    """The columns of the terminal, or what COLUMNS says; 80 where there is none.

    As shutil's, whose import takes longer than the rest of a help page.
    """
    said = os.environ.get("COLUMNS", "")
    if said.isdecimal() and int(said):
        return int(said)
    with suppress(OSError):
        return os.get_terminal_size().columns or _WIDTH
    return _WIDTH


def examples_in(text: str) -> list[str]:
    """The command lines below the line `Examples:` of a help text, up to its next empty line."""
    _, found, below = text.partition(_EXAMPLES + "\n")
    lines = re.split(r"\n\s*\n", below, maxsplit=1)[0].splitlines() if found else []
    return [line.strip() for line in lines]


class PageContext(click.Context):
    """The context of a command whose help is a Page, and asked for with -h or --help.

    A command keeps the help option that its first context has made, so each is made of this class.
    """

    formatter_class = Page

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **{"help_option_names": list(HELP_NAMES)} | options)


class PageOption(click.Option):
    """An option that may stand under a heading of its own in the help."""

    def __init__(self, *arguments: Any, heading: str = _OTHERS, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.heading = heading


class PageCommand(click.Command):
    """A command whose help is a Page: its `short_help`, its help, the options by their headings."""

    context_class = PageContext

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write what the command does, and the rest of its help."""
        formatter.write_paragraph()
        with formatter.indentation():
            text = cleandoc(self.help or "")
            formatter.write_text(f"{self.short_help}\n\n{text}" if self.short_help else text)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options below their headings; those without one are the last."""
        rows: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            if isinstance(param, click.Option) and (record := param.get_help_record(ctx)):
                rows.setdefault(getattr(param, "heading", _OTHERS), []).append(record)
        for heading in sorted(rows, key=_OTHERS.__eq__):
            with formatter.section(heading):
                formatter.write_dl(rows[heading])


class Group(click.Group):
    """A group of commands whose help lists them before the options, by panel and unabridged."""

    context_class = PageContext
    group_class = type  # the groups below it are of this class too

    def panels(self, ctx: click.Context) -> Mapping[str, Sequence[str]]:
        """The names of the commands to list, by the heading above them."""
        return {"Commands": self.list_commands(ctx)}

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the panels of commands, then the options."""
        for heading, names in self.panels(ctx).items():
            commands = ((name, self.get_command(ctx, name)) for name in names)
            with formatter.section(heading):
                formatter.write_dl(
                    [(name, one.get_short_help_str(limit=1000)) for name, one in commands if one]
                )
        click.Command.format_options(self, ctx, formatter)
