"""The doors for foreign text and bytes: whatever comes, safe values come out, or one sentence.

Of a safe value each text prints and has a bound, and each number is finite and in its range. Behind
the doors nothing is checked again, so each door has one property that any input must keep. Markup
is not the doors' matter: each writer of HTML, XML, Markdown, C or Lua has a test of its own.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Any

import click
import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rich.console import Console

from bilprov.__main__ import COMMANDS, front_door
from bilprov.analyzer.cli.options import Finite
from bilprov.analyzer.cli.settings import (
    COMMON,
    SettingsError,
    read_settings,
    use_settings,
    user_file,
)
from bilprov.analyzer.cli.typed_input import are_json_lines, bytes_or_pause, recorded_chunks
from bilprov.analyzer.client.probes import ProbeError, parse_look
from bilprov.analyzer.files import LARGEST_NUMBER, LONGEST_TEXT, from_json, from_toml
from bilprov.analyzer.filters.fields import instant
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.row_columns import ColumnError, chosen_columns, columns_of
from bilprov.analyzer.transport.line_settings import line_named
from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.transport.server import parse_address
from bilprov.captures.schemas import MS
from bilprov.captures.wall_clock import LONGEST
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.profile import Figures, parse_allowed, profile_from
from bilprov.conformance.report.expected import ExpectedError, ExpectedFile
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.json_report import ReportError, as_json, parse_report
from bilprov.conformance.report.junit import as_junit
from bilprov.conformance.report.markdown import as_markdown
from bilprov.conformance.report.summary import show, show_compared
from bilprov.spec.errors import LONGEST_SENTENCE, UserError, one_line
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS
from tests.support.commands import command
from tests.support.grammars import PIECES, PLACES, VALUE, loaded_or_said, use, with_texts
from tests.support.surfaces import BROKEN, HOSTILE, NUL, seen

EVERY = (*HOSTILE.values(), NUL, BROKEN, "x\x1b[2J" * 20_000)
TEXTS = st.one_of(
    st.sampled_from(EVERY),
    st.text("\x1b\x07\x9b\x00\u202e\u200b\ufeff\ud800\r\n\t [](){}<>'\"`$\\/;|*?aé", max_size=20),
    st.text(max_size=20),
)
NUMBERS = st.one_of(
    st.integers(),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([1 << 64, 1 << 200, -(1 << 64), 1e308, -1e308, 0, -1, 9]),
)
JSON: st.SearchStrategy[Any] = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=4,
)
DEEP = b'{"profile":{"x":' + b"[" * 60_000
BYTES = st.binary(max_size=60) | st.sampled_from([b"", b"[" * 60_000, DEEP, b"\xff\xfe", b"1e999"])


def require_safe(value: object) -> None:
    """Every text prints and is bounded, every number is finite and bounded."""
    if isinstance(value, str):
        assert value.isprintable(), value[:200]
        assert len(value) <= LONGEST_TEXT
    elif isinstance(value, int | float):
        assert math.isfinite(value)
        assert abs(value) <= LARGEST_NUMBER or isinstance(value, float)
    elif isinstance(value, dict):
        for key, inner in value.items():
            require_safe(key)
            require_safe(inner)
    elif isinstance(value, list | tuple | set | frozenset):
        for inner in value:
            require_safe(inner)


def require_sentence(error: BaseException, most: int = LONGEST_SENTENCE) -> None:
    """What is said is one line, all of which prints."""
    assert 0 < len(str(error)) <= most
    assert str(error).isprintable()


def places(value: object, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """The way to each value in JSON, of lists to the first two."""
    yield path
    inner = value.items() if isinstance(value, dict) else ()
    for key, part in enumerate(value[:2]) if isinstance(value, list) else inner:
        yield from places(part, (*path, key))


@st.composite
def mutants(draw: st.DrawFn, seeds: Callable[[], list[Any]]) -> bytes:
    """JSON of a good document in which up to two values, or keys, are others; or any bytes."""
    document = json.loads(json.dumps(draw(st.sampled_from(seeds()))))
    for _ in range(draw(st.integers(0, 2))):
        path = draw(st.sampled_from([path for path in places(document) if path]))
        inner = document
        for key in path[:-1]:
            inner = inner[key]
        if isinstance(inner, dict) and draw(st.booleans()):
            inner[draw(TEXTS)] = draw(JSON)
        else:
            inner[path[-1]] = draw(JSON)
    return draw(BYTES) if draw(st.integers(0, 7)) == 3 else json.dumps(document).encode()


# -- sentences, JSON and TOML ----------------------------------------------------------------------


@given(TEXTS)
def test_an_error_is_one_line_that_prints(text: str) -> None:
    require_sentence(UserError(f"{text} is not allowed"))
    assert len(one_line(text, 60)) <= 60


@given(mutants(lambda: [{"a": ["b", 1, 0.5, None, {"c": True}]}]))
@example(b'{"a": 123456789012345678901234567890}')
def test_json_gives_safe_values_or_a_sentence(data: bytes) -> None:
    with suppress(ValueError):
        require_safe(from_json(data, object))


@given(TEXTS, JSON)
@example("[" * 60_000, None)
def test_toml_gives_safe_values_or_a_sentence(text: str, value: Any) -> None:
    for toml in (text, f"a = {text}", f"a = {json.dumps(value)}", f"[{json.dumps(text)}]\n"):
        with suppress(ValueError):
            require_safe(from_toml(toml))


# -- reports and what is compared with them --------------------------------------------------------


@cache
def documents() -> list[dict[str, Any]]:
    """The JSON of a good run and of a failed one, with few cases and entries of their logs."""
    protocol, documents = load_protocol(), []
    for fault in (None, fault_bank(protocol)["led-order-reversed"]):
        device = Simulator(protocol, fault) if fault else Simulator(protocol)
        report = conform(device, grammar=protocol, options=Options(only=("valid/LED/1",)))
        document = json.loads(as_json(report))
        cases = {case["verdict"]: case for case in document["cases"]}
        for case in cases.values():
            del case["log"][2:]
        counts = dict.fromkeys(document["counts"], 0) | dict.fromkeys(cases, 1)
        document |= {"cases": list(cases.values()), "counts": counts}
        document["expected_failures"] = {"file": "x", "expected": 0, "unexpected": 1, "stale": []}
        documents.append(document)
    return documents


@given(mutants(documents))
def test_a_report_is_safe_and_written_in_every_form_or_refused(data: bytes) -> None:
    require_writable_or_refused(data)


def require_writable_or_refused(data: bytes) -> None:
    """A report is safe, and can be written in every form, or it is refused in a sentence."""
    try:
        report = parse_report(data, "run.json")
    except ReportError as error:
        require_sentence(error)
        return
    protocol = load_protocol()
    require_safe(msgspec.to_builtins(report))
    seen(as_json(report))
    assert parse_report(as_json(report), "again").results == report.results
    for text in (as_html([report] * 2, protocol), as_junit([report], protocol)):
        seen(text.encode())
    as_markdown([report], protocol).encode()
    screen = TextIOWrapper(BytesIO(), encoding="utf-8")
    show(report, Console(file=screen), everything=True)
    show_compared([report] * 2, Console(file=screen), everything=True)


@pytest.mark.slow
@given(TEXTS, TEXTS)
def test_a_report_of_a_run_is_safe_whatever_its_device_is_called(name: str, probe: str) -> None:
    report = conform(name=name, probe=probe, fault=name, options=Options(only=("valid/LED/1",)))

    require_safe(msgspec.to_builtins(report))


LINES = st.lists(
    st.tuples(
        st.sampled_from(["", "[!\x1b]", "[!\u202e]"]) | TEXTS,
        st.sampled_from(["answer", "stop", "x"]),
        TEXTS,
    ),
    max_size=3,
)


@given(LINES, TEXTS)
@example([("[!\x1b]", "stop", "\x1b")] * 2, "")
def test_expected_failures_are_safe_or_refused(
    entries: list[tuple[str, str, str]], text: str
) -> None:
    report = parse_report(json.dumps(documents()[len(entries) % 2]).encode(), "run.json")
    suite = {result.id for result in report.results}
    lines = [f"*{glob} : {axis}: {message}" for glob, axis, message in entries]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "known.txt"
        for content in ("\n".join(lines), text):
            file.write_bytes(content.encode("utf-8", "surrogatepass"))
            try:
                known = ExpectedFile(str(file), suite, update=False)
                require_safe(msgspec.to_builtins(known.applied(report)[0]))
            except ExpectedError as error:
                require_sentence(error)


# -- profiles and probes ---------------------------------------------------------------------------


@given(st.lists(st.tuples(TEXTS, JSON), max_size=2), TEXTS)
@example([], "a = " + "[" * 60_000)
def test_a_profile_is_safe_or_refused(changes: list[tuple[str, Any]], text: str) -> None:
    protocol = load_protocol()
    good = Figures(truncation_timeout_ms=50.0, flushes=True, readings={}).toml(protocol)
    lines = [f"{json.dumps(key)} = {json.dumps(value)}\n" for key, value in changes]
    for name in ("watchdog_ms", "whole_frame", "led_id", f'readings."{next(iter(POINTS))}"'):
        for toml in (f"{name} = {text}\n{good}", f"{''.join(lines)}{good}", text):
            with suppress(ValueError):
                profile = profile_from(protocol, toml, {})
                assert 0 < (profile.watchdog or 1) <= 60_000 * MS
                require_safe([profile.choices.shown, profile.flushes, profile.whole_frame])


GOOD_LOOKS = [{"moving": True, "motion": "a", "speed": 1, "left": 0.2, "led": None, "number": 1}]
PROBES_SAID = (
    b'{"moving": true, "motion": "\xff"}',
    b'{"motion": "\\ud800"}',
    b'{"mood": ' + b"[" * 30_000 + b"]" * 30_000 + b"}",
    b'{"speed": -Infinity}',
    b'{"speed": ' + b"9" * 50_000 + b"}",
    b'{"moving": true, "left": 123456789012345678901234567890}',
    b'\xef\xbb\xbf{"moving": true}',
    json.dumps({"motion": "x" * 300}).encode(),
)


@given(mutants(lambda: GOOD_LOOKS))
def test_a_look_is_safe_or_refused(data: bytes) -> None:
    for line in (data, *PROBES_SAID):
        try:
            look, _ = parse_look(line, 1)
        except ProbeError as error:
            require_sentence(error, 1000)
            continue
        require_safe(msgspec.to_builtins(look))
        assert len(look.motion or "") <= 200
        numbers = (look.speed, look.steering, look.led, look.left, look.right)
        assert all(number is None or abs(number) <= 1e9 for number in numbers)


# -- grammars --------------------------------------------------------------------------------------


def require_usable_or_said(text: str) -> bool:
    """A grammar's text is loaded, safe and usable, or refused in a short sentence."""
    protocol = loaded_or_said(text)
    if isinstance(protocol, str):
        assert protocol.isprintable(), text
        assert 0 < len(protocol) < 400, text
        return False
    parts: list[Any] = [protocol.name, protocol.version, protocol.document, protocol.origin]
    parts += [protocol.instructions, protocol.responses, protocol.clauses, protocol.layout.parts]
    require_safe([plain(part) for part in parts])
    use(protocol, range(0, 256, 37))
    return True


