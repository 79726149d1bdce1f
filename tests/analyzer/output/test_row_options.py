"""`--time`, `--columns` and `--format csv` of sniff and replay; `--count` and `--duration`."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path

import pytest

from bilprov.analyzer.transport.pty import open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
from tests.support.commands import command
from tests.support.decoding import MS
from tests.support.wires import running


@pytest.mark.waits
def test_count_does_not_wait_for_what_is_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "slow.mcap"
    with CaptureWriter(path, start_wall=0, metadata={"attached": "no"}, version="0") as writer:
        writer.chunk(Chunk(0, "host", b"\x20"))
        writer.chunk(Chunk(1, "device", b"\0"))
        writer.chunk(Chunk(3_600_000 * MS, "host", b"\x00"))

    with running("replay", str(path), "--format", "jsonl", "--count", "1") as replay:
        code, out, _ = replay.result()

    assert (code, len(out.splitlines())) == (0, 1)


@pytest.mark.waits
def test_sniff_writes_the_same(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    more = ["--format", "csv", "--columns", "time,t,hex", "--time", "utc", "--count", "2"]
    with (
        open_pty() as host,
        open_pty() as device,
        running("sniff", host.name, device.name, "-w", str(path), *more) as sniff,
    ):
        sniff.wait_for(path)
        os.write(host.master, b"\x20\x00")
        code, out, _ = sniff.result()

    header, *rows = csv.reader(io.StringIO(out.decode(), newline=""))
    assert (code, header) == (0, ["time", "t", "hex"])
    assert [row[2] for row in rows] == ["20", "00"]
    again = command("replay", str(path), "--rate", "0", *more)
    assert again.stdout == out
    start = open_capture(path).start
    wall = start + round(float(rows[0][1]) * 1e9)
    assert rows[0][0].endswith(f".{wall // 1000 % 1_000_000:06d}Z")
