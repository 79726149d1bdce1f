"""Rows as text: CSV, JSON lines and lines for people."""

from __future__ import annotations

import csv
import io
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.output.outputs import JsonText
from bilprov.analyzer.output.row_columns import (
    CsvText,
    Times,
    TimeStyle,
    columns_of,
    csv_cell,
    neutral,
)
from bilprov.analyzer.output.text_lines import HEX_WIDTH, LineRenderer, hex_width
from bilprov.spec.protocol import Protocol, load
from tests.support.csv_cells import plain
from tests.support.decoding import conversation, decoded
from tests.support.framed_traffic import FRAMED
from tests.support.traffic import ACTS, SETTINGS, Act, played

WALL = 1_790_000_000_987_654_321


@pytest.mark.sample(1)
@pytest.mark.slow
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


def test_a_frame_is_named_by_the_grammar_that_decoded_it(
    protocol: Protocol, horn_text: str
) -> None:
    horn = load(horn_text, "horn.py")
    said = conversation([(b"\x91\x03", b"\0")] * 2)

    for _ in range(2):
        for one, name in ((protocol, None), (horn, "Horn")):
            shown = JsonText().text(decoded(Session(one), said)).splitlines()
            assert [json.loads(line)["name"] for line in shown] == [name, "OK"] * 2


TALK = [
    (b"\x11\xff", b"\0"),
    (b"\x20", b"\0"),
    (b"\x51\x60", b"\0"),
    (b"\x81\x05", b"\0"),
    (b"\x81\x09", b"\0"),
    (b"\x9f" + bytes(15), b"\1"),
    (b"\x20", b"\0"),
]


def test_colour_codes_come_only_where_they_are_wanted(protocol: Protocol) -> None:
    records = decoded(Session(protocol), conversation(TALK))

    assert not any("\x1b" in LineRenderer(colour=False).line(record) for record in records)
    assert any("\x1b" in LineRenderer(colour=True).line(record) for record in records)


@pytest.mark.parametrize(("grammar", "width"), [("relay_board", 23), ("stk500v1", 11)])
def test_the_bytes_have_the_columns_that_the_frames_of_the_grammar_need(
    grammar: str, width: int
) -> None:
    assert hex_width(load(FRAMED[grammar])) == width


def test_the_columns_of_the_cars_bytes_stay(protocol: Protocol) -> None:
    assert hex_width(protocol) == HEX_WIDTH
