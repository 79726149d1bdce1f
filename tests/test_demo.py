"""The demonstration in the README: what `make demo` runs and which files it leaves."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from bilprov.analyzer.api import read_capture
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Instruction
from examples.demo import FILES, PAGE
from tests.support import ROOT
from tests.vectors import FRAMES

pytestmark = pytest.mark.waits


# What the third of the commands to try exits with: the device that it tests does not conform.
STATUSES = [0, 0, 1]


def run(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python with these words in a folder."""
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={
            "PATH": "/usr/bin:/bin",
            "PYTHONPATH": f"{ROOT}:{ROOT / 'src'}",
            "PYTHONWARNINGS": "error",
        },
        capture_output=True,
        text=True,
        timeout=100,
    )


def test_the_demo_ends_well_leaves_its_files_and_names_three_commands_that_work(
    tmp_path: Path,
) -> None:
    done = run("-m", "examples.demo", folder=tmp_path)

    assert done.returncode == 0, done.stderr
    folder = tmp_path / "build" / "demo"
    assert {file.name for file in folder.iterdir()} == set(FILES)
    assert list(tmp_path.iterdir()) == [tmp_path / "build"]
    report = json.loads((folder / "conformance.json").read_text())
    assert report["exit"] == 0
    assert set(report["counts"]) - {"pass"} == {k for k, n in report["counts"].items() if not n}
    frames = [
        record.value
        for record in read_capture(folder / "drive.mcap", load_protocol())
        if isinstance(getattr(record, "value", None), Instruction)
    ]
    sent = [frame.hex for frame in frames]
    # Example 5.2 as printed and as meant, example 5.3's LED as printed and as meant.
    for printed in ("40", "41 ff", "91 02", "81 02"):
        assert printed in sent
    known = {vector.frame.hex(" ") for vector in FRAMES}
    assert set(sent) <= known | {"ff"}  # the byte too many of example 5.2 is a header of its own
    assert sent.count("00") == 5  # four in the examples, and one that stops the robot at the end
    shown = done.stdout.split("\n== 3.")[0]
    times = [float(t) for t in re.findall(r"^ +(\d+\.\d+) ", shown, re.MULTILINE)]
    assert times == sorted(times)

    lines = [shlex.split(line) for line in done.stdout.split("Try next:\n")[1].splitlines()]
    tried = [run("-m", "bilprov", *words, folder=tmp_path) for _, *words in lines]
    assert [one.returncode for one in tried] == STATUSES
    assert {Path(program).name for program, *_ in lines} == {"bilprov"}
    assert (folder / PAGE).is_file()
