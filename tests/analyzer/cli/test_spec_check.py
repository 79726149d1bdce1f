"""`spec check`: the share of recorded bytes that a grammar decodes, and the first that do not."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from bilprov.spec.protocol import load
from tests.support.captures import START, about, write_capture
from tests.support.commands import command, process
from tests.support.framed_traffic import FRAMED, odd_traffic

# --------------------------------------------------------------------------------------------------


READERS = (
    "replay a.mcap --rate 0",
    "replay a.mcap --rate 0 --format jsonl --start 0.03",
    "replay a.mcap --rate 0 --format csv --filter faulty",
    "replay a.mcap --rate 0 --judge --format jsonl",
    "stats a.mcap b.mcap --json -",
    "plot a.mcap --html -",
    *(f"export a.mcap -o - --format {kind}" for kind in ("csv", "jsonl", "parquet", "pcapng")),
    "capture cut a.mcap cut.mcap --start 0.02 --filter faulty",
    "capture diff a.mcap b.mcap",
    "capture join a.mcap later.mcap -o joined.mcap",
    "stats joined.mcap --json -",
    "capture info a.mcap",
    "capture repair a.mcap repaired.mcap",
    "capture decode a.mcap decoded.mcap",
    "decode a.mcap --format jsonl",
    "spec check grammar.py a.mcap",
)


@pytest.mark.sample(1)
@pytest.mark.parametrize("grammar", FRAMED)
def test_no_command_fails_at_a_damaged_capture(tmp_path: Path, grammar: str) -> None:
    (tmp_path / "grammar.py").write_text(FRAMED[grammar], encoding="utf-8")
    protocol = load(FRAMED[grammar], "grammar.py")
    for name, seed in (("a", 1), ("b", 2)):
        events = odd_traffic(protocol, seed)
        write_capture(tmp_path / f"{name}.mcap", events, about(protocol))
    later = START + 60_000_000_000
    write_capture(tmp_path / "later.mcap", odd_traffic(protocol), about(protocol), later)

    for line in READERS:
        done = command(*line.split(), cwd=tmp_path)
        sentences = done.stderr.decode().splitlines()
        assert "Traceback" not in done.stderr.decode(), line
        assert done.returncode in (0, 1), (line, sentences)


@pytest.mark.waits
def test_the_arrays_of_a_capture_get_the_memory_of_those_before() -> None:
    """Memory that is new each time comes page by page, which takes longer than to fill it."""
    code = """
import resource, sys, numpy
from bilprov.__main__ import _run

_run(["stats", sys.argv[1]])
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for batch in range(25):
    [numpy.ones(1_000_000) for array in range(4)]
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before, file=sys.stderr)
"""
    done = process("captures/samples/examples.mcap", code=code)

    pages = 8_000_000 // resource.getpagesize()
    assert int(done.stderr.splitlines()[-1]) < 10 * pages  # of 100 arrays
