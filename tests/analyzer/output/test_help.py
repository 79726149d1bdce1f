"""The help pages: their width, paragraphs, panels, options and colours."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

from bilprov.__main__ import COMMANDS
from bilprov.analyzer.output.help import Group, Page, PageCommand
from bilprov.analyzer.transport.pty import open_pty
from tests.support import ROOT
from tests.support.commands import PATIENCE, command

ESCAPE = "\x1b"
WIDTHS = (40, 60, 80, 120)


def page(*words: str, columns: int = 80) -> list[str]:
    result = command(*words, "--help", COLUMNS=str(columns))
    assert (result.returncode, result.stderr) == (0, b"")
    return result.stdout.decode().splitlines()


@click.group("kit", cls=Group, epilog="Ends well.")
@click.option("-v", "--verbose", is_flag=True, help="Say more.")
@click.option("--rate", type=click.FloatRange(0, 1), default=0.5, show_default=True, help="Rate.")
@click.option("--port", required=True, help="Where to.")
def kit() -> None:
    """Do one thing,
    and another.

    Use it well-meant.
    """


@kit.command("run", cls=PageCommand)
@click.argument("file")
def run(file: str) -> None:
    """Run a file with a sentence that is longer than one line of such a narrow page as this."""


def made(columns: int) -> str:
    with click.Context(kit, info_name="kit") as context:
        formatter = Page(columns)
        kit.format_help(context, formatter)
    return formatter.getvalue()


def test_a_page_has_usage_paragraphs_commands_options_with_their_limits_and_the_epilog(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("NO_COLOR", "1")

    assert (
        made(60)
        == """\
Usage: kit [OPTIONS] COMMAND [ARGS]...

  Do one thing, and another.

  Use it well-meant.

Commands:
  run  Run a file with a sentence that is longer than one
       line of such a narrow page as this.

Options:
  -v, --verbose     Say more.
      --rate FLOAT  Rate.  [default: 0.5; 0<=x<=1]
      --port TEXT   Where to.  [required]
      --help        Show this message and exit.

  Ends well.
"""
    )


@pytest.mark.parametrize("columns", WIDTHS)
@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_a_page_is_as_wide_as_the_terminal_and_ends_no_line_in_a_blank(
    name: str, columns: int
) -> None:
    lines = page(*name.split(), columns=columns)
    lines = [line for line in lines if not line.startswith("    bilprov ")]  # examples, to copy

    assert [line for line in lines if len(line) > columns or line != line.rstrip()] == []
    if columns > 40:
        assert max(map(len, lines)) > 0.75 * min(columns, 80)


def test_a_very_wide_terminal_gets_no_endless_lines() -> None:
    assert max(map(len, page("conform", columns=500))) <= 120


def test_no_line_is_broken_at_a_hyphen() -> None:
    for columns in range(60, 121, 5):
        lines = page("conform", columns=columns)
        assert [line for line in lines if re.search(r"\w-$", line)] == []


@pytest.mark.waits
@pytest.mark.parametrize(
    ("variables", "coloured"),
    [
        ({}, True),
        ({"NO_COLOR": ""}, True),
        ({"NO_COLOR": "1"}, False),
        ({"TERM": "dumb"}, False),
    ],
)
def test_a_terminal_gets_the_same_page_in_colours_unless_they_are_not_wanted(
    variables: dict[str, str], coloured: bool
) -> None:
    given = {name: value for name, value in os.environ.items() if name != "NO_COLOR"}
    with open_pty() as terminal, Path(terminal.name).open("wb") as stdout:
        ended = subprocess.run(
            [sys.executable, "-m", "bilprov", "--help"],
            cwd=ROOT,
            stdout=stdout,
            env=given | {"TERM": "xterm", "COLUMNS": "80"} | variables,
            timeout=PATIENCE,
            check=False,
        )
        shown = terminal.read().decode()

    assert ended.returncode == 0
    assert (ESCAPE in shown) == coloured
    assert re.sub(ESCAPE + r"\[\d+m", "", shown).splitlines() == page()