def plain(value: Any) -> Any:
    """Structs as dicts; what is no value, as the construct of a field, is left out."""
    if isinstance(value, tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, msgspec.Struct):
        return {name: getattr(value, name) for name in value.__struct_fields__ if name != "effect"}
    return value


@given(st.data())
def test_a_grammar_with_other_values_is_safe_and_usable_or_refused(data: st.DataObject) -> None:
    text = load_protocol().source
    for _ in range(data.draw(st.integers(1, 2))):
        values = [match.span() for match in VALUE.finditer(text, max(0, text.find("NAME")))]
        start, end = data.draw(st.sampled_from(values))
        other = text[slice(*data.draw(st.sampled_from(values)))]
        pieces = st.just(other), st.sampled_from([*PIECES, ""]), TEXTS.map(repr), NUMBERS.map(str)
        piece = data.draw(st.one_of(*pieces))
        text = text[:start] + piece + text[end:]
    require_usable_or_said(text)


@given(st.sampled_from(list(PLACES)), TEXTS)
def test_each_text_of_a_grammar_prints_or_is_refused(place: str, text: str) -> None:
    piece = json.dumps(text[:30])[1:-1] or "x"
    used = require_usable_or_said(with_texts(load_protocol().source, piece, PLACES[place]))

    assert not used or text[:30].isprintable()


