"""Columns of rows, and the options that choose them."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.output.outputs import json_text
from bilprov.analyzer.output.row_columns import (
    CsvText,
    Times,
    TimeStyle,
    columns_of,
    csv_cell,
    neutral,
)
from bilprov.analyzer.output.text_lines import LineRenderer, hex_width
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import Protocol, load
from tests.support.commands import running
from tests.support.csv_cells import plain
from tests.support.decoding import MS, conversation, decoded
from tests.support.framed_traffic import FRAMED
from tests.support.traffic import ACTS, SETTINGS, Acts, played

WALL = 1_700_000_000_000_000_000  # 2023-11-14T22:13:20Z


@pytest.fixture
def in_stockholm(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "Europe/Stockholm")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("in_stockholm")
def test_an_absolute_time_is_that_of_the_clock_here() -> None:
    assert Times(TimeStyle.ABSOLUTE, WALL).shown(1250 * MS + 1000) == "2023-11-14 23:13:21.250001"


@pytest.mark.waits
def test_count_does_not_wait_for_what_is_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "slow.mcap"
    with CaptureWriter(path, start_wall=0, metadata={"attached": "no"}, version="0") as writer:
        writer.chunk(Chunk(0, "host", b"\x20"))
        writer.chunk(Chunk(1, "device", b"\0"))
        writer.chunk(Chunk(3_600_000 * MS, "host", b"\x00"))

    with running("replay", str(path), "--format", "jsonl", "--count", "1") as replay:
        code, out, _ = replay.result()

    assert (code, len(out.splitlines())) == (0, 1)


# -- rows as text: CSV, JSON lines and lines for people --------------------------------------------


STARTED = 1_790_000_000_987_654_321


@pytest.mark.sample(1)
@pytest.mark.slow
@given(ACTS, SETTINGS, st.sampled_from(TimeStyle))
def test_rows_made_at_once_are_those_made_one_by_one(
    each_protocol: Protocol, acts: Acts, chosen: dict[str, Any], style: TimeStyle
) -> None:
    records = decoded(Session(each_protocol, **chosen), played(each_protocol, acts))
    columns = list(columns_of(each_protocol).values())
    at_once, one_by_one = (CsvText(columns, Times(style, STARTED)) for _ in range(2))

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
            shown = json_text(decoded(Session(one), said)).splitlines()
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
