"""Settings: which value holds where several places name one, and what is a device's name."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

from bilprov.analyzer.cli.options import Finite, NotConfirmed, confirm_effect
from bilprov.analyzer.cli.settings import COMMON, DEVICE_KEYS, PortName
from bilprov.spec.by_effect import effect_words
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT, commands
from tests.support.commands import COMMANDS, PATIENCE, command, command_named, process
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


def test_what_is_no_number_is_refused_by_every_option_that_takes_one() -> None:
    params = [(name, param) for name in COMMANDS for param in command_named(name)[0].params]
    fractions = (click.FloatRange, click.types.FloatParamType)
    taking = [(name, param) for name, param in params if isinstance(param.type, fractions)]
    assert len(taking) > 10
    for name, param in taking:
        assert isinstance(param.type, Finite), (name, param)
        for value in ("nan", "inf", "1e400"):
            with pytest.raises(click.BadParameter):
                param.type.convert(value, param, None)


def test_where_no_instruction_sets_a_motion_nothing_is_asked(
    protocol: Protocol, grammar_text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(NotConfirmed):
        confirm_effect(protocol, "it drives", effect_words(protocol), yes=False)
    still = load(still_grammar(grammar_text))
    confirm_effect(still, "it is sent no motion", effect_words(still), yes=False)


# -- completion in shells: which values are offered, and what a real bash makes of them ------------


def offered(line: str) -> list[str]:
    """What bash is offered at the end of a line: a type and a value each."""
    words = line.split(" ")
    variables = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    shown = command(_BILPROV_COMPLETE="bash_complete", **variables)
    assert (shown.returncode, shown.stderr) == (0, b"")
    return shown.stdout.decode().splitlines()


@pytest.mark.parametrize(
    ("line", "some"),
    [
        ("bilprov con", ["plain,config", "plain,conform"]),
        ("bilprov spec emit ", ["plain,c", "plain,grammar", "plain,wireshark"]),
        ("bilprov sniff --grammar ", ["plain,robot-car", "plain,dynamixel1", "file,"]),
        ("bilprov spec check dyn", ["plain,dynamixel1", "file,dyn"]),
        ("bilprov decode --format j", ["plain,jsonl"]),
        ("bilprov conform sim --fault no-stop-on-bad-d", ["plain,no-stop-on-bad-data"]),
        ("bilprov simulate --variant R-unused-l", ["plain,R-unused-length=too-many"]),
        ("bilprov sniff /nowhere/x", ["file,/nowhere/x"]),
        ("bilprov capture info driv", ["file,driv"]),
        ("bilprov x.mcap --form", ["plain,--format"]),
    ],
)
def test_values_are_offered(line: str, some: list[str]) -> None:
    assert set(some) <= set(offered(line))


def test_the_devices_of_the_settings_are_offered_for_a_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "bilprov").mkdir()
    file = tmp_path / "bilprov" / "config.toml"
    file.write_text("[device.car]\nport = 'COM7'\n[device.van]\nport = 'COM8'\n")
    assert offered("bilprov send c") == ["plain,car"]
    assert {"plain,car", "plain,van"} <= set(offered("bilprov sniff --bridge "))


def test_an_error_on_the_line_prints_nothing(tmp_path: Path) -> None:
    assert offered(f"bilprov --grammar {tmp_path}/absent.py simulate --fault ec") == []


def test_every_file_and_port_of_every_command_completes() -> None:
    bare = []
    for name in COMMANDS:
        found, _ = command_named(name)
        for param in found.params:
            metavar = param.metavar or ""
            if re.match(r"\[?(FILE|PORT|IN\b|OUT\b)", metavar) and not isinstance(
                param.type, PortName | click.Path
            ):
                bare.append(f"{name} {metavar}")

    assert bare == []


@pytest.mark.waits
@pytest.mark.parametrize("line", ["bilprov simulate --fault ec", "bilprov con"])
def test_completion_loads_nothing_heavy_that_it_does_not_use(line: str) -> None:
    code = (
        "import sys, atexit, bilprov\n"
        "atexit.register(lambda: sys.stderr.write(' '.join(sys.modules)))\n"
        "bilprov.main()"
    )
    last = str(len(line.split()) - 1)
    variables = {"_BILPROV_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": last}
    result = process(code=code, env=variables)

    assert result.returncode == 0
    assert result.stdout.strip()
    assert {"numpy", "rich", "textual", "difflib"} & set(result.stderr.decode().split()) == set()


@pytest.mark.waits
def test_bash_completes_what_was_typed(tmp_path: Path) -> None:
    (tmp_path / "bilprov").write_text(f"#!/bin/sh\nexec {sys.executable} -m bilprov")
    (tmp_path / "bilprov").chmod(0o755)
    script = process("completion", "bash").stdout.decode()
    typed = "COMP_WORDS=(bilprov conform sim --fault no-stop-on-bad-d) COMP_CWORD=4"
    done = subprocess.run(
        ["bash", "-c", f"{script}\n{typed}\n_bilprov_completion bilprov\necho ${{COMPREPLY[*]}}"],
        env=os.environ
        | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        timeout=PATIENCE,
        check=True,
    )

    assert done.stdout.split()[0] == b"no-stop-on-bad-data", done
