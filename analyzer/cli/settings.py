"""The user's settings: options that hold without being typed, and names of devices.

One file has them, by click's means they are the defaults of a command. Docs: docs/settings.md.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import click
from click.core import ParameterSource

from bilprov.analyzer.former_names import former_name
from bilprov.captures.text import near, printable
from bilprov.spec.errors import UserError

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

PORT = "port"  # a device's key that its name stands for
LINE = ("baud", "parity", "stopbits", "echo", "truncation-timeout")
# The keys at the top of the file: they are for every command that has such an option.
COMMON = ("grammar", *LINE, "probe", "time", "columns", "yes")
DEVICE_KEYS = (PORT, *LINE, "probe", "power", "yes")  # of a named device

META = "bilprov.settings"  # the key of the settings in the `meta` of click's contexts
DEVICE = "device "  # how the name of a device's table begins
_MOST = 1 << 20  # bytes of the file

# Values by their key, like `truncation-timeout`, by the table's name: that of a command, like
# `capture cut`, of a device, like `device car`, or "" for what is for all commands.
Tables: TypeAlias = Mapping[str, Mapping[str, Any]]


class SettingsError(UserError):
    """The settings file cannot be used; the message is one sentence with its path."""


def user_file(environ: Mapping[str, str] = os.environ) -> Path:
    """The user's file."""
    home = environ.get("XDG_CONFIG_HOME") or Path(environ.get("HOME", "/")) / ".config"
    return Path(home, "bilprov", "config.toml")


def state_folder(environ: Mapping[str, str] = os.environ) -> Path | None:
    """The user's folder for what is kept from one use to the next (XDG); None if there is none."""
    folder = Path(environ.get("XDG_STATE_HOME", ""))
    if not folder.is_absolute():
        folder = Path(os.path.expanduser("~/.local/state"))  # noqa: PTH111 - Path's may raise
    return folder / "bilprov" if folder.is_absolute() else None


def read_settings(commands: Iterable[str], environ: Mapping[str, str] = os.environ) -> Tables:
    """Read the user's file, if there is one; `commands` are the names of the commands.

    Raises SettingsError for a table or key that is not known; those of a command `use_settings`
    checks.
    """
    file = user_file(environ)
    try:
        if not file.exists():
            return {}
        from bilprov.analyzer.files import from_toml, read_text

        tables = dict(_tables(from_toml(read_text(file, _MOST), typed=True)))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else printable(error)
        raise SettingsError(f"the settings {printable(file)} cannot be read: {why}") from error
    for name, values in tables.items():
        _refuse(file, name, _wrong(name, values, commands))
    return tables


def _tables(values: Mapping[str, Any], name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name and the own values of a table and of those below it."""
    own = {key: value for key, value in values.items() if not isinstance(value, dict)}
    yield name, {key.replace("_", "-"): value for key, value in own.items()}
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _tables(value, f"{name} {key}".strip())


def _wrong(name: str, values: Mapping[str, Any], commands: Iterable[str]) -> str:
    """What is wrong with a table, "" if it is fine."""
    if name and not f"{name} ".startswith(DEVICE):
        return former_name(name) or unknown([name], commands, "a command")
    device = name.removeprefix(DEVICE)
    if (name and not device.replace("-", "").replace("_", "").isalnum()) or device == "sim":
        return "a device's name is letters, digits, - and _, and not sim"
    if name != device and PORT not in values:
        return f"a device needs a {PORT}: add {PORT} = PATH or URL"
    return unknown(values, DEVICE_KEYS if name else COMMON, f"a setting of {device or 'all'}")


def unknown(words: Iterable[str], known: Iterable[str], what: str) -> str:
    """What is wrong with the first word that is not known, "" if all are."""
    for word in words:
        if word not in known:
            close = near(word, known)
            meant = f", did you mean {close}?" if close else f"; there are {', '.join(known)}"
            return f"{printable(word)} is not {what}{meant}"
    return ""


def _refuse(file: Path, table: str, wrong: str) -> None:
    """Raise SettingsError where something is wrong with a table."""
    where = f" [{printable(table).replace(' ', '.')}]" if table else ""
    if wrong:
        raise SettingsError(f"{printable(file)}{where}: {wrong}")


def use_settings(ctx: click.Context, command: click.Command, name: str, tables: Tables) -> None:
    """Let a command that is called below `ctx` have the settings. Raises SettingsError.

    A grammar that is named before the command comes before that of the settings.
    """
    ctx.meta[META] = tables
    own = tables.get(name, {})
    _refuse(user_file(), name, unknown(own, _options(command), f"an option of {name}"))
    defaults = defaults_of(command, {**tables.get("", {}), **own})
    if ctx.find_root().params.get("grammar") is not None:
        defaults.pop("grammar", None)
    ctx.default_map = {name.rpartition(" ")[2]: defaults}


def _options(command: click.Command) -> dict[str, click.Option]:
    """The options of a command by their key in the file: the longest spelling without dashes."""
    options = (param for param in command.params if isinstance(param, click.Option))
    return {max(option.opts, key=len).lstrip("-"): option for option in options}


def defaults_of(command: click.Command, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a command's options by parameter, as if they were typed."""
    found: dict[str, Any] = {}
    for key, option in _options(command).items():
        value = values.get(key)
        parts = value if isinstance(value, list) else [] if value is None else [value]
        if "\0" in "".join(map(str, parts)) or (isinstance(value, list) and not option.multiple):
            raise SettingsError(f"{key} must be one value without NUL characters, {as_set()}")
        # Click converts texts, and trips over numbers of other kinds.
        typed = [part if option.is_flag and isinstance(part, bool) else str(part) for part in parts]
        if typed:
            found[str(option.name)] = typed if option.multiple else typed[0]
    return found


class PortName(click.ParamType):  # type: ignore[type-arg]  # takes arguments since click 8.5
    """A port, or the name of a device of the settings, which then also brings its options.

    Click converts what is typed before it takes defaults, so those of the device come in time. A
    path is never a name, and where a file is called so, it is meant.
    """

    name = "text"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The port that is meant."""
        device = ctx.meta.get(META, {}).get(f"{DEVICE}{value}") if ctx else None
        if not ctx or not device or is_setting(ctx, param) or Path(value).exists():
            return str(value)
        ctx.default_map = {**(ctx.default_map or {}), **defaults_of(ctx.command, device)}
        return str(device[PORT])

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem[str]]:
        """The devices of the settings and the ports of this machine, or files: what begins so."""
        from click.shell_completion import CompletionItem

        from bilprov.analyzer.transport.machine import list_ports

        known = {port.path: port.description for port in list_ports()}
        for table, device in ctx.meta.get(META, {}).items():
            if table.startswith(DEVICE):
                known[table.removeprefix(DEVICE)] = str(device[PORT])
        found = ((name, help) for name, help in known.items() if name.startswith(incomplete))
        items = [CompletionItem(name, help=help) for name, help in found]
        return items or [CompletionItem(incomplete, type="file")]


def is_setting(ctx: click.Context, parameter: click.Parameter | None) -> bool:
    """Whether a parameter has its value from the settings, and not from the command line."""
    name = str(parameter and parameter.name)
    return ctx.get_parameter_source(name) is ParameterSource.DEFAULT_MAP


def as_set() -> str:
    """The words for the place of a setting."""
    return f"as set in {printable(user_file())}"
