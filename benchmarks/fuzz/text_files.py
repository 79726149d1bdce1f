"""The target that reads files of settings."""

from __future__ import annotations

import contextlib
from collections.abc import Hashable

import click

from benchmarks.fuzz.engine import Target, Test, encoded, folder
from benchmarks.fuzz.mutators import words_mutator
from bilprov.__main__ import COMMANDS, front_door
from bilprov.analyzer.cli.settings import with_settings
from bilprov.analyzer.settings import COMMON, PROJECT_FILE, SettingsError, read_settings, user_file


def settings() -> Test:
    """A settings file, once as the user's own and once as that of a project; all commands."""
    own = folder()
    environ = {"XDG_CONFIG_HOME": str(own)}
    file = user_file(environ)
    file.parent.mkdir(exist_ok=True)
    here = own / "here"
    here.mkdir(exist_ok=True)
    commands = {name: _command(name) for name in ("sniff", "send", "export", "lab line")}

    def test(data: bytes) -> Hashable:
        foreign = data[:1] == b"\n"
        where = here / PROJECT_FILE if foreign else file
        where.write_bytes(data)
        try:
            with contextlib.chdir(here), click.Context(front_door):
                found = read_settings(COMMANDS, environ)
                for name, command in commands.items():
                    with_settings(command, name, found, ["car"], None)
        finally:
            where.unlink()
        return foreign, found.empty, len(found.devices), len(found.layers[not foreign].commands)

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
