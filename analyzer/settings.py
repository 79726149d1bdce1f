"""Settings from files and the environment: read, checked, and kept with the place they are from.

There are three places, later ones before earlier ones: the user's file, the file of the working
folder, which may come with somebody else's project, and the environment. A command's own options
come before all of them. Docs: docs/settings.md.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from bilprov.captures.text import printable
from bilprov.spec.errors import UserError

PROJECT_FILE = "bilprov.toml"
PREFIX = "BILPROV_"  # of the environment's variables
DEVICE = "device"  # the table of the named devices
PORT = "port"  # a device's key that its name stands for
SIM = "sim"  # a target that is no port

LINE = ("baud", "parity", "stopbits", "truncation-timeout")
COMMON = ("grammar", *LINE, "probe", "time", "columns", "yes")
"""The keys at the top of a file: they are for every command that has such an option."""
DEVICE_KEYS = (PORT, *LINE, "probe", "power", "yes")
"""The keys of a named device."""

FORMER = {
    "browse": ("replay",),
    "info": ("capture", "info"),
    "cut": ("capture", "cut"),
    "join": ("capture", "join"),
    "recover": ("capture", "repair"),
    "convert": ("capture", "decode"),
    "compare": ("capture", "diff"),
    "doctor": ("ports",),
    "shell": ("send",),
    "emulate": ("simulate", "--firmware"),
    "score": ("lab", "score"),
    "learn": ("lab", "learn"),
    "line": ("lab", "line"),
}
"""What commands are called now, by their former names."""

# What a project's file may not set: it would run a program, allow a motion, or overwrite a file.
_ANSWERS = ("power", "grammar", "yes", "force")
_PORTS = (PORT, "probe", "to", "bridge")  # the only paths that may lead out of the working folder
_RUNS = ("exec:",)
_WRITES = ("spy:", "alt:")  # pyserial's URLs that write a file or load a class
_MOST = 1 << 20  # bytes of a file


def former_name(name: str, arguments: Sequence[str] = ()) -> str:
    """A sentence with what a command is called now, and its arguments; "" if it is no former name.

    >>> former_name("cut", ["a.mcap", "b.mcap"])
    'bilprov cut is now bilprov capture cut: bilprov capture cut a.mcap b.mcap'
    """
    new = FORMER.get(name)
    if new is None:
        return ""
    if name == "doctor" and any(word.endswith(".mcap") for word in arguments):
        new = ("capture", "check")
    words = [*new, *(word for word in arguments if word != "--decoded")]
    example = f": bilprov {shlex.join(words)}" if arguments else ""
    return f"bilprov {name} is now bilprov {' '.join(new)}{example}"


class SettingsError(UserError):
    """A settings file cannot be used; the message is one sentence with its path."""


class Value(NamedTuple):
    """A setting's value, and where it is set: `FILE [table]` or the environment's variable."""

    value: Any
    source: str


@dataclass(frozen=True, slots=True)
class Layer:
    """The settings of one place.

    `common` holds those for every command, `commands` those of one command, `devices` the named
    devices: their values by key, like `truncation-timeout`.
    """

    common: Mapping[str, Value]
    commands: Mapping[str, Mapping[str, Value]]
    devices: Mapping[str, Mapping[str, Value]]

    def values_of(self, command: str) -> dict[str, Value]:
        """The values for a command; those of its own table come before the common ones."""
        return {**self.common, **self.commands.get(command, {})}


@dataclass(frozen=True, slots=True)
class Settings:
    """The layers, each of which comes before those in front of it; the last is the environment."""

    layers: tuple[Layer, ...]

    def values_of(
        self, command: str, device: Mapping[str, Value] | None = None
    ) -> dict[str, Value]:
        """The values for a command by key, with those of a device, which come before the files'."""
        *files, environment = self.layers
        merged: dict[str, Value] = {}
        for values in (*(layer.values_of(command) for layer in files), device or {}):
            merged |= values
        return merged | environment.values_of(command)

    @property
    def empty(self) -> bool:
        """Whether nothing is set anywhere."""
        return not any(one.common or one.commands or one.devices for one in self.layers)

    @property
    def devices(self) -> dict[str, dict[str, Value]]:
        """The named devices.

        A later place that names a device's port describes it anew: what was allowed for the one at
        the port before (`yes`, `power`) is not allowed for another.
        """
        found: dict[str, dict[str, Value]] = {}
        for layer in self.layers:
            for name, values in layer.devices.items():
                before = {} if PORT in values else found.get(name, {})
                found[name] = {**before, **values}
        return found

    def device(self, word: str) -> dict[str, Value] | None:
        """The device of that name, None if there is none, or a file that is called so."""
        found = self.devices.get(word)
        return None if found is None or Path(word).exists() else found