# -- the machine and the user ----------------------------------------------------------------------


@given(TEXTS)
@example("\u00b2")  # a digit that is no number
@example("9" * 5000)
def test_what_the_machine_says_of_its_ports_is_safe(text: str) -> None:
    content = text.encode("utf-8", "surrogatepass")
    with tempfile.TemporaryDirectory() as folder:
        for name in (
            *("proc/7/comm", "proc/7/cmdline", "proc/7/fdinfo/3", "proc/locks", "etc/group"),
            *("sys/class/tty/ttyS0/device/idVendor", "dev/ttyS0"),
            *(f"sys/class/tty/ttyS0/device/{part}" for part in ("serial", "product", "idProduct")),
            *("sys/class/tty/ttyS0/device/latency_timer", "sys/class/tty/ttyS0/dev"),
        ):
            file = Path(folder) / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        machine, port = Machine(folder), "/dev/ttyS0"
        usb = machine.usb(port)
        require_safe(asdict(machine.process(7)))
        require_safe([usb.identity, usb.serial, usb.title] if usb else [])
        require_safe([machine.latency_timer(port)])
        machine.held(port)
        machine.properties(port)
        os.fspath(machine.by_id(port))


@given(TEXTS | st.sampled_from(["pause=nan", "pause=1e999", "LED 9", "LED rgb=1 rgb=2", "81 0"]))
def test_what_is_typed_is_bytes_a_pause_or_a_sentence(text: str) -> None:
    protocol = load_protocol()
    for item in (text, f"LED {text}", f"pause={text}", f"81 {text}"):
        with suppress(ValueError):
            found = bytes_or_pause(protocol, item)
            assert found if isinstance(found, bytes) else 0 <= found <= 60


