"""Text commands, called as users and scripts call them."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from bilprov.analyzer.cli.ports import drawn, unseen
from bilprov.analyzer.transport.machine import Process
from bilprov.analyzer.transport.ports import PortInfo
from tests.support.commands import command, process

# explain


@pytest.mark.waits
def test_explain_draws_with_ascii_where_there_is_nothing_else() -> None:
    shown = process("explain", "81", "09", env={"PYTHONIOENCODING": "ascii"}).stdout.decode()

    assert "====" in shown
    assert "\\u" not in shown


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


def test_ports_say_whose_processes_they_could_not_look_into() -> None:
    assert unseen(PORTS).startswith("3 processes of other users could not be examined")
    assert unseen(PORTS[:1]) == ""