def is_name(word: str) -> bool:
    """Whether a word may name a device: letters, digits, - and _, and not a target's own word."""
    return word != SIM and word.replace("-", "").replace("_", "").isalnum()


def _dangerous(key: str, texts: Sequence[str]) -> bool:
    """Whether a project's file may not set this key to these texts."""
    if key in _ANSWERS or any(text.lower().startswith(_RUNS + _WRITES) for text in texts):
        return True
    return key not in _PORTS and any(map(_leads_out, texts))


def _leads_out(text: str) -> bool:
    """Whether a text is a path that is not below the working folder, links followed."""
    return text.startswith("~") or not Path(os.path.realpath(text)).is_relative_to(Path.cwd())


def user_file(environ: Mapping[str, str]) -> Path:
    """The user's file."""
    home = environ.get("XDG_CONFIG_HOME") or Path(environ.get("HOME", "/")) / ".config"
    return Path(home, "bilprov", "config.toml")


def read_settings(
    commands: Mapping[str, object], environ: Mapping[str, str] = os.environ
) -> Settings:
    """Read all settings; `commands` are the names of the commands. Raises SettingsError."""
    files = ((user_file(environ), False), (Path(PROJECT_FILE), True))
    layers = [_file(file, commands, foreign=foreign) for file, foreign in files]
    settings = Settings((*layers, _environment(commands, environ)))
    for name, values in settings.devices.items():
        port = values.get(PORT)
        source = next(iter(values.values())).source if values else f"[{DEVICE}.{name}]"
        if port is None or not isinstance(port.value, str):
            raise SettingsError(f"{source} names no port: add {PORT} = PATH or URL, a text")
    return settings


def _file(file: Path, commands: Mapping[str, object], *, foreign: bool) -> Layer:
    """The layer of a file, an empty one if there is none; `foreign` if it may be another's."""
    try:
        if not file.exists():
            return Layer({}, {}, {})
        import tomllib

        from bilprov.analyzer.files import read_bounded

        tables = tomllib.loads(read_bounded(file, _MOST).decode())
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else printable(error)
        raise SettingsError(f"the settings {printable(file)} cannot be read: {why}") from error
    return _Reader(file, commands, foreign).layer(tables)


