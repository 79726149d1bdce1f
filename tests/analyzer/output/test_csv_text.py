"""CSV: the rows and values of the JSON lines, harmless where they are opened."""

from __future__ import annotations

import csv
import io
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.output.csv_text import CsvText, csv_cell, neutral
from bilprov.analyzer.output.row_columns import Times, TimeStyle, columns_of
from bilprov.captures.schemas import Line
from bilprov.spec.protocol import Protocol
from tests.support.csv_cells import plain
from tests.support.decoding import decoded
from tests.support.traffic import ACTS, SETTINGS, Act, played

WALL = 1_790_000_000_987_654_321


@pytest.mark.sample(1)
@pytest.mark.slow
@settings(max_examples=60)
@given(ACTS, SETTINGS, st.sampled_from(TimeStyle))
def test_rows_made_at_once_are_those_made_one_by_one(
    each_protocol: Protocol, acts: list[Act], chosen: dict[str, Any], style: TimeStyle
) -> None:
    records = decoded(Session(each_protocol, **chosen), played(each_protocol, acts))
    columns = list(columns_of(each_protocol).values())
    at_once, one_by_one = (CsvText(columns, Times(style, WALL)) for _ in range(2))

    assert at_once.text(records) == "".join(one_by_one.text([record]) for record in records)


@given(st.text())
def test_any_text_is_harmless_in_a_cell_and_comes_back(text: str) -> None:
    cell = neutral(text)

    assert plain(cell) == text
    assert not cell.startswith(("=", "+", "-", "@", "\t", "\r", "＝", "＋", "－", "＠"))
    assert all(ord(sign) >= 32 for sign in cell)
    (read, _), *_ = csv.reader(io.StringIO(csv_cell(text) + ",\r\n", newline=""))
    assert read == cell


def test_hostile_words_of_a_capture_are_one_row(protocol: Protocol) -> None:
    event = Line(0, "break", "host", '=HYPERLINK("http://x")\r\n,\x1b[2J')
    columns = [columns_of(protocol)["reason"]]

    text = CsvText(columns, Times()).text(decoded(Session(protocol), [event]))

    assert text == '"\'=HYPERLINK(""http://x"")\\\\r\\\\n,\\\\x1b[2J"\r\n'
