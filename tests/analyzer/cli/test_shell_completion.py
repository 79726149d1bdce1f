"""Completion in shells: which values are offered, and what a real bash makes of them."""

from __future__ import annotations

import fcntl
import os
import re
import select
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

from bilprov.analyzer.cli.settings import PortName
from tests.support import ROOT
from tests.support.commands import COMMANDS, PATIENCE, command, command_named, process


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
        ("bilprov capture c", ["plain,cut", "plain,check"]),
        ("bilprov spec emit ", ["plain,c", "plain,grammar", "plain,wireshark"]),
        ("bilprov conform --prob", ["plain,--probe"]),
        ("bilprov decode --format j", ["plain,jsonl"]),
        ("bilprov conform sim --fault no-stop-on-bad-d", ["plain,no-stop-on-bad-data"]),
        ("bilprov lab score --only echo", ["plain,echo"]),
        ("bilprov simulate --variant R-unused-l", ["plain,R-unused-length=too-many"]),
        ("bilprov sniff /nowhere/x", ["file,/nowhere/x"]),
        ("bilprov capture info driv", ["file,driv"]),
        ("bilprov x.mcap --form", ["plain,--format"]),
    ],
)
def test_values_are_offered(line: str, some: list[str]) -> None:
    assert set(some) <= set(offered(line))


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


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home directory in which the completion of bash is installed."""
    script = process("completion", "bash").stdout.decode()
    (tmp_path / ".bashrc").write_text(f"PS1='ready: '\n{script}")
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "bilprov"
    # Completes as the kit does; else it keeps the arguments that it was given.
    program.write_text(
        f"""#!/bin/sh
if [ -n "$_BILPROV_COMPLETE" ]; then exec {sys.executable} -m bilprov; fi
printf '%s\\n' "$@" > "$HOME/given" && mv "$HOME/given" "$HOME/said"
"""
    )
    program.chmod(0o755)
    (tmp_path / "drive.mcap").touch()
    return tmp_path


@pytest.fixture
def terminal(home: Path) -> Iterator[int]:
    """The terminal of a bash that is ready for what is typed into it."""
    variables = {
        "HOME": str(home),
        "PATH": f"{home / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT / "src"),
        "TERM": "xterm",
        "LC_ALL": "C.UTF-8",
    }
    ours, theirs = os.openpty()
    shell = subprocess.Popen(
        ["bash", "--noprofile", "-i"],
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


@pytest.mark.waits
@pytest.mark.parametrize(
    ("typed", "given"),
    [
        ("conform sim --fault no-stop-on-bad-d", "conform sim --fault no-stop-on-bad-data"),
        ("capture info driv", "capture info drive.mcap"),
    ],
)
def test_bash_completes_what_was_typed(terminal: int, home: Path, typed: str, given: str) -> None:
    said = home / "said"

    os.write(terminal, f"bilprov {typed}\t\n".encode())
    _read_until(terminal, lambda _: said.exists())

    assert said.read_text().splitlines() == given.split()
