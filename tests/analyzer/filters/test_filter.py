"""Filter expressions: which lines they let pass, and the messages for invalid ones."""

from __future__ import annotations

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
from bilprov.analyzer.filters.fields import fields_of, offset
from bilprov.analyzer.filters.filter import Filter, compile_filter
from bilprov.analyzer.filters.syntax import FilterError
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import build
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import MS, Event, conversation, decoded, hosts
from tests.support.framed_traffic import FRAMED

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


@pytest.mark.parametrize(
    ("text", "selected"),
    [
        ("fields.speed == 0x7f", ["11 7f"]),
        ("kind == response and agrees == False", ["00"]),
        ("'disagreeing' in faults", ["00"]),
        ("faults == ('disagreeing',)", ["00"]),
        ("hex == '81 09' or judgement == BAD_HEADER", ["81 09", "9f" + " 00" * 15, "01"]),
        ("'LED' in reason and direction == host", ["81 09"]),
        ("kind == fault", [""]),
        ("t > -1 and t < 0.03", ["11 7f", "00"]),
        ("name not in ('Speed', OK) and direction == device", ["01"]),
        (" name ==\nSpeed ", ["11 7f"]),
        ("name == forward or NAME == LED", ["20", "81 09"]),
        ("name in [Speed]", ["11 7f"]),
        ("rgb & 9 == 9 and (rgb & 8) == 8", ["81 09"]),
        ("id == 9 or id in 4..5", ["41 40", "9f" + " 00" * 15]),
        ("data contains 00 00 00", ["9f" + " 00" * 15]),
        ("data == 09 || data in {40, 7f}", ["11 7f", "81 09", "41 40"]),
        ("data == '' and faulty", []),
        ("data[1] >= 0 and len == 1", []),
        ("data[0] & 0x40 and data[0] < 0x7f", ["41 40"]),
        ("hex contains 81 09 or hex[1] == 0x7f or hex == 01", ["11 7f", "81 09", "01"]),
        ("hex == 81:09", ["81 09"]),
        ("'81 09' in hex", ["81 09"]),
        ("faulty and latency > 0.5 ms", ["00", "01"]),
        ("faulty and latency in 999µs..1001 µs", ["00", "01"]),  # with the micro sign
        ("faulty and latency == 1000μs", ["00", "01"]),  # with the Greek letter
        ("faults == disagreeing", ["00"]),
        ("speed in {1, 100..127}", ["11 7f"]),
        ("Speed > 100 and 100 < SPEED", ["11 7f"]),
        ("speed in 126.5..127.5", ["11 7f"]),
        ("t == 0.02 or t == 40000us", ["11 7f", "20"]),
        ("AGREES != TRUE", ["00"]),
    ],
)
def test_a_filter_lets_pass_the_rows_that_it_describes(
    protocol: Protocol, talk: list[Record], text: str, selected: list[str]
) -> None:
    test = compile_filter(text, protocol)

    assert [getattr(record, "hex", "") for record in passing(test, talk)] == selected


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


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("time > 14:03:20", [2, 3]),
        ("time >= 14:03:20", [1, 2, 3]),
        ("time < 14:03:20.5", [0, 1]),
        ("14:03:21 <= time", [2, 3]),
        ("time in 14:03:20..14:03:21", [1, 2]),
        ("time in {14:03:19..14:03:20, 14:03:22..23:00}", [0, 1, 3]),
        ("time in 14:03:22..14:03:19", [0, 3]),
        ("time not in 14:03:20..14:03:21", [0, 3]),
        ("time > 14:03", [0, 1, 2, 3]),
        ("time > 2026-11-22 14:03:20", [2, 3]),
        ("time > '2026-11-22T14:03:20'", [2, 3]),
        ("time >= 2026-11-22T13:03:21Z", [2, 3]),
        ("time >= 2026-11-22 14:03:21+01:00", [2, 3]),
        ("time in 2026-11-22..2026-11-22 14:03:20", [0, 1]),
        ("time > 2026-11-23", []),
    ],
)
def test_time_is_the_readers_time_of_day(
    protocol: Protocol, zone: Callable[[str], None], text: str, seconds: list[int]
) -> None:
    zone("Europe/Stockholm")
    stop = bytes([protocol.pad_byte])
    events: list[Event] = [Chunk(n * 1000 * MS, "host", stop) for n in range(4)]
    records: list[Record] = [*hosts(decoded(Session(protocol), events))]
    test = compile_filter(text, protocol)

    started = test.started(wall("Europe/Stockholm", "2026-11-22 14:03:19"))

    assert [record.t / 1e9 for record in passing(started, records)] == seconds
    assert passing(test, records) == []


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


