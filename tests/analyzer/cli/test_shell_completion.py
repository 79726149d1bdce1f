"""Completion in shells: what is offered for each value, and what real shells make of it."""

from __future__ import annotations

import fcntl
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import click
import pytest
from click.shell_completion import FishComplete, ZshComplete

from bilprov.analyzer.cli import shells
from bilprov.analyzer.cli.completion import Offered
from bilprov.analyzer.cli.settings import PortName
from tests.support import ROOT
from tests.support.commands import COMMANDS, PATIENCE, command, command_named, process


def offered(line: str, grammar: Path | None = None) -> list[str]:
    """What fish is offered at the end of a line: a value each."""
    line = line.replace("bilprov", f"bilprov --grammar {grammar}", 1) if grammar else line
    last = line.rsplit(" ", 1)[-1] if "'" not in line else line[line.rindex("'") :]
    shown = command(_BILPROV_COMPLETE="fish_complete", COMP_WORDS=line, COMP_CWORD=last)
    assert (shown.returncode, shown.stderr) == (0, b"")
    lines = shown.stdout.decode().splitlines()
    return [line.partition(",")[2].partition("\t")[0] for line in lines if line.strip()]


@pytest.mark.parametrize(
    ("line", "some"),
    [
        ("bilprov sniff --filter 'direction == ", ["direction == host", "direction == device"]),
        ("bilprov replay x.mcap --filter 'na", ["name ==", "name !=", "name in", "name contains"]),
        ("bilprov decode --filter 'faulty", ["faulty"]),
        ("bilprov sniff --filter 'name in", ["name in {"]),
        ("bilprov sniff --filter 'latency > 20", ["latency > 20us", "latency > 20ms"]),
        ("bilprov sniff --filter 'latency > 20m", ["latency > 20ms"]),
        ("bilprov conform s", ["sim"]),
        ("bilprov conform em", ["emulator:simavr:"]),
        ("bilprov conform sim --fault no-stop-on-bad-d", ["no-stop-on-bad-data"]),
        ("bilprov simulate --fault random", ["random:"]),
        ("bilprov lab score --only echo", ["echo"]),
        ("bilprov conform sim --only bad", ["bad-data/"]),
        ("bilprov conform sim --only bad-data/LED/25", ["bad-data/LED/250", "bad-data/LED/255"]),
        ("bilprov conform sim --only sequence/t", ["sequence/tour/"]),
        ("bilprov conform x --probe ", ["tcp:", "modem:cts", "ask", "none", "sim"]),
        ("bilprov encode ro", ["RotateRight", "RotateLeft"]),
        ("bilprov encode led ", ["rgb="]),
        ("bilprov encode LED rgb=", ["rgb=0", "rgb=7"]),
        ("bilprov encode Speed ", ["speed="]),
        ("bilprov send x ro", ["RotateRight"]),
        ("bilprov send x p", ["pause="]),
        ("bilprov lab line p", ["pty"]),
        ("bilprov spec readings R-led", ["R-led-id"]),
        ("bilprov con", ["config", "conform"]),
        ("bilprov capture c", ["cut", "check"]),
        ("bilprov spec emit ", ["c", "grammar", "wireshark"]),
        ("bilprov x.mcap --filter 'na", ["name ==", "name !="]),
        ("bilprov conform --prob", ["--probe"]),
    ],
)
def test_values_are_offered(line: str, some: list[str]) -> None:
    assert set(some) <= set(offered(line))


def test_the_variants_are_offered() -> None:
    listed = command("simulate", "--list-variants").stdout.decode().splitlines()

    assert offered("bilprov simulate --variant ")[0] == listed[1].split()[0]


def test_another_grammars_names_are_offered(tmp_path: Path, horn_text: str) -> None:
    grammar = tmp_path / "horn.py"
    grammar.write_text(horn_text, encoding="utf-8")

    assert offered("bilprov encode ho", grammar) == ["Horn"]
    assert offered("bilprov encode Horn sound=", grammar) == [f"sound={n}" for n in range(4)]
    assert offered("bilprov sniff --filter 'name == ho", grammar) == ["name == Horn"]


def test_an_error_on_the_line_prints_nothing(tmp_path: Path) -> None:
    assert offered("bilprov sniff --filter 'name == ) ") == []
    assert offered("bilprov encode ho", tmp_path / "absent.py") == []


def test_every_file_port_and_filter_of_every_command_completes() -> None:
    bare = []
    for name in COMMANDS:
        found, _ = command_named(name)
        for param in found.params:
            metavar = param.metavar or ""
            if re.match(r"\[?(FILE|PORT|EXPR|ITEM|IN\b|OUT\b)", metavar) and not (
                isinstance(param.type, Offered | PortName | click.Path) or "|sim" in metavar
            ):
                bare.append(f"{name} {metavar}")

    assert bare == []


