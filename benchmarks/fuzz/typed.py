"""Targets that read what is typed: filters, instructions and bytes, values of options."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import cache
from random import Random
from typing import Any

import click

from benchmarks.fuzz.engine import Target, Test, encoded, require
from benchmarks.fuzz.mutators import words_mutator
from bilprov.analyzer.cli.options import Finite
from bilprov.analyzer.cli.typed_input import bytes_from_hex, bytes_or_pause
from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.completion import completions
from bilprov.analyzer.filters.fields import fields_of
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.filters.moments import instant
from bilprov.analyzer.filters.parts import FilterError
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.row_columns import ColumnError, chosen_columns, columns_of
from bilprov.analyzer.transport.line_settings import line_named
from bilprov.analyzer.transport.streams import parse_address
from bilprov.captures.events import Events
from bilprov.captures.schemas import MS, Chunk, Direction
from bilprov.conformance.cases.selection import shard_named
from bilprov.conformance.oracle.choices import parse_allowed
from bilprov.spec import explain as explaining
from bilprov.spec.codec import judge, nearest
from bilprov.spec.open_points import POINTS
from bilprov.spec.protocol import Protocol

_WALL = 1_790_000_000_000_000_000  # ns since 1970
_EXPLAINED = 24  # bytes: what comes after them takes as long again, and tells nothing new
_BOTH: frozenset[Direction] = frozenset({"host", "device"})


def text_of(data: bytes) -> str:
    """An input as the text that the system would hand to a program."""
    return data.decode("utf-8", "surrogateescape")


@cache
def _batches() -> list[tuple[Records, Sequence[Batch]]]:
    """Some traffic with answers of all kinds: as decoded one by one, and as decoded as arrays."""
    protocol = load_protocol()
    found: list[tuple[Records, Sequence[Batch]]] = []
    for heard in (_BOTH, frozenset[Direction]({"device"})):
        random, t, played = Random(2), 0, []
        for _ in range(24):
            header = random.randrange(256)
            frame = bytes([header]) + random.randbytes(protocol.lengths[header])
            frame = nearest(protocol, frame) if random.random() < 0.7 else frame
            answer = judge(protocol, frame).response.code if random.random() < 0.9 else header & 7
            late = random.choice((1000, MS, 150 * MS))
            played += [Chunk(t, "host", frame), Chunk(t + late, "device", bytes([answer]))]
            t += 200 * MS
        session = Session(protocol, heard=heard)
        records = [record for event in played for record in session.feed(event)]
        batches = StreamDecoder(protocol, heard=heard).decode(Events.of(played))
        found.append((Records(records), batches))
    return found


def filters() -> Test:
    """A filter is refused, or selects the same rows whoever decoded them."""
    protocol = load_protocol()
    batches = _batches()

    def test(data: bytes) -> Hashable:
        text = text_of(data)
        for found in completions(text, len(text) * 2 // 3, protocol)[:40]:
            require(0 <= found.start <= len(text), "a completion begins outside of the text")
        plain = compile_filter(text, protocol)
        passing = 0
        for test in (plain.started(_WALL), plain):
            for one_by_one, arrays in batches:
                chosen = [batch.in_order(test.selection(batch)) for batch in (one_by_one, *arrays)]
                selected = [row for rows in chosen[1:] for row in rows.tolist()]
                require(chosen[0].tolist() == selected, "records and arrays differ")
                passing += sum(selected)
        return passing, len(text).bit_length()

    return test


def _filter_words() -> tuple[str, ...]:
    fields = fields_of(load_protocol())
    words = [word for field in fields.values() for word in field.words]
    signs = "== != < <= > >= in not and or && || ! & contains ( ) { } [ ] , .."
    values = "1ms 0.5us 2s 0x21 127 -1 1e3 13:46 2026-09-21 2026-09-21T13:46:40Z 81 0a ff ' ''"
    return (*fields, *words, *signs.split(), *signs.split(), *values.split())


_FILTERS = encoded(
    "faulty and latency > 1ms",
    "hex contains 11 or data[0] >= 0x40 or data == ''",
    "name in ('a', 'b') and not (t in 1s..20s)",
    "response in {0, 1..3} || judgement != response",
    "time in 23:00..13:47 or time < 2026-09-21 13:46:41.5",
    "state.motion != stopped && state.speed & 3 == 1",
    "faults == ('slow',) or 'ms' in reason",
    "id == 0 and len != 1 and direction == device",
    "agrees == False and sequence in (answers, 4)",
)


def typed() -> Test:
    """What is typed to be sent: a line of the shell or of a script, or bytes in hex."""
    protocol = load_protocol()

    def test(data: bytes) -> Hashable:
        text = text_of(data)
        items: list[Hashable] = []
        for item in text.split(";"):
            what = bytes_or_pause(protocol, item.strip(), ("help", "stop"))
            if isinstance(what, float):
                require(0 <= what <= 60, "a pause is longer than allowed")
                items.append("pause")
            else:
                require(len(what) > 0, "nothing is sent")
                explained = explaining.explain(protocol, what[:_EXPLAINED])
                require(bool(explained.frames), "a frame is not explained")
                explaining.explain_responses(protocol, what[:_EXPLAINED])
                items.append(judge(protocol, what[: 1 + protocol.lengths[what[0]]]).response.code)
        bytes_from_hex(text.replace(";", " "))
        return tuple(items[:3])

    return test


def _names(protocol: Protocol) -> tuple[str, ...]:
    fields = [f"{part.name}=" for spec in protocol.instructions for part in spec.fields]
    more = ("pause=", ";", "#", "0x", "\\x", "$", "=", "81", "05", "0b1", "help", "state", "500")
    return (*(spec.name for spec in protocol.instructions), *fields, *more)


def _typed_words() -> tuple[str, ...]:
    return _names(load_protocol())


def _typed_seeds() -> list[bytes]:
    names = [spec.name for spec in load_protocol().instructions]
    lines = [f"{name} 1; pause=500; 81 05" for name in names]
    return encoded(*lines, "0x81,0x05", "8105", "81:05-0a", "$1 \\x2", "pause=0.5")


_FINITE = Finite(0)


def _is(convert: Callable[[str], Any], text: str) -> Hashable:
    """What a conversion makes of a text, None where it refuses."""
    try:
        value = convert(text)
    except UnicodeError:
        raise
    except (ValueError, click.BadParameter, ColumnError):
        return None
    return type(value).__name__


def values() -> Test:
    """What stands behind options: times, moments, addresses, columns, shards, line settings."""
    protocol = load_protocol()

    def columns_in(text: str) -> Any:
        return chosen_columns(text, protocol)

    def allowed_in(text: str) -> Any:
        return parse_allowed(protocol, (text,))

    conversions: tuple[Callable[[str], Any], ...] = (
        *(instant, parse_address, shard_named, columns_in, allowed_in),
        lambda text: _FINITE.convert(text, None, None),
        lambda text: str(line_named(protocol, text)),
    )

    def test(data: bytes) -> Hashable:
        text = text_of(data)
        return tuple(_is(convert, text) for convert in conversions)

    return test


def _value_words() -> tuple[str, ...]:
    columns = columns_of(load_protocol())
    more = ":Z+-./,=[]"
    return (*columns, *POINTS, *more, "ms", "s", "us", "8N1", "T", "inf", "nan", "1/4", "02:00")


_VALUES = encoded(
    *("5ms", "0.2s", "14:03:20", "2026-11-22 14:03:20.5", "2026-11-22T14:03Z", "2026-11-22"),
    *("127.0.0.1:0", "[::1]:5000", "localhost:80", "1/4", "115200 8N1", "9600 8E1.5", "1e4"),
    *("time,name,latency", "state.speed,id,len", "2026-11-22 10:00+02:00"),
)


TARGETS = (
    Target(
        "filter",
        "filters: records and arrays agree",
        filters,
        (FilterError,),
        lambda: _FILTERS,
        words_mutator(_filter_words),
        10,
    ),
    Target(
        "typed",
        "typed instructions and bytes",
        typed,
        (ValueError,),
        _typed_seeds,
        words_mutator(_typed_words),
        9,
    ),
    Target(
        "values",
        "times, moments, addresses, columns",
        values,
        (),
        lambda: _VALUES,
        words_mutator(_value_words),
        6,
    ),
)
