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


def test_that_a_file_cannot_be_read_is_reported_by_what_reads_it_and_not_by_click() -> None:
    params = [(name, param) for name in COMMANDS for param in command_named(name)[0].params]
    paths = [(f"{name} {param.name}", param.type) for name, param in params]
    assert [at for at, kind in paths if isinstance(kind, click.Path) and kind.readable] == []


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
