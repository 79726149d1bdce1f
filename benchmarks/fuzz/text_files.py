"""The target that reads files of settings."""

from __future__ import annotations

import contextlib
from collections.abc import Hashable

import click

from benchmarks.fuzz.engine import Target, Test, encoded, folder
from benchmarks.fuzz.mutators import words_mutator
from bilprov.__main__ import COMMANDS, front_door
from bilprov.analyzer.cli.settings import (
    COMMON,
    SettingsError,
    read_settings,
    use_settings,
    user_file,
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


# The words depend on the grammar, which is read when the first input is made.
TARGETS = (
    Target(
        "settings",
        "settings files",
        settings,
        (SettingsError,),
        lambda: _SETTINGS,
        words_mutator(_settings_words),
        4,
    ),
)
