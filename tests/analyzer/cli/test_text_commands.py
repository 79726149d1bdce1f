"""Text commands, called as users and scripts call them."""

from __future__ import annotations

import io
import json
import os
import resource
from pathlib import Path

import pytest
from rich.console import Console

from bilprov.analyzer.cli.ports import drawn
from bilprov.analyzer.transport.machine import PortInfo, Process
from bilprov.spec.protocol import load
from tests.support.captures import START, about, write_capture
from tests.support.commands import command, process
from tests.support.framed_traffic import FRAMED, odd_traffic
from tests.support.wires import json_lines
from tests.vectors import FRAMES

# explain


@pytest.mark.waits
def test_a_narrow_locale_gets_plain_lines_and_arrows() -> None:
    narrow = {"PYTHONIOENCODING": "ascii"}
    shown = process("explain", "81", "09", env=narrow).stdout.decode()

    assert "====" in shown
    assert "\\u" not in shown
    assert b"> 20 " in process("decode", "20", env=narrow).stdout


# ports, completion


def test_ports_lists_or_says_what_to_do() -> None:
    assert command("ports").stdout.strip()
    for port in json.loads(command("ports", "--format", "json").stdout):
        assert {"path", "description", "hardware_id", "likely", "holders", "unseen"} <= set(port)


PORTS = [
    PortInfo("/dev/ttyS0", "", "PNP0501", likely=False, driver="serial"),
    PortInfo(
        "/dev/ttyUSB0",
        "FT232R \x1b[31mUSB UART",
        "USB VID:PID=0403:6001",
        likely=True,
        usb="0403:6001",
        serial_number="A10K3XYZ",
        by_id="/dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A10K3XYZ-if00-port0",
        driver="ftdi_sio",
        latency_ms=16,
        holders=(Process(4242, "minicom", "minicom -D /dev/ttyUSB0"),),
        unseen=3,
    ),
]


def test_ports_fit_80_columns_and_hold_every_fact() -> None:
    console = Console(width=80, file=io.StringIO(), color_system=None)
    for part in drawn(PORTS):
        console.print(part)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    words = ("/dev/ttyS0", "*", "0403:6001", "ftdi_sio", "16 ms", "minicom (pid 4242)", "A10K3XYZ")
    for word in (*words, "usb-FTDI_FT232R_USB_UART_A10K3XYZ-if00-port0"):
        assert word in shown
    assert "\x1b" not in shown
    assert max(len(line) for line in shown.splitlines()) <= 80


# -- `bilprov decode`: hex, files and standard input are decoded frame by frame --------------------


def test_every_frame_of_the_document_is_decoded_as_typed_by_hand() -> None:
    whole = [row for row in FRAMES if len(row.frame) == 1 + (row.frame[0] & 15)]
    data = b"".join(row.frame for row in whole)

    lines = json_lines(command("decode", "-", "--format", "jsonl", stdin=data).stdout)

    assert [(bytes.fromhex(line["hex"]), line["name"], line["fields"]) for line in lines] == [
        (row.frame, row.name, dict(row.fields)) for row in whole
    ]


def test_raw_bytes_may_begin_as_json_does(tmp_path: Path) -> None:
    file = tmp_path / "raw.bin"
    file.write_bytes(b'{"\x01')
    (line,) = json_lines(command("decode", str(file), "--format", "jsonl").stdout)
    assert line["hex"] == "7b 22 01"


@pytest.mark.waits
def test_a_pipe_with_a_name_is_read_from_its_first_byte() -> None:
    ours, theirs = os.pipe()
    os.write(theirs, b"\x20\x00\x81\x05")
    os.close(theirs)

    run = process("decode", f"/dev/fd/{ours}", "--format", "jsonl", pass_fds=[ours])
    os.close(ours)

    assert [line["hex"] for line in json_lines(run.stdout)] == ["20", "00", "81 05"]


# -- `spec check`: the share of recorded bytes that a grammar decodes, and the first that do not ---

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