WRONG = [
    # what is missing, or too much
    ("", "", "the filter is empty; write a condition like faulty or latency > 20ms"),
    ("x" * 1001, "^", "1001 characters, allowed are 1000"),
    ("faulty and", "          ^", "something is missing at the end: a condition like faulty"),
    ("name ==", "       ^", "something is missing at the end: a value or a name"),
    ("speed in", "        ^", "a set like {1, 2} or a range like 1..2"),
    ("faulty)", "      ^", "closes nothing that is open"),
    ("name in {Speed", "        ^", "'{' is never closed"),
    ("name in {Speed]", "              ^", "']' does not close the '{'"),
    ("name == 'Speed", "        ^^^^^^", "quote is never closed"),
    ("name in {}", "        ^^", "a set holds one or more values"),
    ("(" * 41 + "faulty" + ")" * 41, " " * 40 + "^", "nested too deeply"),
    ("!" * 41 + "faulty", " " * 40 + "^", "nested too deeply"),
    ("speed > 1 2", "          ^", "'and' or 'or' is missing before '2'"),
    ("name Speed", "     ^^^^^", "is missing before 'Speed'"),
    ("name in {Speed LED}", "               ^^^", "a comma is missing before 'LED'"),
    # other languages
    ("name = Speed", "     ^", "did you mean ==?"),
    ("name is Speed", "     ^^", "did you mean ==?"),
    ("faulty & agrees", "^^^^^^", "'faulty' is true or false, and & takes whole numbers"),
    ("faulty ^ agrees", "       ^", "cannot be part of a filter"),
    ("a\0b", " ^", "cannot be part of a filter"),
    # names and values that there are not
    ("faulty or nam == Speed", "          ^^^", "'nam' is not a name here: did you mean name?"),
    ("zzz", "^^^", "'zzz' is not a name here: there are speed, strength"),
    ("faults == Horn", "          ^^^^", "early, out of step, lost bytes and 8 more"),
    ("name contains zz", "              ^^", "is in no name; there are Stop"),
    # no condition
    ("speed", "^^^^^", "'speed' is a number, not a condition: compare it, like speed > 0"),
    ("Speed", "^^^^^", "'Speed' is a value, not a condition: write name == Speed"),
    ("5", "^", "asks nothing of the row"),
    ("1 == 1", "^", "asks nothing of the row"),
    ("(faulty or agrees) == true", " ^^^^^^^^^^^^^^^^", "join it with and, or, not"),
    ("name != name", "        ^^^^", "both sides are the same"),
    # kinds that never meet
    ("speed > 'a'", "        ^^^", "text, and speed is a number: write speed > 0"),
    ("name == judgement", "        ^^^^^^^^^", "name is a word like Stop, judgement is a number"),
    ("time > 5", "       ^", "is not a time of day like 14:03:20; seconds since the start are t"),
    ("data[0] == Speed", "           ^^^^^", "which does not fit here"),
    # values that can never be
    ("speed > 300", "        ^^^", "speed is 0 to 255, so speed > 300 never holds"),
    ("speed in {1, 300}", "             ^^^", "never holds"),
    ("speed in 300..400", "         ^^^", "never holds"),
    ("rgb in {2.5}", "        ^^^", "never holds"),
    ("latency_ns == 2.5", "              ^^^", "latency_ns is a whole number, so"),
    ("rgb & 4 == 5", "           ^", "never holds"),
    ("rgb & -1", "      ^^", "is not a mask"),
    ("rgb & speed", "      ^^^^^", "which does not fit here"),
    ("answers == -1", "           ^^", "answers is 0 or more"),
    ("data[-1] == 1", "     ^^", "data[0] is the first byte"),
    ("data[x] == 1", "     ^", "data[0] is its first byte"),
    ("t in 2s..1s", "     ^^^^^^", "the range ends at 1s, before it begins"),
    ("time > 25:00", "       ^^^^^", "'25:00' is not a time"),
    ("time > '14:03Z'", "       ^^^^^^^^", "is not a time"),
    ("time in 2026-11-22..14:00", "        ^^^^^^^^^^^^^^^^^", "before it begins"),
    ("time in 2026-11-22..2026-11-21", "        ^^^^^^^^^^^^^^^^^^^^^^", "before it begins"),
    ("t == 1e999", "     ^^^^^", "is too large"),
    ("t == 1min", "      ^^^", "is not a unit of time"),
    # signs that do not fit
    ("agrees < True", "       ^", "true or false, without <: write agrees == true"),
    ("name in Speed", "        ^^^^^", "in takes a set like {Speed} or a range like 1..2"),
    ("name == {Speed}", "        ^^^^^^^", "a set or a range follows in"),
    ("t > 1..2", "     ^^", "a range follows in, like t in 1s..2s"),
    ("name in Speed..LED", "        ^^^^^^^^^^", "which has no ranges: name each value"),
    ("time == 14:03:20", "     ^^", "without ==: write time > 14:03:20"),
    ("time in {14:03}", "         ^^^^^", "write 14:03:20..14:03:21"),
    ("1 in speed", "  ^^", "without contains"),
    # bytes
    ("data contains 1", "              ^", "two digits for each byte; bytes are written like 05"),
    ("data == 'zz'", "        ^^^^", "is not hex"),
    ("data contains ''", "              ^^", "at least one byte"),
]