class _Reader:
    """Checks the tables of one file, and gives them as a layer. Raises SettingsError."""

    def __init__(self, file: Path, commands: Mapping[str, object], foreign: bool) -> None:
        self._file = printable(file)
        self._commands = commands
        self._foreign = foreign

    def layer(self, tables: Mapping[str, Any]) -> Layer:
        """The layer of a file's tables."""
        common = {key: value for key, value in tables.items() if not isinstance(value, dict)}
        self._require(common, COMMON, "", "a setting of all commands")
        commands = {name: table for name, table in tables.items() if isinstance(table, dict)}
        devices = commands.pop(DEVICE, {})
        return Layer(
            self._values(common, ""),
            dict(self._tables(commands, "")),
            dict(self._devices(devices)),
        )

    def _tables(
        self, tables: Mapping[str, Any], group: str
    ) -> Iterator[tuple[str, dict[str, Value]]]:
        """Yield the name and the values of each command; the tables of a group's are below it."""
        known = [name[len(group) :] for name in self._commands if name.startswith(group)]
        known = [name for name in known if " " not in name]
        for name, table in tables.items():
            full = f"{group}{name}"
            where = f"[{full.replace(' ', '.')}]"
            if not group and (renamed := former_name(name)):
                raise SettingsError(f"{self._at(where)}: {renamed}")
            above = f"[{group.strip().replace(' ', '.')}]" if group else ""
            self._require([name], [*known, *([] if group else [DEVICE])], above, "a command")
            below = {}
            if any(one.startswith(f"{full} ") for one in self._commands):
                below = {key: value for key, value in table.items() if isinstance(value, dict)}
                yield from self._tables(below, f"{full} ")
            own = {key: value for key, value in table.items() if key not in below}
            yield full, self._values(own, where)

    def _devices(self, table: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Value]]]:
        for name, values in table.items():
            where = f"[{DEVICE}.{printable(name)}]"
            if not is_name(name):
                what = "letters, digits, - and _, and not sim"
                raise SettingsError(f"{self._file} {where}: a device's name is {what}")
            if not isinstance(values, dict):
                raise SettingsError(f"{self._file} {where}: it must be a table with a port")
            self._require(values, DEVICE_KEYS, where, "a setting of a device")
            yield name, self._values(values, where)

    def _values(self, table: Mapping[str, Any], where: str) -> dict[str, Value]:
        source = self._at(where)
        found = {}
        for key, value in table.items():
            kinds = str | int | float
            if not isinstance(value, kinds) and not (
                isinstance(value, list) and all(isinstance(part, kinds) for part in value)
            ):
                what = "table" if isinstance(value, dict) else type(value).__name__
                raise SettingsError(f"{source}: {printable(key)} is a {what}, allowed is a value")
            texts = [str(part) for part in (value if isinstance(value, list) else [value])]
            if any("\0" in text for text in texts):
                raise SettingsError(f"{source}: {printable(key)} holds a NUL character")
            if self._foreign and _dangerous(key, texts):
                raise SettingsError(
                    f"{source}: {key} = {printable(value)} may run code, answer for you or write "
                    "outside this folder, which a project's file may not: set it in your own "
                    "config.toml, or as an option"
                )
            found[key.replace("_", "-")] = Value(value, source)
        return found

    def _require(self, keys: Any, known: Any, where: str, what: str) -> None:
        """Raise SettingsError for the first key that is not known."""
        for key in keys:
            if key.replace("_", "-") not in known:
                from difflib import get_close_matches

                near = get_close_matches(key, known, n=1)
                meant = f", did you mean {near[0]}?" if near else f"; there are {', '.join(known)}"
                raise SettingsError(f"{self._at(where)}: {printable(key)} is not {what}{meant}")

    def _at(self, where: str) -> str:
        return f"{self._file} {where}".rstrip()


def _environment(commands: Mapping[str, object], environ: Mapping[str, str]) -> Layer:
    """The layer of the environment: BILPROV_BAUD for all commands, BILPROV_SNIFF_TIME for one."""
    common: dict[str, Value] = {}
    own: dict[str, dict[str, Value]] = {}
    for name, value in environ.items():
        if not name.startswith(PREFIX):
            continue
        key = name.removeprefix(PREFIX).lower().replace("_", "-")
        begun = [one for one in commands if key.startswith(f"{one.replace(' ', '-')}-")]
        if key in COMMON:
            common[key] = Value(value, name)
        elif begun:
            command = max(begun, key=len)  # of a group, the command below it
            own.setdefault(command, {})[key[len(command) + 1 :]] = Value(value, name)
        elif renamed := former_name(key.partition("-")[0]):
            raise SettingsError(f"{name}: {renamed}")
    return Layer(common, own, {})
