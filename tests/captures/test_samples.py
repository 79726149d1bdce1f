"""The golden captures decode as they did when they were recorded."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bilprov.analyzer.api import read_capture
from bilprov.captures.schemas import Instruction
from tests.support import ROOT
from tests.vectors import SEQUENCES

COMMAND = (sys.executable, "-m", "bilprov")
SAMPLES = ROOT / "captures" / "samples"


@pytest.mark.parametrize("sample", sorted(SAMPLES.glob("*.mcap")), ids=lambda path: path.name)
def test_a_golden_capture_replays_as_it_did(sample: Path) -> None:
    replayed = subprocess.run(
        [*COMMAND, "replay", str(sample), "--rate", "0", "--format", "jsonl"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )

    assert replayed.stderr == b""
    assert replayed.stdout == sample.with_suffix(".jsonl").read_bytes()
    assert sample.stat().st_size < 100_000


def test_the_examples_are_the_documents_own() -> None:
    records = read_capture(SAMPLES / "examples.mcap")
    values = (getattr(record, "value", None) for record in records)
    sent = [value.hex for value in values if isinstance(value, Instruction)]
    meant = [
        s for s in SEQUENCES if s.clause.startswith("example") and "as printed" not in s.clause
    ]
    found = []

    for sequence in meant:
        frames = [step.frame.hex(" ") for step in sequence.steps]
        if frames in [sent[at : at + len(frames)] for at in range(len(sent))]:
            found.append(sequence.clause)

    assert [clause.split(",")[0] for clause in found] == [
        "example 5.1",
        "example 5.2",
        "example 5.3",
    ]
