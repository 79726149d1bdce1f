"""Text commands, called as users and scripts call them."""

from __future__ import annotations

import io
import json
import os

import pytest
from rich.console import Console

from bilprov.analyzer.cli.ports import drawn
from bilprov.analyzer.transport.machine import PortInfo, Process
from tests.support.commands import command, process
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


@pytest.mark.waits
def test_a_pipe_with_a_name_is_read_from_its_first_byte() -> None:
    ours, theirs = os.pipe()
    os.write(theirs, b"\x20\x00\x81\x05")
    os.close(theirs)

    run = process("decode", f"/dev/fd/{ours}", "--format", "jsonl", pass_fds=[ours])
    os.close(ours)

    assert [line["hex"] for line in json_lines(run.stdout)] == ["20", "00", "81 05"]
