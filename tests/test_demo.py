"""The demonstration in the README: what `make demo` runs and which files it leaves."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from examples.demo import FILES, PAGE
from tests.support import ROOT

# What the third of the commands to try exits with: the device that it tests does not conform.
STATUSES = [0, 0, 1]


def run(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python with these words in a folder."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "src")])
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": path, "PYTHONWARNINGS": "error"},
        capture_output=True,
        text=True,
        timeout=100,
    )


@pytest.mark.waits
def test_the_demo_ends_well_leaves_its_files_and_names_three_commands_that_work(
    tmp_path: Path,
) -> None:
    done = run("-m", "examples.demo", folder=tmp_path)

    assert done.returncode == 0, done.stderr
    folder = tmp_path / "build" / "demo"
    assert {file.name for file in folder.iterdir()} == set(FILES)
    assert json.loads((folder / "conformance.json").read_text())["exit"] == 0
    # Example 5.2 as printed and as meant, example 5.3's LED as printed and as meant.
    for printed in ("40", "41 ff", "91 02", "81 02"):
        assert f" {printed} " in done.stdout
    lines = [shlex.split(line) for line in done.stdout.split("Try next:\n")[1].splitlines()]
    tried = [run("-m", "bilprov", *words, folder=tmp_path) for _, *words in lines]
    assert [one.returncode for one in tried] == STATUSES
    assert (folder / PAGE).is_file()
