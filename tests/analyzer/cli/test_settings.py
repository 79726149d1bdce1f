"""Settings: which value holds where several places name one, and what is a device's name.

What `config` shows, what holds, and each sentence about what is no setting, is in
tests/transcripts/config_completion.txt.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from bilprov.analyzer.cli.settings import COMMON, DEVICE_KEYS, PortName
from tests.support import commands
from tests.support.commands import command

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
