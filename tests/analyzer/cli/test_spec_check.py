"""`spec check`: the share of recorded bytes that a grammar decodes, and the first that do not."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import pytest

from bilprov.spec.protocol import load
from tests.support import ROOT
from tests.support.commands import Done, command, process
from tests.support.framed_traffic import FRAMED, framed_capture, odd_traffic


def checked(*words: str | Path) -> Done:
    return command("spec", "check", *map(str, words))


def test_a_check_that_fits_the_answers_alone_is_told(tmp_path: Path) -> None:
    text = (ROOT / "examples" / "relay_board.py").read_text(encoding="utf-8")
    asked, answered = text.split("REPLY =")
    wrong = (
        asked.replace("    Sum,", "    Sum,\n    Xor,")
        + "REPLY ="
        + answered.replace("Sum(8)", "Xor()")
    )
    (tmp_path / "mine.py").write_text(wrong, encoding="utf-8")
    rows = [
        *(("host", "5556000000 01 01 ad"), ("device", "333c000000 01 01 71")),
        *(("host", "5556000000 02 01 ae"), ("device", "333c000000 02 01 72")),
    ]
    lines = [
        json.dumps({"t": t // 2 + t % 2 / 100, "dir": by, "hex": sent})
        for t, (by, sent) in enumerate(rows)
    ]
    (tmp_path / "line.jsonl").write_text("\n".join(lines), encoding="utf-8")

    told = json.loads(
        checked(tmp_path / "mine.py", tmp_path / "line.jsonl", "--format", "json").stdout
    )

    assert (told["host"]["decoded"], told["device"]["decoded"]) == (16, 0)
    assert told["first"]["check"] == '"sum" / Checksum(Byte, Sum(8), this.covered.data)'


def test_a_grammar_that_captures_cannot_carry_is_told(tmp_path: Path) -> None:
    text = (ROOT / "examples" / "relay_board.py").read_text(encoding="utf-8")
    (tmp_path / "zeros.py").write_text(text.replace('b"\\x33\\x3c', 'b"\\x33\\x3c" + b"'))
    (tmp_path / "plain.py").write_text(text)
    sent = "55 56 00 00 00 01 02 ae"

    said, nothing = (checked(tmp_path / name, sent) for name in ("zeros.py", "plain.py"))

    assert (said.returncode, nothing.returncode, nothing.stderr) == (0, 0, b"")
    line = text[: text.index('b"\\x33')].count("\n") + 1
    assert said.stderr.decode() == (
        "captures made with zeros.py open only with --grammar zeros.py, because it does more than "
        'declare: there is b"\\x33\\x3c" + b"\\x00\\x00\\x00" in line '
        f"{line}\n"
    )


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
        framed_capture(tmp_path / f"{name}.mcap", protocol, odd_traffic(protocol, seed))
    framed_capture(tmp_path / "later.mcap", protocol, odd_traffic(protocol), later=60)

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
