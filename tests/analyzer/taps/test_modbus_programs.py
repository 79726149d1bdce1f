"""Clients and servers of Modbus RTU by others, with `sniff --bridge` between them."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.analyzer.taps.test_remote_lines import tool, tool_running
from tests.support import ROOT
from tests.support.bridges import Traffic, bridged
from tests.support.firmware import needs
from tests.support.robots import PATIENCE

HEADER = Path("/usr/include/modbus/modbus.h")
SOURCE = ROOT / "tests" / "support" / "modbus_peer.c"

pytestmark = [
    pytest.mark.waits,
    needs("gcc", files=[HEADER], package="gcc libc6-dev libmodbus-dev"),
]

PYMODBUS = [sys.executable, str(SOURCE.with_suffix(".py"))]
# What both clients ask: the names of requests, how many, and the exceptions that are due.
ASKED = {
    "ReadCoils": 3,
    "ReadDiscreteInputs": 1,
    "ReadHoldingRegisters": 3,
    "ReadInputRegisters": 1,
    "WriteSingleCoil": 1,
    "WriteSingleRegister": 3,
    "WriteMultipleCoils": 1,
    "WriteMultipleRegisters": 1,
    "MaskWriteRegister": 1,
    "ReadWriteMultipleRegisters": 1,
}
REFUSED = {"ILLEGAL_DATA_ADDRESS": 2}
# And what libmodbus' client asks besides: for no register, and for an unknown function.
MORE_ASKED = {"ReadHoldingRegisters": 1, None: 1}
MORE_REFUSED = {"ILLEGAL_DATA_VALUE": 1, "ILLEGAL_FUNCTION": 1}


@pytest.fixture(scope="module")
def libmodbus(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command of the client and server that use it."""
    program = tmp_path_factory.mktemp("libmodbus") / "peer"
    words = ["gcc", "-Wall", "-Wextra", "-Werror", f"-I{HEADER.parent}", "-o", str(program)]
    subprocess.run([*words, str(SOURCE), "-lmodbus"], check=True)
    return [str(program)]


def captured(client: list[str], server: list[str], folder: Path) -> Traffic:
    """What is decoded of a client's requests to a server; both must be content with the other."""
    near, far = folder / "near", folder / "far"
    ends = f"PTY,rawer,link={near}", f"PTY,rawer,link={far}"
    capture = folder / "line.mcap"
    with (
        tool_running(tool("socat"), *ends, ready=lambda: near.exists() and far.exists()),
        subprocess.Popen([*server, "server", str(far)], stdout=subprocess.PIPE) as serving,
    ):
        try:
            assert serving.stdout
            assert serving.stdout.readline() == b"ready\n"
            with bridged("modbus-rtu", str(near), capture) as port:
                words = [*client, "client", port]
                done = subprocess.run(words, capture_output=True, timeout=PATIENCE, check=False)
            assert done.returncode == 0, done.stderr.decode()
        finally:
            serving.kill()
    return Traffic(capture)


@pytest.mark.parametrize("server", ["pymodbus", "libmodbus"])
def test_what_pymodbus_asks_is_decoded(libmodbus: list[str], tmp_path: Path, server: str) -> None:
    traffic = captured(PYMODBUS, PYMODBUS if server == "pymodbus" else libmodbus, tmp_path)

    traffic.require_nothing_odd()
    require(traffic, ASKED, REFUSED)


def test_what_libmodbus_asks_is_decoded(libmodbus: list[str], tmp_path: Path) -> None:
    traffic = captured(libmodbus, libmodbus, tmp_path)

    traffic.require_nothing_odd(faulty=2)
    require(traffic, Counter(ASKED) + Counter(MORE_ASKED), {**REFUSED, **MORE_REFUSED})


def require(traffic: Traffic, asked: dict[str | None, int], refused: dict[str, int]) -> None:
    """These are the requests, and these the exceptions; every check is right."""
    assert Counter(one["name"] for one in traffic.requests) == asked
    names = Counter(one["name"] for one in traffic.answers.values())
    assert names == {**refused, "answer": sum(asked.values()) - sum(refused.values()) - 1}
    assert {one["address"] for one in traffic.frames} == {0, 17}
    assert "bad-checksum" not in {one["outcome"] for one in traffic.frames}
    fields = {
        one["name"]: traffic.answers[one["sequence"]]["fields"]
        for one in traffic.requests
        if one["sequence"] in traffic.answers
    }
    assert fields["ReadInputRegisters"] == {"values": [2005]}
    assert fields["ReadWriteMultipleRegisters"] == {"values": [0xFFFF, 0x8000, 0x0102, 7]}
    assert fields["ReadHoldingRegisters"] == {"values": [0x4321]}  # the last one
