"""Filter expressions: which lines they let pass, and the messages for invalid ones."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Records
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.filters.completion import completions
from bilprov.analyzer.filters.fields import fields_of, offset
from bilprov.analyzer.filters.filter import Filter, compile_filter
from bilprov.analyzer.filters.syntax import FilterError, place_at_end
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import MS, Event, conversation, decoded, hosts
from tests.support.expressions import expressions

TALK = [
    (b"\x11\x7f", b"\0"),
    (b"\x20", b"\0"),
    (b"\x81\x09", b"\0"),
    (b"\x41\x40", b"\0"),
    (b"\x9f" + bytes(15), b"\1"),
]


@pytest.fixture(scope="module")
def talk(protocol: Protocol) -> list[Record]:
    return decoded(Session(protocol), [*conversation(TALK), Line(9000 * MS, "break", "host")])


def passing(test: Filter, records: list[Record]) -> list[Any]:
    """The records that pass."""
    batch = Records(records)
    return list(batch.records(test.selection(batch)))


def wall(zone: str, text: str) -> int:
    """Ns since 1970 of a local moment."""
    return int(datetime.fromisoformat(text).replace(tzinfo=ZoneInfo(zone)).timestamp()) * 10**9


@pytest.fixture
def zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Moves this process to a time zone."""

    def moved(name: str) -> None:
        monkeypatch.setenv("TZ", name)
        time.tzset()
        offset.cache_clear()

    yield moved
    monkeypatch.undo()
    time.tzset()
    offset.cache_clear()


def test_the_time_of_day_follows_the_clock_that_is_put_back(
    protocol: Protocol, zone: Callable[[str], None]
) -> None:
    zone("Europe/Stockholm")
    stop = bytes([protocol.pad_byte])
    events: list[Event] = [Chunk(n * 1800 * 1000 * MS, "host", stop) for n in range(6)]
    records: list[Record] = [*hosts(decoded(Session(protocol), events))]
    # At 3:00 on 2026-10-25 it is 2:00 again.
    test = compile_filter("time in 2:00..2:45", protocol).started(
        wall("Europe/Stockholm", "2026-10-25 01:30")
    )

    assert [record.t / 1800e9 for record in passing(test, records)] == [1, 2, 3, 4]


@pytest.mark.parametrize("start", [0, -5, 1 << 62, 10**20])
def test_a_recording_without_a_start_has_no_time_of_day(
    protocol: Protocol, talk: list[Record], start: int
) -> None:
    test = compile_filter("time >= 00:00", protocol).started(start)

    assert passing(test, talk) == []


def test_what_no_command_line_may_hold_is_said_in_one_sentence_too(protocol: Protocol) -> None:
    with pytest.raises(FilterError, match="cannot be part of a filter") as caught:
        compile_filter("a\0b", protocol)
    assert str(caught.value).isprintable()


_PIECES = """
name speed t time data hex faulty latency Speed OK 1 20ms 14:03 == != < in contains not and or ! &
&& || ( ) { } [ ] , .. ' " 11 ff 0x80 kHz state.moving faults slow
"""
_SPOKEN = st.lists(st.sampled_from(_PIECES.split()), max_size=9).map(" ".join)


@given(text=st.one_of(st.text(max_size=40), _SPOKEN, _SPOKEN))
@settings(max_examples=600)
def test_any_text_is_a_filter_or_an_error_with_its_place(protocol: Protocol, text: str) -> None:
    errors: list[FilterError] = []
    try:
        compile_filter(text, protocol)
    except FilterError as error:
        errors.append(error)
    for error in errors:
        assert 1 <= error.column <= len(text) + 1
        assert error.column - 1 + error.length <= len(text) + 1
        assert str(error).isprintable()


def test_a_field_that_is_called_like_a_name_of_the_row_is_reached_by_its_long_name(
    grammar_text: str,
) -> None:
    protocol = load(grammar_text.replace('"rgb"', '"len"'))
    records = decoded(Session(protocol), [Chunk(0, "host", b"\x81\x05")])
    test = compile_filter("len == 1 and fields.len == 5 and FIELDS.LEN & 4", protocol)

    assert len(passing(test, records)) == len(hosts(records)) == 1


