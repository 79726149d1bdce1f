"""Records as text lines: safe for a terminal, plain in a pipe."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.output.text_lines import HEX_WIDTH, LineRenderer, hex_width
from bilprov.captures.schemas import Line
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import conversation, decoded
from tests.support.framed_traffic import FRAMED

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
