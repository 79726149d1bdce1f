"""Rows as text: CSV, JSON lines and lines for people."""

from __future__ import annotations

import csv
import io
import json
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.json_lines import JsonLine
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record, serious_faults
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
from bilprov.captures.schemas import Line
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


def test_hostile_words_of_a_capture_are_one_row(protocol: Protocol) -> None:
    event = Line(0, "break", "host", '=HYPERLINK("http://x")\r\n,\x1b[2J')
    columns = [columns_of(protocol)["reason"]]

    text = CsvText(columns, Times()).text(decoded(Session(protocol), [event]))

    assert text == '"\'=HYPERLINK(""http://x"")\\\\r\\\\n,\\\\x1b[2J"\r\n'


def told(record: HostRecord | DeviceRecord) -> dict[str, Any]:
    """What the line of a frame or an answer tells, from the record alone; the keys in order."""
    others = ("outcome", "address", "uncertain")  # of grammars with more around the data
    line: dict[str, Any] = {key: None for key in JsonLine.__struct_fields__ if key not in others}
    line |= {"t": record.t / 1e9, "hex": record.hex, "reason": record.reason, "fields": {}}
    line["state"] = msgspec.structs.asdict(record.state)
    line["faults"] = [fault.kind for fault in serious_faults(record)]
    if isinstance(record, DeviceRecord):
        answered, latency = record.answered, record.latency
        return line | {
            "direction": "device",
            "kind": "response",
            "name": record.answer.name if record.answer else None,
            "judgement": answered.response.name if answered else None,
            "latency": None if latency is None else latency / 1e9,
            "answers": record.instruction,
            "agrees": record.agrees,
        }
    line |= {"direction": "host", "kind": record.kind, "sequence": record.sequence}
    if record.judgement is None:
        return line
    spec = record.judgement.instruction
    return line | {
        "name": spec.name if spec else None,
        "fields": dict(record.judgement.fields),
        "judgement": record.judgement.response.name,
    }


def lines(records: list[Record]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in JsonText().text(records).splitlines()]


@pytest.mark.sample(1)
@pytest.mark.slow
@given(ACTS, SETTINGS)
def test_a_line_tells_what_its_record_has(
    each_protocol: Protocol, acts: list[Act], chosen: dict[str, Any]
) -> None:
    records = decoded(Session(each_protocol, **chosen), played(each_protocol, acts))

    shown = [line for line in lines(records) if line["hex"]]
    own = [told(one) for one in records if isinstance(one, HostRecord | DeviceRecord)]
    assert [list(line.items()) for line in shown] == [list(line.items()) for line in own]


def test_a_frame_is_named_by_the_grammar_that_decoded_it(
    protocol: Protocol, horn_text: str
) -> None:
    horn = load(horn_text, "horn.py")
    said = conversation([(b"\x91\x03", b"\0")] * 2)

    for _ in range(2):
        names = [
            [line["name"] for line in lines(decoded(Session(p), said))] for p in (protocol, horn)
        ]
        assert names == [[None, "OK"] * 2, ["Horn", "OK"] * 2]


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


@given(st.text(max_size=300), st.text(max_size=300))
def test_foreign_text_is_made_safe(protocol: Protocol, event: str, detail: str) -> None:
    for line in (Line(0, event, "host", detail), Line(0, "break", "", detail)):
        (record,) = decoded(Session(protocol), [line])
        text = LineRenderer(colour=False).line(record)

        assert text.isprintable()
        assert len(text) < 500


@pytest.mark.parametrize(("grammar", "width"), [("relay_board", 23), ("stk500v1", 11)])
def test_the_bytes_have_the_columns_that_the_frames_of_the_grammar_need(
    grammar: str, width: int
) -> None:
    assert hex_width(load(FRAMED[grammar])) == width


def test_the_columns_of_the_cars_bytes_stay(protocol: Protocol) -> None:
    assert hex_width(protocol) == HEX_WIDTH
