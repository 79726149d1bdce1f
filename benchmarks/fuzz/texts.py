"""Targets that read what is typed: filters, instructions and bytes, values, settings files."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from functools import cache
from typing import Any

import click

from benchmarks.fuzz.engine import Target, Test, folder, require
from benchmarks.fuzz.mutators import text_mutator
from benchmarks.fuzz.traffic import Tape, conversations, events, records_one_by_one
from bilprov.__main__ import COMMANDS, front_door
from bilprov.analyzer.cli.options import Finite
from bilprov.analyzer.cli.settings import (
    COMMON,
    SettingsError,
    read_settings,
    use_settings,
    user_file,
)
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
from bilprov.captures.schemas import Chunk
from bilprov.conformance.oracle.choices import parse_allowed
from bilprov.spec import explain as explaining
from bilprov.spec.codec import judge
from bilprov.spec.readings import POINTS

_WALL = 1_790_000_000_000_000_000  # ns since 1970
_EXPLAINED = 24  # bytes: what comes after them takes as long again, and shows nothing new


def _text(data: bytes) -> str:
    """An input as the text that the system would hand to a program."""
    return data.decode("utf-8", "surrogateescape")


def _lines(*texts: str) -> Callable[[], list[bytes]]:
    return lambda: [text.encode() for text in texts]


@cache
def _batches() -> tuple[Records, Sequence[Batch]]:
    """Some traffic as it is decoded one by one, and as it is decoded as arrays."""
    protocol = load_protocol()
    played = [
        event for event in events(protocol, Tape(conversations()[1])) if isinstance(event, Chunk)
    ]
    batches = StreamDecoder(protocol).decode(Events.of(played))
    return Records(records_one_by_one(Session(protocol), played)), batches


def filters() -> Test:
    """A filter is refused, or selects the same rows however they were decoded."""
    protocol = load_protocol()
    one_by_one, arrays = _batches()

    def test(data: bytes) -> Hashable:
        text = _text(data)
        for found in completions(text, len(text) * 2 // 3, protocol)[:40]:
            require(0 <= found.start <= len(text), "a completion begins outside of the text")
        plain = compile_filter(text, protocol)
        passing = 0
        for test in (plain.started(_WALL), plain):
            chosen, *others = (
                b.in_order(test.selection(b)).tolist() for b in (one_by_one, *arrays)
            )
            require(chosen == [row for rows in others for row in rows], "records and arrays differ")
            passing += sum(chosen)
        return passing, len(text).bit_length()

    return test


def _filter_words() -> tuple[str, ...]:
    fields = fields_of(load_protocol())
    words = [word for field in fields.values() for word in field.words]
    signs = "== != < <= > >= in not and or && || ! & contains ( ) { } [ ] , .."
    values = "1ms 0.5us 2s 0x21 127 -1 1e3 13:46 2026-09-21 2026-09-21T13:46:40Z 81 0a ff ' ''"
    return (*fields, *words, *signs.split(), *signs.split(), *values.split())


_FILTERS = _lines(
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
        items: list[Hashable] = []
        for item in _text(data).split(";"):
            what = bytes_or_pause(protocol, item.strip(), ("help", "stop"))
            if isinstance(what, float):
                require(0 <= what <= 60, "a pause is longer than allowed")
                items.append("pause")
                continue
            explained = explaining.explain(protocol, what[:_EXPLAINED])
            require(bool(explained.frames), "a frame is not explained")
            explaining.explain_responses(protocol, what[:_EXPLAINED])
            items.append(judge(protocol, what[: 1 + protocol.lengths[what[0]]]).response.code)
        bytes_from_hex(_text(data).replace(";", " "))
        return tuple(items[:3])

    return test


def _typed_words() -> tuple[str, ...]:
    protocol = load_protocol()
    fields = [f"{part.name}=" for spec in protocol.instructions for part in spec.fields]
    more = ("pause=", ";", "#", "0x", "\\x", "$", "=", "81", "05", "0b1", "help", "state", "500")
    return (*protocol.by_name, *fields, *more)


def _typed_seeds() -> list[bytes]:
    lines = [f"{name} 1; pause=500; 81 05" for name in load_protocol().by_name]
    return _lines(*lines, "0x81,0x05", "8105", "81:05-0a", "$1 \\x2", "pause=0.5")()


def values() -> Test:
    """What stands behind options: times, moments, addresses, columns, choices, line settings."""
    protocol, finite = load_protocol(), Finite(0)
    conversions: tuple[Callable[[str], Any], ...] = (
        instant,
        parse_address,
        lambda text: chosen_columns(text, protocol),
        lambda text: parse_allowed(protocol, (text,)),
        lambda text: finite.convert(text, None, None),
        lambda text: str(line_named(protocol, text)),
    )

    def test(data: bytes) -> Hashable:
        found = []
        for convert in conversions:
            try:
                found.append(type(convert(_text(data))).__name__)
            except UnicodeError:
                raise
            except (ValueError, click.BadParameter, ColumnError):
                found.append("")
        return tuple(found)

    return test


def _value_words() -> tuple[str, ...]:
    columns = columns_of(load_protocol())
    return (*columns, *POINTS, *":Z+-./,=[]", "ms", "s", "us", "8N1", "T", "inf", "nan", "02:00")


_VALUES = _lines(
    *("5ms", "0.2s", "14:03:20", "2026-11-22 14:03:20.5", "2026-11-22T14:03Z", "2026-11-22"),
    *("127.0.0.1:0", "[::1]:5000", "localhost:80", "115200 8N1", "9600 8E1.5", "1e4"),
    *("time,name,latency", "state.speed,id,len", "2026-11-22 10:00+02:00"),
)


def settings() -> Test:
    """The user's settings file, and what some commands make of it."""
    environ = {"XDG_CONFIG_HOME": str(folder())}
    file = user_file(environ)
    file.parent.mkdir(exist_ok=True)
    root = click.Context(front_door, info_name="bilprov")
    commands = {name: front_door.get_command(root, name) for name in ("sniff", "send", "export")}

    def test(data: bytes) -> Hashable:
        file.write_bytes(data)
        found = read_settings(COMMANDS, environ)
        with click.Context(front_door, info_name="bilprov") as ctx:
            for name, command in commands.items():
                assert command
                use_settings(ctx, command, name, found)
                with suppress(click.UsageError):
                    command.make_context(name, ["car", "car"], parent=ctx)
        return len(found), sum(map(len, found.values()))

    return test


_SETTINGS = _lines(
    'baud = 9600\n[device.car]\nport = "/dev/ttyUSB0"\nprobe = "modem:cts"\nbaud = 19200\n',
    '\n[sniff]\nfilter = "faulty"\ntime = "utc"\ncolumns = "time,name"\n',
    '\n[device.car]\nport = "ttyS0"\n[sniff]\nwait = true\n',
    '[send]\nyes = true\nexpect = "OK,OK"\n[export]\nformat = "csv"\ntruncation_timeout = 5\n',
    '[device]\na = {port = "x", probe = "none"}\n',
)


def _settings_words() -> tuple[str, ...]:
    more = ("[device.car]\n", "port = ", "= ", "[", "]", "{", "}", "exec:x", "~/x")
    return (*COMMON, *COMMANDS, *more)


TARGETS = (
    Target("filter", filters, (FilterError,), _FILTERS, text_mutator(_filter_words), 10),
    Target("typed", typed, (ValueError,), _typed_seeds, text_mutator(_typed_words), 9),
    Target("values", values, (), _VALUES, text_mutator(_value_words), 6),
    Target("settings", settings, (SettingsError,), _SETTINGS, text_mutator(_settings_words), 4),
)
