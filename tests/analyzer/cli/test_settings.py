"""Settings: which value holds where several places name one, and what is a device's name."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from bilprov.__main__ import COMMANDS
from bilprov.analyzer.cli.options import Finite, NotConfirmed, confirm_effect
from bilprov.analyzer.cli.settings import COMMON, DEVICE_KEYS, PortName
from bilprov.spec.by_effect import effect_words
from bilprov.spec.protocol import Protocol, load
from tests.support import commands
from tests.support.commands import command, command_named
from tests.support.grammars import still_grammar

CAR = "[device.car]\nport = '/nowhere/x'\n"
SIM = "conform sim --only valid/Stop*"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, horn_text: str) -> Path:
    """A working folder with a grammar; the user's file stands in `home/bilprov` in it."""
    (tmp_path / "home" / "bilprov").mkdir(parents=True)
    (tmp_path / "horn.py").write_text(horn_text)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    return tmp_path


def shown(place: Path, text: str, line: str) -> str:
    """What a command shows with this text in the user's file: on both streams, in one string."""
    (place / "home" / "bilprov" / "config.toml").write_text(text)
    done = command(*line.split(), cwd=place)
    return (done.stdout + done.stderr).decode()


def test_a_file_with_the_name_of_a_device_is_a_path(place: Path) -> None:
    (place / "car").touch()
    assert "/nowhere/x" not in shown(place, CAR, "sniff car")
    assert "socket://car:1" in shown(place, CAR, "sniff socket://car:1")


def test_neither_a_file_of_the_working_folder_nor_the_environment_sets_anything(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "bilprov.toml").write_text("[decode]\nfrom = 'device'")
    monkeypatch.setenv("BILPROV_DECODE_FROM", "device")
    assert "instruction" in shown(place, "", "decode 00 --format jsonl")


def test_the_users_file_is_in_the_home_where_no_other_place_is_set(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / ".config").symlink_to(place / "home")
    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.setenv("HOME", str(place))
    assert "9600" in shown(place, "baud = 9600", "config")


def test_every_port_of_a_command_may_be_a_named_device() -> None:
    found = [
        (name, param.name)
        for name in commands.COMMANDS
        for param in commands.command_named(name)[0].params
        if isinstance(param.type, PortName)
    ]
    assert " ".join(f"{name}:{param}" for name, param in found) == (
        "sniff:host sniff:device sniff:bridge sniff:half_duplex replay:port ports:names "
        "send:target conform:target lab learn:target lab line:a lab line:b"
    )


@pytest.mark.waits
def test_settings_for_ports_are_left_alone_where_the_target_is_none(place: Path) -> None:
    text = "probe = 'tcp:127.0.0.1:9'\n[conform]\npower = 'exec:false'"

    assert "conforms" in shown(place, text, SIM)
    for option in ("--probe tcp:127.0.0.1:9", "--power exec:true"):
        assert "is for ports" in shown(place, text, f"{SIM} {option}")
    shell = command("send", "sim", stdin=b"Stop\n", cwd=place)
    assert (shell.returncode, b"Stop" in shell.stdout) == (0, True)


def test_every_common_setting_is_an_option_of_some_command() -> None:
    found = (commands.command_named(name)[0].params for name in commands.COMMANDS)
    options = {word for params in found for param in params for word in param.opts}

    assert {f"--{key}" for key in {*COMMON, *DEVICE_KEYS} - {"port"}} <= options


def _fractions(name: str) -> Iterator[tuple[str, str, bool]]:
    """Each option of a command that takes a number with a fraction, and whether it is a Finite."""
    for parameter in command_named(name)[0].params:
        fraction = isinstance(parameter.type, click.FloatRange | click.types.FloatParamType)
        if fraction and isinstance(parameter, click.Option):
            yield name, parameter.opts[0], isinstance(parameter.type, Finite)


OPTIONS = [option for name in COMMANDS for option in _fractions(name)]


@pytest.mark.parametrize(("name", "option", "finite"), OPTIONS)
def test_what_is_no_number_is_refused(name: str, option: str, finite: bool) -> None:
    assert finite
    for value in ("nan", "inf", "-inf", "1e400"):
        done = command(*name.split(), f"{option}={value}")
        assert done.returncode == 2
        (told,) = done.stderr.decode().splitlines()
        assert option in told


def test_where_no_instruction_sets_a_motion_nothing_is_asked(
    protocol: Protocol, grammar_text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(NotConfirmed):
        confirm_effect(protocol, "it drives", effect_words(protocol), yes=False)
    still = load(still_grammar(grammar_text))
    confirm_effect(still, "it is sent no motion", effect_words(still), yes=False)
