"""docs/filters.md: each example selects the rows that it says, each mistake is told as it says."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import pytest

from bilprov.analyzer.decode.batch import Records
from bilprov.analyzer.decode.json_lines import JsonLine, json_line
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.filters.fields import fields_of
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.filters.syntax import FilterError
from bilprov.analyzer.filters.values import offset
from bilprov.captures.schemas import Chunk
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.commands import command
from tests.support.decoding import MS, decoded

START = 1_795_356_200  # 2026-11-22 14:03:20 in UTC

PAGE = (ROOT / "docs" / "filters.md").read_text(encoding="utf-8")


def table(heading: str) -> list[list[str]]:
    """The cells of the table below a heading, without its two head rows."""
    below = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = [line for line in below.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1]] for row in rows]


ROWS = table("An example to try things on")
EXAMPLES = [(cells[0].strip("`"), cells[1]) for cells in table("Examples")]
MISTAKES = [(cells[0].strip("`"), *cells[1:]) for cells in table("What is refused")]


@pytest.fixture(scope="module", autouse=True)
def utc() -> Iterator[None]:
    """The time zone of the page's recording."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", "UTC")
        time.tzset()
        offset.cache_clear()
        yield
    time.tzset()
    offset.cache_clear()


@pytest.fixture(scope="module")
def recording(protocol: Protocol) -> Records:
    events = [
        Chunk(round(float(t) * 1000) * MS, "host" if side == "host" else "device", bytes.fromhex(b))
        for _, t, side, b, _ in ([cell.strip("`") for cell in row] for row in ROWS)
    ]
    return Records(decoded(Session(protocol), events))


@pytest.fixture(scope="module")
def lines(recording: Records) -> list[JsonLine]:
    return [line for line in map(json_line, recording.records()) if line is not None]


def test_the_recording_is_what_the_page_says(lines: list[JsonLine]) -> None:
    assert [(f"{line.t:.3f}", line.direction, f"`{line.hex}`") for line in lines] == [
        (t, side, data) for _, t, side, data, _ in ROWS
    ]
    for line, (*_, says) in zip(lines, ROWS, strict=True):
        assert says.startswith(line.name or "ID")


@pytest.mark.parametrize(("text", "rows"), EXAMPLES)
def test_an_example_selects_the_rows_that_it_says(
    protocol: Protocol, recording: Records, text: str, rows: str
) -> None:
    test = compile_filter(text, protocol).started(START * 10**9)

    passing = recording.in_order(test.selection(recording)).tolist()
    assert " ".join(str(row) for row, passes in enumerate(passing, 1) if passes) == rows


@pytest.mark.parametrize(("text", "column", "sentence"), MISTAKES)
def test_a_mistake_is_told_as_the_page_says(
    protocol: Protocol, text: str, column: str, sentence: str
) -> None:
    with pytest.raises(FilterError) as caught:
        compile_filter(text, protocol)

    assert caught.value.column == int(column)
    assert caught.value.sentence.startswith(sentence.strip("`").removesuffix("..."))


def test_every_name_stands_on_the_page(protocol: Protocol) -> None:
    named = [cells[0].strip("`") for cells in table("Names")[1:]]

    own = {name for name, field in fields_of(protocol).items() if name == field.key}
    assert set(named) == {name for name in own if not name.startswith("fields.")}
    assert len(set(named)) == len(named)


def test_every_field_of_the_grammar_stands_on_the_page(protocol: Protocol) -> None:
    says = table("Names")[0][-1]

    for spec in protocol.instructions:
        for part in spec.fields:
            assert f"`{part.name}`" in says


def test_the_help_has_every_name(protocol: Protocol) -> None:
    words = re.findall(r"[\w.]+", command("decode", "--help").stdout.decode())

    for name, field in fields_of(protocol).items():
        if not field.key.startswith("fields."):
            assert {name, name.removeprefix("state.")} & set(words), name


def test_bytes_without_a_recording_have_no_time_of_day() -> None:
    shown = command("decode", "20", "--filter", "time >= 00:00")

    assert (shown.returncode, shown.stdout, shown.stderr) == (0, b"", b"")
