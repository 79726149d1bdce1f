"""Completion in shells: which values are offered, and what a real bash makes of them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
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
        ("bilprov --grammar mod", ["plain,modbus-rtu"]),
        ("bilprov sniff --grammar ", ["plain,robot-car", "plain,dynamixel1", "file,"]),
        ("bilprov spec emit grammar st", ["plain,stk500v1"]),
        ("bilprov spec check dyn", ["plain,dynamixel1", "file,dyn"]),
        ("bilprov spec check dynamixel1 li", ["file,li"]),
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
