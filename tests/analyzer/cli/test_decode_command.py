"""`bilprov decode`: hex, files and standard input are decoded frame by frame."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.support.commands import command, process
from tests.support.wires import json_lines
from tests.vectors import FRAMES

KEYS = [
    "t",
    "direction",
    "kind",
    "hex",
    "name",
    "fields",
    "judgement",
    "reason",
    "latency",
    "state",
    "sequence",
    "answers",
    "agrees",
    "faults",
]


@pytest.mark.parametrize(
    "words", [["81", "05"], ["8105"], ["0x81", "0x05"], ["81 05"], ["0x81,0x05"]]
)
def test_hex_is_taken_as_people_write_it(words: list[str]) -> None:
    run = command("decode", "--format", "jsonl", *words)

    (line,) = json_lines(run.stdout)
    assert (run.returncode, run.stderr) == (0, b"")
    assert (line["name"], line["fields"], line["judgement"]) == ("LED", {"rgb": 5}, "OK")


def test_a_json_line_has_its_keys_in_their_order() -> None:
    (line,) = json_lines(command("decode", "81", "05", "--format", "jsonl").stdout)

    assert list(line) == KEYS
    assert list(line["state"]) == ["motion", "speed", "steering", "led", "moving"]


def test_every_frame_of_the_document_is_decoded_as_typed_by_hand() -> None:
    whole = [row for row in FRAMES if len(row.frame) == 1 + (row.frame[0] & 15)]
    data = b"".join(row.frame for row in whole)

    lines = json_lines(command("decode", "-", "--format", "jsonl", stdin=data).stdout)

    assert [(bytes.fromhex(line["hex"]), line["name"], line["fields"]) for line in lines] == [
        (row.frame, row.name, dict(row.fields)) for row in whole
    ]


def test_a_frame_that_the_end_leaves_incomplete_is_cut_short() -> None:
    run = command("decode", "20", "11", "--format", "jsonl")

    assert run.returncode == 0
    assert [line["kind"] for line in json_lines(run.stdout)] == ["instruction", "truncated"]


def test_a_faulty_frame_is_decoded_too() -> None:
    run = command("decode", "90")

    assert run.returncode == 0
    assert b"no instruction has ID 9" in run.stdout


def test_device_bytes_are_responses() -> None:
    lines = json_lines(
        command("decode", "00 04 07", "--from", "device", "--format", "jsonl").stdout
    )

    assert [(line["kind"], line["name"]) for line in lines] == [
        ("response", "OK"),
        ("response", "TOO_FEW_DATA"),
        ("response", None),
    ]
    assert lines[2]["faults"] == ["unused code"]


def test_a_file_holds_raw_bytes(tmp_path: Path) -> None:
    raw = tmp_path / "bytes.bin"
    raw.write_bytes(b"\x11\xff\x20")

    lines = json_lines(command("decode", str(raw), "--format", "jsonl").stdout)

    assert [line["hex"] for line in lines] == ["11 ff", "20"]


@pytest.mark.parametrize("words", [["81", "0x"], ["hello"], ["811"], ["/no/such/file"]])
def test_what_is_neither_hex_nor_a_file_is_said_in_one_sentence(words: list[str]) -> None:
    run = command("decode", *words)

    assert run.returncode == 2
    assert run.stdout == b""
    assert len(run.stderr.splitlines()) == 1
    assert run.stderr.startswith(b"bilprov: ")


def test_text_in_a_pipe_has_no_colour_codes() -> None:
    run = command("decode", "81 09 90 20", FORCE_COLOR="1")

    assert b"\x1b" not in run.stdout


def test_a_narrow_locale_gets_plain_arrows() -> None:
    run = process("decode", "20", env={"PYTHONIOENCODING": "ascii"})

    assert b"> 20 " in run.stdout


def test_a_filter_hides_what_it_does_not_describe() -> None:
    run = command("decode", "20 11 ff 00", "--format", "jsonl", "--filter", "speed > 1")

    assert [line["hex"] for line in json_lines(run.stdout)] == ["11 ff"]


def test_a_filter_that_does_not_parse_is_one_sentence() -> None:
    run = command("decode", "20", "--filter", "speed >")

    assert run.returncode == 2
    assert len(run.stderr.splitlines()) == 1
    assert b"column" in run.stderr


def test_another_grammar_is_followed(tmp_path: Path, horn_text: str) -> None:
    grammar = tmp_path / "horn.py"
    grammar.write_text(horn_text, encoding="utf-8")

    run = command("--grammar", str(grammar), "decode", "91 02", "--format", "jsonl")

    (line,) = json_lines(run.stdout)
    assert (line["name"], line["fields"], line["judgement"]) == ("Horn", {"sound": 2}, "OK")


@pytest.mark.waits
def test_a_pipe_with_a_name_is_read_from_its_first_byte() -> None:
    ours, theirs = os.pipe()
    os.write(theirs, b"\x20\x00\x81\x05")
    os.close(theirs)

    run = process("decode", f"/dev/fd/{ours}", "--format", "jsonl", pass_fds=[ours])
    os.close(ours)

    assert [line["hex"] for line in json_lines(run.stdout)] == ["20", "00", "81 05"]