# -- what may come next in a filter at a cursor: for the screen's filter line, and for shells ------


def offered(text: str, protocol: Protocol) -> list[str]:
    """The texts that a cursor at the end is offered, with what stands before them."""
    found = completions(text, len(text), protocol)
    return [text[: one.start] + one.text for one in found]


@pytest.mark.parametrize(
    ("text", "whole"),
    [
        ("na", ["name"]),
        ("NA", ["name"]),
        ("name ", ["name ==", "name !=", "name in", "name contains"]),
        ("name == fo", ["name == Forward"]),
        ("name==fo", ["name==Forward"]),
        ("direction == ", ["direction == host", "direction == device"]),
        ("direction ==", ["direction ==host", "direction ==device"]),
        ("speed > 3", ["speed > 3 and", "speed > 3 or"]),
        ("speed > ", []),
        ("name in ", ["name in {"]),
        ("name in {sp", ["name in {Speed"]),
        ("rgb in 1..", []),
        ("id in 1..ro", ["id in 1..RotateRight", "id in 1..RotateLeft"]),
        ("name in {Speed, ro", ["name in {Speed, RotateRight", "name in {Speed, RotateLeft"]),
        ("name in {Speed ", ["name in {Speed ,", "name in {Speed }"]),
        ("speed > 3 ", ["speed > 3 and", "speed > 3 or"]),
        ("(speed > 3 ", ["(speed > 3 and", "(speed > 3 or", "(speed > 3 )"]),
        ("faults contains lo", ["faults contains 'lost bytes'"]),
        ("faulty and not str", ["faulty and not strength"]),
        ("state.moving == ", ["state.moving == true", "state.moving == false"]),
        ("fields.s", ["fields.speed", "fields.strength"]),
        ("name == 'Speed'", ["name == 'Speed' and", "name == 'Speed' or"]),
        ("(faulty)", [f"(faulty) {word}" for word in ("==", "!=", "and", "or")]),
        ("data[0] ", [f"data[0] {s}" for s in ("==", "!=", "<", "<=", ">", ">=", "in", "&")]),
        ("sped ", []),
        ("name == Horn and) ", []),
        ("'lo", []),
        ("x" * 2000, []),
    ],
)
def test_what_may_come_next(protocol: Protocol, text: str, whole: list[str]) -> None:
    assert offered(text, protocol) == whole


def test_an_empty_line_is_offered_every_name_once(each_protocol: Protocol) -> None:
    names = [name for name in fields_of(each_protocol) if not name.startswith("fields.")]

    assert offered("", each_protocol) == [*names, "not"]
    assert all(one.says for one in completions("", 0, each_protocol))


def test_the_names_of_another_grammar_are_offered(horn: Protocol) -> None:
    assert offered("name == ho", horn) == ["name == Horn"]
    assert offered("so", horn) == ["sound"]
    assert completions("id == ho", 8, horn)[0].says == "id 9"


def test_what_stands_behind_the_cursor_does_not_matter(protocol: Protocol) -> None:
    assert completions("name == fo and faulty", 10, protocol)[0].text == "Forward"


@given(data=st.data())
def test_what_is_offered_leads_on_to_a_filter(each_protocol: Protocol, data: st.DataObject) -> None:
    text = data.draw(expressions(each_protocol))
    cursor = data.draw(st.integers(0, len(text)))

    found = offered(text[:cursor], each_protocol)
    for whole in found[:2] + found[-3:]:
        assert place_at_end(whole) is not None, whole


@settings(max_examples=40)
@given(data=st.data())
def test_a_filter_can_be_typed_by_what_is_offered(
    each_protocol: Protocol, data: st.DataObject
) -> None:
    """Wherever nothing is offered, or a number may come, one is typed."""
    text = ""
    for _ in range(data.draw(st.integers(1, 12))):
        found = offered(text, each_protocol)
        if not found or re.search(r"(\d|[<>=.])$", text):
            typed = "11 " if re.search(r"(data|hex|bytes)\W+(not )?\w*\W*$", text) else "1 "
            text += "'a' " if "reason" in text[-12:] else typed
            continue
        text = data.draw(st.sampled_from(found)) + " "

    assert place_at_end(text) is not None, text
