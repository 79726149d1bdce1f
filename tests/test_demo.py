"""The demonstration in the README: what `make demo` runs and which files it leaves."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bilprov.analyzer.api import read_capture
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Instruction
from tests.support import ROOT
from tests.vectors import FRAMES

pytestmark = pytest.mark.waits


def test_the_demo_ends_well_and_leaves_its_captures_and_its_report(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "examples.demo"],
        cwd=tmp_path,
        env={
            "PATH": "/usr/bin:/bin",
            "PYTHONPATH": f"{ROOT}:{ROOT / 'src'}",
            "PYTHONWARNINGS": "error",
        },
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.iterdir()
    assert str(folder) in done.stdout
    names = {file.name for file in folder.iterdir()}
    assert names == {"drive.mcap", "conformance.json", "conformance.mcap"}
    report = json.loads((folder / "conformance.json").read_text())
    assert report["exit"] == 0
    assert set(report["counts"]) - {"pass"} == {k for k, n in report["counts"].items() if not n}
    frames = [
        record.value.hex
        for record in read_capture(folder / "drive.mcap", load_protocol())
        if isinstance(getattr(record, "value", None), Instruction)
    ]
    # Example 5.2 as printed and as meant, example 5.3's LED as printed and as meant.
    for printed in ("40", "41 ff", "91 02", "81 02"):
        assert printed in frames
    known = {vector.frame.hex(" ") for vector in FRAMES}
    assert set(frames) <= known | {"ff"}  # the byte too many of example 5.2 is a header of its own