@pytest.mark.parametrize(("text", "marks", "words"), WRONG)
def test_what_is_no_filter_is_said_in_one_sentence_that_points_at_it(
    protocol: Protocol, text: str, marks: str, words: str
) -> None:
    with pytest.raises(FilterError) as caught:
        compile_filter(text, protocol)

    error = caught.value
    assert words in error.sentence
    assert str(error) == f"filter column {error.column}: {error.sentence}"
    assert str(error).isprintable()
    if marks.strip() and len(text) <= 1000:
        assert " " * (error.column - 1) + "^" * error.length == marks


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "(1).__class__ == 1",
        "9**9**9 > 1",
        "f'{name}' == 'x'",
        "name[0] == 'S'",
        "(name := 'x') == 'x'",
        "speed + 1 > 3",
        "faults == (''==0 in 0,)",
        "strength & 60000000000000000001",
        "answers & 4 & 4",
    ],
)
def test_nothing_but_the_language_is_known(protocol: Protocol, text: str) -> None:
    with pytest.raises(FilterError):
        compile_filter(text, protocol)


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


def test_garbage_has_no_data_to_compare(protocol: Protocol) -> None:
    said = [(0, "host", b"\x9f"), (15 * MS, "device", b"\0"), (40 * MS, "host", b"\x20")]
    records = decoded(Session(protocol), [Chunk(*one) for one in said])  # type: ignore[arg-type]
    found = passing(compile_filter("data != 01", protocol), records)

    assert [record.data for record in found] == [b"\x20"]


def test_the_reach_of_a_field_is_what_its_bytes_can_carry(wide: Protocol) -> None:
    fields = fields_of(wide)

    reach = {name: (fields[name].low, fields[name].high) for name in ("speed", "strength", "pace")}
    assert reach == {"speed": (0, 65535), "strength": (-32768, 32767), "pace": (0, (1 << 24) - 1)}
    assert (fields["id"].high, fields["len"].high) == (7, 31)


def test_a_field_that_is_called_like_a_name_of_the_row_is_reached_by_its_long_name(
    grammar_text: str,
) -> None:
    protocol = load(grammar_text.replace('"rgb"', '"len"'))
    records = decoded(Session(protocol), [Chunk(0, "host", b"\x81\x05")])
    test = compile_filter("len == 1 and fields.len == 5 and FIELDS.LEN & 4", protocol)

    assert len(passing(test, records)) == len(hosts(records)) == 1


def test_an_answer_without_a_code_is_not_the_one_with_the_code_of_valid_requests() -> None:
    protocol = load(FRAMED["roboclaw"])
    frames = [build(protocol, "ForwardM1", {"speed": 5, "address": 128})]
    frames.append(build(protocol, "MainBattery", {"address": 128}))
    records = decoded(Session(protocol), [Chunk(0, "host", frame) for frame in frames])

    (found,) = passing(compile_filter("judgement == ACK", protocol), records)
    assert found is records[0]
    assert passing(compile_filter("judgement == 'no answer'", protocol), records) == []
    compile_filter("response < 1", load(FRAMED["stk500v1"]))  # its codes are higher


@pytest.mark.parametrize("name", ["values", "fields.values", "Values"])
@pytest.mark.parametrize("given", ["00", "00 03", "0x0003", "'00 03'"])
def test_behind_a_field_of_bytes_stands_hex_as_behind_data(name: str, given: str) -> None:
    protocol = load(FRAMED["modbus_rtu"])
    compile_filter(f"{name} contains {given}", protocol)
    with pytest.raises(FilterError, match="bytes are written like 05 or 11 ff"):
        compile_filter(f"{name} contains late", protocol)
