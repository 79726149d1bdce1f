"""The functions of Python take a grammar's name and its file, as `--grammar` does."""

from __future__ import annotations

from pathlib import Path

from bilprov import decode, encode, explain, judge, read_capture
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
from tests.support import ROOT

RELAY = ROOT / "examples" / "relay_board.py"
ON = bytes.fromhex("5556000000 02 01 AE")


def test_a_grammar_is_given_by_name_and_by_file(tmp_path: Path) -> None:
    assert encode("On", {"address": 2}, RELAY) == encode("On", {"address": 2}, str(RELAY)) == ON
    assert encode("Ping", {"address": 1}, "dynamixel1").hex(" ") == "ff ff 01 02 01 fb"
    assert judge(ON, RELAY).describe() == "@2 On"
    assert explain(ON, protocol=RELAY).frames[0].judgement.valid
    assert [one.words for one in decode(ON, protocol=RELAY)] == ["@2 On"]

    file = tmp_path / "line.mcap"
    with CaptureWriter(file, start_wall=0, metadata={}, version="1") as writer:
        writer.chunk(Chunk(0, "host", ON))
    assert next(iter(read_capture(file, RELAY))).words == "@2 On"  # type: ignore[union-attr]
