"""`spec check`: the share of recorded bytes that a grammar decodes, and the first that do not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
from tests.analyzer.decode.test_foreign_traffic import FOLDER, TRAFFIC, events
from tests.support import ROOT
from tests.support.commands import Done, command


def checked(*words: str | Path) -> Done:
    return command("spec", "check", *map(str, words))


@pytest.mark.parametrize("name", list(TRAFFIC))
def test_recorded_traffic_decodes_whole(name: str) -> None:
    result = checked(TRAFFIC[name][0], FOLDER / f"{name}.jsonl")

    assert (result.returncode, result.stderr) == (0, b"")
    assert b"decodes all of the bytes" in result.stdout


def test_the_first_bytes_that_do_not_decode_are_told(tmp_path: Path) -> None:
    lines = (FOLDER / "sr_wizmodbus.jsonl").read_text(encoding="utf-8").splitlines()
    row = json.loads(lines[3])
    damaged = row["hex"][:-1] + "0"
    file = tmp_path / "line.jsonl"
    text = "\n".join([*lines[:3], json.dumps({**row, "hex": damaged}), *lines[4:]])
    file.write_text(text, encoding="utf-8")

    result = checked("modbus-rtu", file, "--format", "json")
    told = json.loads(result.stdout)

    assert result.returncode == 1
    assert told["host"] == {"bytes": 352, "decoded": 352, "frames": 44}
    assert told["device"] == {"bytes": 364, "decoded": 355, "frames": 43}
    assert (told["first"]["direction"], told["first"]["offset"]) == ("device", 9)
    assert told["first"]["hex"].startswith("01 03 04 a4 71 46 2c ba a0")
    assert told["first"]["nearly"] == {
        "name": "ReadHoldingRegisters",
        "obstacle": "checksum",
        "reason": "crc is ba a0, right is ba a5",
    }


def test_a_capture_and_hex_are_read_too(tmp_path: Path) -> None:
    file, text = tmp_path / "line.mcap", tmp_path / "line.txt"
    sent = list(events("sr_wizmodbus"))
    with CaptureWriter(file, start_wall=0, metadata={}, version="1") as writer:
        for chunk in sent:
            writer.chunk(Chunk(chunk.t, chunk.direction, chunk.data))
    asked = b"".join(chunk.data for chunk in sent if chunk.direction == "host")
    text.write_text(asked.hex(" "), encoding="utf-8")

    assert b"device  364 of 364 bytes decode: 44 answers" in checked("modbus-rtu", file).stdout
    assert b"host  352 of 352 bytes decode: 44 requests" in checked("modbus-rtu", text).stdout
    result = checked("dynamixel1", "ff", "ff", "01", "02", "01", "fb", "fffe010201fb")
    assert result.returncode == 1
    assert b"dynamixel1 decodes 50.0 % of the bytes" in result.stdout
    assert b"Ping (sync): it begins with ff fe, right is ff ff" in result.stdout


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
