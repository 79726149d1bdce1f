"""What a column shows can be asked for: a filter knows the columns' names and their values."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest

from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.json_lines import JsonLine, json_line
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.fields import Kind, fields_of, offset
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.filters.syntax import FilterError
from bilprov.analyzer.output.row_columns import Column, bytes_fields, columns_of
from bilprov.captures.events import Events
from bilprov.captures.schemas import Chunk
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.replies import build_reply
from tests.support import ROOT
from tests.support.commands import command
from tests.support.decoding import MS, decoded
from tests.support.framed_traffic import FRAMED, odd_traffic

IN_WORDS = {"time", "fields", "state"}
"""The columns that are other columns in words, or in another style."""

SEPARATED = {"faults": "; "}
"""What stands between the words of a column with several."""


@pytest.fixture(scope="module", params=["car", *FRAMED])
def any_protocol(request: pytest.FixtureRequest, protocol: Protocol) -> Protocol:
    return protocol if request.param == "car" else load(FRAMED[request.param])


def out_of_range(protocol: Protocol) -> Iterator[Chunk]:
    """Requests with the highest data that there can be, and their answers."""
    t = 1000_000 * MS
    for spec in protocol.instructions:
        parts = {"id": spec.id} | {p.name: p.low for p in protocol.layout.parts if p.low}
        frame = protocol.layout.build(parts, b"\xff" * spec.length)
        yield Chunk(t, "host", frame)
        with suppress(OverflowError):  # more is asked for than an answer can hold
            yield Chunk(t + MS, "device", build_reply(protocol, judge(protocol, frame)))
        t += 20_000 * MS


def both_forms(protocol: Protocol) -> Iterator[tuple[Batch, list[JsonLine | None]]]:
    """Odd and regular traffic one by one, the device alone too, and as arrays, with its lines."""
    events = [*odd_traffic(protocol, count=60), *out_of_range(protocol)]
    decoder = StreamDecoder(protocol)
    for batch in (
        Records(decoded(Session(protocol), events)),
        Records(decoded(Session(protocol, heard=frozenset({"device"})), events)),
        *decoder.decode(Events.of(events)),
        *decoder.finish(),
    ):
        yield batch, [json_line(record) for record in batch.records()]


def asked_for(protocol: Protocol, column: Column, value: Any) -> str:
    """A filter for the rows in which a column has a value."""
    field = fields_of(protocol)[column.name]
    if field.kind is Kind.BYTES:
        return f"{column.name} == {value or repr('')}"
    if field.kind is Kind.WORDS:
        words = value.split(SEPARATED[column.name])
        return " and ".join(f"{column.name} contains {word!r}" for word in words if word)
    if column.name in ("name", "response") and value not in field.words:  # several flags
        return " and ".join(f"name contains {word!r}" for word in value.split())
    return f"{column.name} == {value!r}"


@pytest.mark.sample(1)
def test_every_column_and_each_of_its_values_can_be_asked_for(any_protocol: Protocol) -> None:
    several = bytes_fields(any_protocol)
    columns = [
        column
        for name, column in columns_of(any_protocol).items()
        if name not in IN_WORDS and name.removeprefix("fields.") not in several
    ]
    for batch, lines in both_forms(any_protocol):
        for column in columns:
            shown = [None if line is None else column.value(line) for line in lines]
            for value in {one for one in shown if one not in (None, "")}:
                text = asked_for(any_protocol, column, value)
                test = compile_filter(text, any_protocol)

                passing = batch.in_order(test.selection(batch)).tolist()

                assert passing == [one == value for one in shown], text


def test_every_key_of_a_line_is_a_name(any_protocol: Protocol) -> None:
    keys = set(JsonLine.__struct_fields__) - IN_WORDS
    if any_protocol.plain:
        keys -= {"outcome", "uncertain"}
    if not any_protocol.layout.part("address"):
        keys -= {"address"}
    assert keys <= set(fields_of(any_protocol))


# --------------------------------------------------------------------------------------------------


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


def test_every_name_and_field_stands_on_the_page(protocol: Protocol) -> None:
    named = [cells[0].strip("`") for cells in table("Names")[1:]]

    own = {name for name, field in fields_of(protocol).items() if name == field.key}
    assert set(named) == {name for name in own if not name.startswith("fields.")}
    assert len(set(named)) == len(named)
    fields = [part.name for spec in protocol.instructions for part in spec.fields]
    assert all(f"`{name}`" in table("Names")[0][-1] for name in fields)


def test_the_help_has_every_name(protocol: Protocol) -> None:
    words = re.findall(r"[\w.]+", command("decode", "--help").stdout.decode())

    for name, field in fields_of(protocol).items():
        if not field.key.startswith("fields."):
            assert re.sub(r"(?<=\.).*", "", name) in words, name  # state.* stands for its variables