RECORDED = [{"t": 0.5, "dir": "host", "hex": "8105"}, {"t": 1, "direction": None, "hex": ""}]


@given(mutants(lambda: RECORDED))
@example(b'{"t":0,"hex":' + b"[" * 100_000)
@example(b'{"t":1e290,"dir":"host","hex":"81"}')
def test_recorded_lines_are_bytes_with_times_or_refused(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "line.jsonl"
        file.write_bytes(data)
        are_json_lines(file)
        with suppress(click.ClickException):
            assert all(abs(chunk.t) <= LONGEST for chunk in recorded_chunks(file, "host"))


@given(TEXTS | st.sampled_from(["9" * 16_000 + "x", "5ms", "[::1]:50", "9600 8E1.5", "time,len"]))
def test_what_stands_behind_an_option_is_a_value_or_a_sentence(text: str) -> None:
    protocol = load_protocol()
    conversions: tuple[Callable[[], object], ...] = (
        lambda: instant(text),
        lambda: parse_address(text),
        lambda: chosen_columns(text, columns_of(protocol)),
        lambda: parse_allowed(protocol, (text,)),
        lambda: Finite(0).convert(text, None, None),
        lambda: line_named(protocol, text),
    )
    for convert in conversions:
        with suppress(ValueError, click.BadParameter, ColumnError):
            convert()


KEYS = st.sampled_from([*COMMON, "port", "probe", "wait", "yes", "expect", "columns", "format"])


@given(
    st.dictionaries(KEYS | TEXTS, JSON, max_size=3),
    st.sampled_from(["device.car", "sniff", "send", "export", "device"]),
    st.just(""),
)
@example({}, "sniff", "baud = " + "[" * 60_000)
@example({}, "sniff", "x" + ".x" * 10_000 + " = 1")
@example({}, "sniff", "baud = 0x" + "f" * 5000)
def test_settings_are_taken_by_each_command_or_refused(
    values: dict[str, Any], table: str, line: str
) -> None:
    lines = [f"{json.dumps(key)} = {json.dumps(value)}" for key, value in values.items()]
    lines.append(line)
    with tempfile.TemporaryDirectory() as folder:
        environ = {"XDG_CONFIG_HOME": folder}
        user_file(environ).parent.mkdir()
        text = "\n".join(
            ['[device.car]\nport = "x"'] * (table != "device") + [f"[{table}]", *lines]
        )
        user_file(environ).write_bytes(text.encode("utf-8", "surrogatepass"))
        with click.Context(front_door, info_name="bilprov") as ctx, suppress(SettingsError):
            found = read_settings(COMMANDS, environ)
            for name in ("sniff", "send", "export"):
                command = front_door.get_command(ctx, name)
                assert command
                use_settings(ctx, command, name, found)
                with suppress(click.UsageError):
                    command.make_context(name, ["car", "car"], parent=ctx)


ARGUMENTS = {
    "a command": "{text}",
    "an option": "decode --{text}",
    "hex": "decode {text}",
    "an instruction": "encode {text}",
    "a filter": "decode --filter {text} 00",
    "columns": "decode --format csv --columns {text} 00",
    "a port": "send /no/{text} Stop --yes",
    "an item": "send /dev/null {text} --yes",
    "a target": "conform /no/{text} --level smoke",
    "a probe": "conform /dev/null --level smoke --probe x{text} --yes",
    "a case": "conform sim --list --only {text}",
    "a fault": "conform sim --list --level smoke --fault x{text}",
    "a level": "conform sim --list --level {text}",
    "a choice": "conform sim --list --allow {text}",
    "a reading": "spec readings {text}",
    "an address": "simulate --listen x{text}",
    "info": "capture info {file}",
    "recheck": "recheck {file}",
    "report": "report {file}",
    "export": "export {file} --format csv -o -",
    "replay": "replay {file} --rate 0",
    "no command": "{file}",
    "--grammar": "--grammar {file} spec show",
    "--profile": "conform sim --list --profile {file}/x",
    "--expect-failures": "conform /dev/null --level smoke --expect-failures {file}",
    "--json": "conform sim --only valid/LED/1 --json {file}/x",
    "a firmware": "conform emulator:simavr:{file}/x",
}


@pytest.mark.sample(6)
@pytest.mark.parametrize("what", ARGUMENTS)
def test_an_argument_or_the_name_of_a_file_does_nothing(what: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for text in (text for text in EVERY if text != NUL):  # no argument can hold one
            name = f"{folder}/{text[:200].replace('/', '_')}"
            Path(name).write_bytes(b"content")
            words = [word.format(text=text, file=name) for word in ARGUMENTS[what].split()]
            done = command(*words)
            shown = done.stdout + done.stderr
            assert done.returncode in (0, 2), shown
            assert b"Traceback" not in shown
            assert len(seen(shown)) < 100_000


def test_what_is_put_back_is_seen(protocol: Protocol) -> None:
    """The checks of this file notice what is not safe."""
    for value in ("\x1b", {"\u202e": 1}, [float("inf")], 1 << 70, ("x" * (LONGEST_TEXT + 1),)):
        with pytest.raises(AssertionError):
            require_safe(value)
