"""Targets that read text of others: settings, profiles, grammars, answers of a probe."""

from __future__ import annotations

import contextlib
from collections.abc import Hashable
from typing import Any

import click

from benchmarks.fuzz.engine import Target, Test, encoded, folder, require
from benchmarks.fuzz.mutators import json_mutator, words_mutator
from bilprov.__main__ import COMMANDS, front_door
from bilprov.analyzer.cli.settings import (
    COMMON,
    SettingsError,
    read_settings,
    use_settings,
    user_file,
)
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import MS
from bilprov.conformance.dut.probes import ProbeError, parse_look
from bilprov.conformance.oracle.profile import profile_from, profile_text
from bilprov.spec import explain as explaining
from bilprov.spec.codec import judge, nearest
from bilprov.spec.open_points import POINTS
from bilprov.spec.protocol import GrammarError, load
from bilprov.spec.safe_grammar import WORDS, NotDeclared, require_declarations


def probe() -> Test:
    """A line of a probe's answer."""

    def test(data: bytes) -> Hashable:
        look = parse_look(data, 1)
        for name in ("speed", "steering", "led", "left", "right"):
            number = getattr(look, name)
            require(number is None or abs(number) <= 1e9, "a number is too large to record")
        return look.moving, look.motion is None, look.speed is None, look.left is None

    return test


_LOOKS = encoded(
    '{"moving": true}',
    '{"moving": false, "motion": "stopped", "speed": 0, "steering": -255, "led": 7}',
    '{"moving": null, "left": 0.25, "right": -0.25, "motion": null}',
)


def profile() -> Test:
    """The text of a device's profile."""
    protocol = load_protocol()

    def test(data: bytes) -> Hashable:
        found = profile_from(protocol, data.decode("utf-8", "replace"), {})
        for time in (found.truncation_timeout, found.stop_latency, found.watchdog):
            require(time is None or 0 <= time <= 60_000 * MS, "a time is out of its bounds")
        return found.flushes, found.watchdog is None, len(found.choices.shown)

    return test


def _profiles() -> list[bytes]:
    protocol = load_protocol()
    grammar = {"name": protocol.name, "version": protocol.version, "sha256": protocol.sha256}
    readings = {point: chosen.choices[0].word for point, chosen in POINTS.items() if chosen.choices}
    told: dict[str, Any] = {
        "truncation_timeout_ms": 50.0,
        "stop_latency_ms": 1.5,
        "watchdog_ms": 400,
        "flushes_for_ms": 20,
        "flushes": True,
        "whole_frame": False,
        "led_id": protocol.unused_ids[0],
        "readings": dict(list(readings.items())[:6]),
    }
    return encoded(
        profile_text(grammar, told), profile_text(grammar, {"readings": {}, "flushes": False})
    )


def _profile_words() -> tuple[str, ...]:
    return (
        *POINTS,
        "[readings]",
        "truncation_timeout_ms = ",
        "true",
        "1979-05-27",
        "'''",
        '"""',
        "=",
    )


def settings() -> Test:
    """The user's settings file, and what some commands make of it."""
    environ = {"XDG_CONFIG_HOME": str(folder())}
    file = user_file(environ)
    file.parent.mkdir(exist_ok=True)
    commands = {name: _command(name) for name in ("sniff", "send", "export", "lab line")}

    def test(data: bytes) -> Hashable:
        file.write_bytes(data)
        found = read_settings(COMMANDS, environ)
        with click.Context(front_door, info_name="bilprov") as ctx:
            for name, command in commands.items():
                use_settings(ctx, command, name, found)
                with contextlib.suppress(click.UsageError):
                    command.make_context(name.rpartition(" ")[2], ["car", "car"], parent=ctx)
        return len(found), sum(map(len, found.values()))

    return test


def _command(name: str) -> click.Command:
    from importlib import import_module

    command = getattr(import_module(COMMANDS[name].module), COMMANDS[name].attribute)
    assert isinstance(command, click.Command)
    return command


_SETTINGS = encoded(
    'baud = 9600\n[device.car]\nport = "/dev/ttyUSB0"\nprobe = "modem:cts"\nbaud = 19200\n',
    '\n[sniff]\nfilter = "faulty"\ntime = "utc"\ncolumns = "time,name"\n',
    '\n[device.car]\nport = "ttyS0"\n[sniff]\nwait = true\n',
    '[send]\nyes = true\nexpect = "OK,OK"\n[export]\nformat = "csv"\ntruncation_timeout = 5\n',
    '\n[line]\ndelay = "5ms"\ndrop = 1e-4\n[device]\na = {port = "x", probe = "none"}\n',
)


def _settings_words() -> tuple[str, ...]:
    return (
        *COMMON,
        *COMMANDS,
        "[device.car]\n",
        "port = ",
        "= ",
        "[",
        "]",
        "{",
        "}",
        "exec:x",
        "~/x",
    )


def grammar() -> Test:
    """A grammar in a recording: refused in a sentence, or used without a fault."""

    def test(data: bytes) -> Hashable:
        text = data.decode("utf-8", "replace")
        try:
            require_declarations(text)
            protocol = load(text)
        except (NotDeclared, GrammarError) as error:
            said = str(error)
            require(said.isprintable() and len(said) < 400, "what is said is no short line")
            raise
        header = len(data) & 0xFF
        frame = bytes([header]) + data[: protocol.lengths[header]]
        judgement = judge(protocol, frame)
        require(judge(protocol, nearest(protocol, frame)).valid, "the nearest frame is not valid")
        require(bool(explaining.explain(protocol, frame).frames), "a frame is not explained")
        require(bool(protocol.bounds), "there are no bounds")
        return judgement.outcome, len(protocol.instructions)

    return test


def _grammars() -> list[bytes]:
    return [load_protocol().source.encode()]


def _grammar_words() -> tuple[str, ...]:
    words = sorted(word for module in WORDS.values() for word in module)
    calls = ("Ranged(Byte, 0, 7)", 'From("rgb")', "Struct()", "BitsInteger(4)", "Sets(speed=-1)")
    return (*words, *calls, "this.a.b", "Motion.FORWARD", "None", "True", "1e999", "[]", "()", "\n")


# The words depend on the grammar, which is read when the first input is made.
TARGETS = (
    Target(
        "probe",
        "a probe's answers",
        probe,
        (ProbeError,),
        lambda: _LOOKS,
        json_mutator(("moving", "motion", "speed")),
        22,
    ),
    Target(
        "profile",
        "a device's profile",
        profile,
        (ValueError,),
        _profiles,
        words_mutator(_profile_words),
        8,
    ),
    Target(
        "settings",
        "settings files",
        settings,
        (SettingsError,),
        lambda: _SETTINGS,
        words_mutator(_settings_words),
        4,
    ),
    Target(
        "grammar",
        "grammars inside of captures",
        grammar,
        (NotDeclared, GrammarError),
        _grammars,
        words_mutator(_grammar_words),
        3,
    ),
)
