"""The grammars in `examples/` against frames of their devices, typed by hand."""

from __future__ import annotations

import ast

import pytest

from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.codec import build, judge
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import agrees, read_reply
from bilprov.spec.safe_grammar import require_declarations
from tests.support import ROOT
from tests.support.decoding import conversation, decoded, devices, hosts

RELAY, ROBOCLAW = "relay_board", "roboclaw"
# Instruction, its values, the request, its answer, the answer's fields.
EXCHANGES = [
    (RELAY, "Read", {"address": 1}, "5556000000 01 00 AC", "333C000000 01 01 71", {"state": 1}),
    (RELAY, "On", {"address": 2}, "5556000000 02 01 AE", "333C000000 02 01 72", {"state": 1}),
    (RELAY, "Off", {"address": 1}, "5556000000 01 02 AE", "333C000000 01 02 72", {"state": 2}),
    (RELAY, "Toggle", {"address": 4}, "5556000000 04 03 B2", "333C000000 04 02 75", {"state": 2}),
    (ROBOCLAW, "MainBattery", {"address": 0x81}, "81 18 BB90", "007C FE55", {"voltage": 124}),
    (ROBOCLAW, "MainBattery", {"address": 0x80}, "80 18 88A1", "007C 88E1", {"voltage": 124}),
    (ROBOCLAW, "ForwardM1", {"address": 0x80, "speed": 0}, "80 00 00 3B5A", "FF", {}),
]


def protocol_of(name: str) -> Protocol:
    return load_protocol(str(ROOT / "examples" / f"{name}.py"))


def crc_xmodem(data: bytes) -> int:
    """The CRC of a RoboClaw, without the kit's words."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


@pytest.mark.parametrize("name", [RELAY, ROBOCLAW])
def test_an_example_is_a_page_of_declarations(name: str) -> None:
    text = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")

    require_declarations(text)
    assert ast.get_docstring(ast.parse(text))
    assert len(text.splitlines()) <= 110


@pytest.mark.parametrize("row", EXCHANGES, ids=lambda row: f"{row[0]}-{row[1]}")
def test_the_check_of_each_frame_is_right(row: tuple[str, ...]) -> None:
    name, _, _, asked, answered, _ = row
    request, answer = bytes.fromhex(asked), bytes.fromhex(answered)

    if name == RELAY:
        assert all(sum(frame[:-1]) & 0xFF == frame[-1] for frame in (request, answer))
    else:
        assert crc_xmodem(request) == 0
        assert answer == b"\xff" or crc_xmodem(request[:-2] + answer) == 0


@pytest.mark.parametrize("row", EXCHANGES, ids=lambda row: f"{row[0]}-{row[1]}")
def test_requests_and_answers_are_read_and_built(row: tuple[object, ...]) -> None:
    name, instruction, values, asked, answered, fields = row
    protocol = protocol_of(str(name))
    request = judge(protocol, bytes.fromhex(str(asked)))
    reply = read_reply(protocol, bytes.fromhex(str(answered)), request)

    assert build(protocol, str(instruction), values) == request.frame  # type: ignore[arg-type]
    assert (request.valid, request.name) == (True, instruction)
    assert (reply.reason, dict(reply.fields)) == ("", fields)
    assert agrees(protocol, request, reply)


@pytest.mark.parametrize("name", [RELAY, ROBOCLAW])
def test_a_conversation_is_paired(name: str) -> None:
    rows = [row for row in EXCHANGES if row[0] == name]
    exchanges = [(bytes.fromhex(row[3]), bytes.fromhex(row[4])) for row in rows]
    records = decoded(Session(protocol_of(name)), conversation(exchanges))

    assert [one.data for one in hosts(records)] == [asked for asked, _ in exchanges]
    assert [one.data for one in devices(records)] == [answered for _, answered in exchanges]
    assert [one for record in records for one in record.faults] == []
