"""`bilprov decode`: hex, files and standard input are decoded frame by frame."""

from __future__ import annotations

import json
import os
from pathlib import Path

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


@pytest.mark.parametrize("own", [False, True])
def test_a_file_of_json_lines_is_read_as_such(tmp_path: Path, own: bool) -> None:
    rows = [(0.0, "host", "8105"), (0.001, "device", "00"), (0.1, "host", "20")]
    key = "direction" if own else "dir"
    lines = [json.dumps({"t": t, key: side, "hex": data}) for t, side, data in rows]
    if own:  # a fault has no bytes
        lines.append(json.dumps({"t": 0.2, "direction": None, "hex": ""}))
    (tmp_path / "rows.jsonl").write_text("\n".join(lines))

    done = command("decode", "rows.jsonl", "--format", "jsonl", cwd=tmp_path)

    found = [(one["t"], one["direction"], one["hex"]) for one in json_lines(done.stdout)]
    assert found[:3] == [(t, side, bytes.fromhex(data).hex(" ")) for t, side, data in rows]


def test_bytes_that_begin_with_a_brace_are_bytes_where_they_are_no_json(tmp_path: Path) -> None:
    (tmp_path / "raw.bin").write_bytes(b'{"\x20\n')
    done = command("decode", "raw.bin", "--format", "jsonl", cwd=tmp_path)
    assert json_lines(done.stdout)[0]["hex"].startswith("7b")


def test_a_line_that_is_no_recorded_bytes_is_told(tmp_path: Path) -> None:
    (tmp_path / "rows.jsonl").write_text('{"t": 0.0, "hex": "81"}\n')
    done = command("decode", "rows.jsonl", cwd=tmp_path)
    assert done.returncode == 2
    assert b"line 1 of rows.jsonl cannot be read: dir is missing" in done.stderr
