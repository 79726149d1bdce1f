"""`bilprov decode`: hex, files and standard input are decoded frame by frame."""

from __future__ import annotations

import os

import pytest

from tests.support.commands import command, process
from tests.support.wires import json_lines
from tests.vectors import FRAMES


def test_every_frame_of_the_document_is_decoded_as_typed_by_hand() -> None:
    whole = [row for row in FRAMES if len(row.frame) == 1 + (row.frame[0] & 15)]
    data = b"".join(row.frame for row in whole)

    lines = json_lines(command("decode", "-", "--format", "jsonl", stdin=data).stdout)

    assert [(bytes.fromhex(line["hex"]), line["name"], line["fields"]) for line in lines] == [
        (row.frame, row.name, dict(row.fields)) for row in whole
    ]


def test_text_in_a_pipe_has_no_colour_codes() -> None:
    run = command("decode", "81 09 90 20", FORCE_COLOR="1")

    assert b"\x1b" not in run.stdout


def test_a_narrow_locale_gets_plain_arrows() -> None:
    run = process("decode", "20", env={"PYTHONIOENCODING": "ascii"})

    assert b"> 20 " in run.stdout


@pytest.mark.waits
def test_a_pipe_with_a_name_is_read_from_its_first_byte() -> None:
    ours, theirs = os.pipe()
    os.write(theirs, b"\x20\x00\x81\x05")
    os.close(theirs)

    run = process("decode", f"/dev/fd/{ours}", "--format", "jsonl", pass_fds=[ours])
    os.close(ours)

    assert [line["hex"] for line in json_lines(run.stdout)] == ["20", "00", "81 05"]