@pytest.mark.waits
@pytest.mark.parametrize(
    "line", ["bilprov sniff --filter 'name == fo", "bilprov simulate --fault ec", "bilprov con"]
)
def test_completion_loads_nothing_heavy_that_it_does_not_use(line: str) -> None:
    code = (
        "import sys, atexit, bilprov\n"
        "atexit.register(lambda: sys.stderr.write(' '.join(sys.modules)))\n"
        "bilprov.main()"
    )
    last = line[line.rindex("'") :] if "'" in line else line.split()[-1]
    variables = {"_BILPROV_COMPLETE": "fish_complete", "COMP_WORDS": line, "COMP_CWORD": last}
    result = process(code=code, env=variables)

    assert result.returncode == 0
    assert result.stdout.strip()
    assert {"numpy", "rich", "textual", "difflib"} & set(result.stderr.decode().split()) == set()


# Real shells

STARTS = {"bash": ["bash", "--noprofile", "-i"], "zsh": ["zsh", "-i"], "fish": ["fish", "-i"]}

# What is typed up to the tab and behind it, and the arguments that the command is then given.
TYPED = [
    ("sniff --filter 'direction == ho", "", ["sniff", "--filter", "direction == host"]),
    ("sniff --filter 'id in {LED, Forw", "}'", ["sniff", "--filter", "id in {LED, Forward }"]),
    (
        "decode --filter 'faults contains lo",
        "",
        ["decode", "--filter", 'faults contains "lost bytes"'],
    ),
    ("conform emulator:sima", "x.elf", ["conform", "emulator:simavr:x.elf"]),
    ("conform sim --only bad-data/L", "9", ["conform", "sim", "--only", "bad-data/LED/9"]),
    ("capture info driv", "", ["capture", "info", "drive.mcap"]),
]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home directory in which the completion of each shell is installed."""
    folder = tmp_path_factory.mktemp("home")
    scripts = {name: process("completion", name).stdout.decode() for name in STARTS}
    (folder / ".bashrc").write_text(f"PS1='ready: '\n{scripts['bash']}")
    begin = "PS1='ready: '\nautoload -U compinit; compinit -u -D\n"
    (folder / ".zshrc").write_text(begin + scripts["zsh"])
    fish = folder / ".config/fish"
    (fish / "completions").mkdir(parents=True)
    (fish / "completions/bilprov.fish").write_text(scripts["fish"])
    prompt = "set -g fish_greeting; function fish_prompt; echo -n 'ready: '; end\n"
    (fish / "config.fish").write_text(prompt)
    (folder / "bin").mkdir()
    program = folder / "bin/bilprov"
    # Completes as the kit does; else it keeps the arguments that it was given.
    program.write_text(
        f"""#!/bin/sh
if [ -n "$_BILPROV_COMPLETE" ]; then exec {sys.executable} -m bilprov; fi
printf '%s\\n' "$@" > "$HOME/given" && mv "$HOME/given" "$HOME/said"
"""
    )
    program.chmod(0o755)
    (folder / "drive.mcap").touch()
    return folder


@pytest.fixture(params=STARTS)
def terminal(request: pytest.FixtureRequest, home: Path) -> Iterator[int]:
    """The terminal of a shell that is ready for what is typed into it."""
    name: str = request.param
    if shutil.which(name) is None:
        pytest.skip(f"there is no {name} here: apt-get install {name}")
    variables = {
        "HOME": str(home),
        "XDG_CONFIG_HOME": str(home / ".config"),
        "XDG_DATA_HOME": str(home / ".local"),
        "PATH": f"{home / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT / "src"),
        "TERM": "xterm",
        "LC_ALL": "C.UTF-8",
    }
    ours, theirs = os.openpty()
    shell = subprocess.Popen(
        STARTS[name],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        cwd=home,
        env=variables,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(theirs)
    try:
        _read_until(ours, lambda seen: b"ready: " in seen)
        yield ours
    finally:
        os.close(ours)
        with suppress(ProcessLookupError):
            os.killpg(shell.pid, signal.SIGKILL)
        shell.wait()


def _read_until(terminal: int, enough: Callable[[bytes], bool]) -> None:
    """Read what a shell writes, which would wait otherwise, until it is enough."""
    seen, end = b"", time.monotonic() + PATIENCE
    while not enough(seen):
        assert time.monotonic() < end, seen
        if select.select([terminal], [], [], 0.05)[0]:
            seen += os.read(terminal, 1 << 16)


@pytest.mark.sample(6)
@pytest.mark.waits
@pytest.mark.parametrize(("typed", "behind", "given"), TYPED)
def test_a_shell_completes_what_was_typed(
    terminal: int, home: Path, typed: str, behind: str, given: list[str]
) -> None:
    said = home / "said"
    said.unlink(missing_ok=True)

    os.write(terminal, f"bilprov {typed}\t{behind}\n".encode())
    _read_until(terminal, lambda _: said.exists())

    assert said.read_text().splitlines() == given


def test_the_scripts_are_clicks_but_for_what_the_kit_adds() -> None:
    assert shells.Zsh.source_template != ZshComplete.source_template
    assert shells.Fish.source_template != FishComplete.source_template
