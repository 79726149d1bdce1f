"""Settings: which value holds where several places name one, and what is a device's name.

What `config` shows, and each sentence about what is no setting, is in
tests/transcripts/config_completion.txt.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from bilprov.analyzer.cli.settings import COMMON, DEVICE_KEYS, PortName
from tests.support import ROOT, commands
from tests.support.commands import command

SAMPLE = ROOT / "captures" / "samples" / "examples.mcap"
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


@pytest.mark.parametrize(
    ("text", "line", "part"),
    [
        # In this order: what is typed, a device, the table of a command, what is for all commands.
        ("[sniff]\nbaud = 'one'", "sniff /dev/x", "'--baud': 'one'"),
        ("[sniff]\nbaud = 'one'", "sniff /dev/x --baud 9600", "there is no /dev/x"),
        ("baud = 'nine'\n[sniff]\nbaud = 'one'", "sniff /dev/x", "'--baud': 'one'"),
        ("baud = 'nine'\n[sniff]\nbaud = 'one'", "conform /dev/x", "'--baud': 'nine'"),
        (f"[sniff]\nbaud = 1200\n{CAR}baud = 'nine'", "sniff car", "'--baud': 'nine'"),
        (f"[sniff]\nbaud = 1200\n{CAR}baud = 'nine'", "sniff --bridge car", "'--baud': 'nine'"),
        (f"{CAR}baud = 'nine'", "sniff car --baud 300", "there is no /nowhere/x"),
        (f"{CAR}baud = 'nine'", "sniff --baud 300 --bridge car", "there is no /nowhere/x"),
        ("grammar = 'no.py'", "decode 00", "no.py cannot be read"),
        ("grammar = 'no.py'", "--grammar horn.py decode 9100", "Horn"),
        ("grammar = 'no.py'", "decode 9100 --grammar horn.py", "Horn"),
        ("[decode]\ngrammar = 'no.py'", "--grammar horn.py decode 9100", "Horn"),
        # A filter is checked by the grammar in use.
        ("[decode]\nfilter = 'name == Horn'", "decode 00", "as set in "),
        ("[decode]\nfilter = 'name == Horn'", "--grammar horn.py decode 9100", "Horn"),
        ("grammar = 'horn.py'\n[decode]\nfilter = 'name == Horn'", "decode 9100", "Horn"),
        # Keys and values.
        ("truncation_timeout = 'x'", "sniff /dev/x", "'--truncation-timeout': 'x'"),
        ("[export]\noutput = 'a.b'", f"export {SAMPLE}", "-o a.b names no format"),
        ("[sniff]\nw = 'x.mcap'", "sniff /dev/x", "w is not an option of sniff"),
        ("[conform]\nonly = ['valid/Stop*', 'bad-data/LED/9']", "conform sim --list", "LED/9"),
        (
            "[send]\nformta = 'json'",
            "send /dev/null 00",
            "formta is not an option of send, did you",
        ),
        ('yes = "x\\u0000"', "send /dev/null 00", "yes must be one value without NUL characters"),
        ("\x1b[31m = 1", "send /dev/null 00", "cannot be read"),
        ("baud = [1, 2]", "sniff /dev/x", "baud must be one value"),
        ("baud = 2026-11-22", "sniff /dev/x", "'2026-11-22' is not a whole number"),
        ("baud = 1e900", "sniff /dev/x", "is not a whole number"),
        ("baud = true", "sniff /dev/x", "is not a whole number"),
        ("yes = 2", "send /dev/ptmx 00", "'2' is not a valid boolean"),
        ("yes = 'no'", "send /dev/ptmx 00", "no terminal to ask on"),
        ("yes = 0", "send /dev/ptmx 00", "no terminal to ask on"),
        # The name of a device; a port of the settings, a path and a URL are none.
        (CAR, "replay {SAMPLE} --to car --yes", "there is no /nowhere/x"),
        (CAR, "lab line car pty", "there is no /nowhere/x"),
        (f"{CAR}[sniff]\nbridge = 'car'", "sniff", "there is no car"),
        (CAR, "sniff ./car", "there is no ./car"),
        (CAR, "sniff /nowhere/car", "there is no /nowhere/car"),
        (CAR, "sniff socket://car:1", "socket://car:1"),
        (CAR, "sniff cart", "there is no cart"),
        (CAR, "sniff horn.py", "horn.py is not a serial port"),
        (f"{CAR}prot = 1", "sniff car", "prot is not a setting of car, did you mean port?"),
    ],
)
def test_a_setting_holds_where_nothing_comes_before_it(
    place: Path, text: str, line: str, part: str
) -> None:
    said = shown(place, text, line.replace("{SAMPLE}", str(SAMPLE)))

    assert part in said
    assert "Traceback" not in said
    assert all(row.isprintable() for row in said.splitlines())


def test_a_file_with_the_name_of_a_device_is_a_path(place: Path) -> None:
    (place / "car").touch()
    assert "/nowhere/x" not in shown(place, CAR, "sniff car")


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
        "sniff:host sniff:device sniff:bridge replay:port ports:names send:target conform:target "
        "lab learn:target lab line:a lab line:b"
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
