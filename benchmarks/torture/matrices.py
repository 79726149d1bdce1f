"""Tests that put one fault in each place where it can be: how many places, and how many held.

All rows of these tests are run, not the sample that `make test` draws. Only one that fails, or is
skipped for want of a tool, is wrong.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from subprocess import DEVNULL, run
from xml.etree import ElementTree

from benchmarks.commands import ROOT
from benchmarks.torture.harm import Harm, Progress, Row

PLACES: dict[str, tuple[str, ...]] = {
    "an output that is closed, breaks or is full, under each command and stream, with a good and "
    "a faulty robot": ("tests/test_broken_streams.py",),
    "reports and settings at planted links, full disks and places that cannot be written": (
        "tests/test_written_files.py",
        "tests/conformance/report/test_report_command.py",
    ),
    "pipes that nobody writes to or reads, and files that appear meanwhile": (
        "tests/analyzer/test_files.py",
    ),
    "hostile text from devices, names, metadata, probes and grammars, on each surface": (
        "tests/test_doors.py",
        "tests/test_hostile_texts.py",
        "tests/test_grammar_texts.py",
    ),
    "disks that are full or fail, and captures that are cut or deleted while they are written": (
        *("-k", "disk or deleted or another_program or seam"),
        *("tests/captures", "tests/analyzer/cli", "tests/analyzer/screen", "tests/analyzer/edit"),
    ),
    "slow probes, slow answers and starved computers, in runs whose time was announced": (
        *("-k", "slow or time or announced or patient"),
        "tests/conformance/runner/test_time_limit.py",
        "tests/conformance/test_conform_real_time.py",
    ),
}
"""What the fault is and where, and the tests as pytest takes them."""


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    """Run the first so many matrices whole; nothing is drawn."""
    rows = []
    for what, tests in list(PLACES.items())[:runs]:
        rows.append(_row(what, tests))
        progress(1)
    return rows


def _row(what: str, tests: tuple[str, ...]) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "results.xml"
        options = ["--whole", "-q", "-n", "2", "--dist", "worksteal", f"--junitxml={path}"]
        ended = run(
            [sys.executable, "-m", "pytest", *options, *tests],
            cwd=ROOT,
            stdin=DEVNULL,
            stdout=DEVNULL,
            stderr=DEVNULL,
            check=False,
        )
        if not path.exists():
            return Row(what, 0, "the tests did not run", ("the tests did not run",))
        cases = list(ElementTree.parse(path).iter("testcase"))
    wrong = tuple(
        f"{case.get('name')}: {found.tag}: {(found.get('message') or '')[:200]}"
        for case in cases
        for found in case
        if found.tag in ("failure", "error", "skipped")
    )
    held = len(cases) - len(wrong)
    if ended.returncode not in (0, 1) or not cases:
        wrong = (*wrong, f"pytest ended with {ended.returncode} after {len(cases)} tests")
    return Row(what, len(cases), f"{held} held", wrong)


HARM = Harm("matrices", "one fault in each place where it can be", len(PLACES), _measure)
