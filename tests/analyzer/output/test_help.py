"""The help pages: their width, paragraphs, panels, options and colours."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from bilprov.__main__ import COMMANDS
from bilprov.analyzer.transport.port import open_pty
from tests.support import ROOT
from tests.support.commands import PATIENCE, command

ESCAPE = "\x1b"
WIDTHS = (40, 80, 500)


def page(*words: str, columns: int = 80) -> list[str]:
    result = command(*words, "--help", COLUMNS=str(columns))
    assert (result.returncode, result.stderr) == (0, b"")
    return result.stdout.decode().splitlines()


@pytest.mark.parametrize("columns", WIDTHS)
@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_a_page_is_as_wide_as_the_terminal_and_ends_no_line_in_a_blank(
    name: str, columns: int
) -> None:
    lines = page(*name.split(), columns=columns)
    lines = [line for line in lines if not line.startswith("    bilprov ")]  # examples, to copy

    assert [line for line in lines if len(line) > min(columns, 120) or line != line.rstrip()] == []
    if columns > 40:
        assert max(map(len, lines)) > 0.75 * min(columns, 80)


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
