"""The simulated device of the shipped grammars: it answers what is due, and remembers."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

import pytest

from bilprov.analyzer.grammar_file import SHIPPED, given_protocol
from bilprov.analyzer.simulated.device import SimulatedDevice, drawn_request, faulty_request
from bilprov.captures.schemas import MS
from bilprov.spec.codec import build, judge
from bilprov.spec.protocol import GrammarError, Protocol, load
from bilprov.spec.replies import agrees, read_reply
from tests.support import ROOT

NAMES = ["modbus-rtu", "stk500v1", "dynamixel1"]


class Line:
    """A host and the simulated device, at a time that goes on by itself."""

    def __init__(self, grammar: str | Protocol) -> None:
        self.protocol = given_protocol(grammar)
        self.device = SimulatedDevice(self.protocol)
        self.now = 0

    def ask(self, frame: bytes) -> bytes:
        """Send bytes, and return what comes until every time-out is over."""
        self.device.receive(frame, self.now)
        self.now += round(self.protocol.timing.truncation_timeout * MS) + MS
        return self.device.advance(self.now)

    def do(self, name: str, **fields: Any) -> dict[str, Any]:
        """Send a request and return the fields of its answer."""
        frame = build(self.protocol, name, fields)
        reply = read_reply(self.protocol, self.ask(frame), judge(self.protocol, frame))
        assert not reply.reason
        return dict(reply.fields)


def test_modbus_coils_are_read_back_bit_by_bit() -> None:
    line = Line("modbus-rtu")
    line.do("WriteSingleCoil", address=1, coil=3, value="on")
    line.do("WriteMultipleCoils", address=1, start=10, quantity=3, coils="fd")
    assert line.do("ReadCoils", address=1, start=3, quantity=11) == {"coils": b"\x81\x02"}
    line.do("WriteSingleCoil", address=1, coil=3, value="off")
    assert line.do("ReadCoils", address=1, start=3, quantity=1) == {"coils": b"\x00"}


def test_each_address_has_its_own_memory_and_a_broadcast_is_for_all() -> None:
    line = Line("modbus-rtu")
    line.do("WriteSingleRegister", address=1, register=0, value=5)
    everybody = build(
        line.protocol, "WriteSingleRegister", {"address": 0, "register": 1, "value": 7}
    )
    assert line.ask(everybody) == b""
    assert line.do("ReadHoldingRegisters", address=1, start=0, quantity=2) == {"values": (5, 7)}
    assert line.do("ReadHoldingRegisters", address=2, start=0, quantity=2) == {"values": (0, 7)}


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        ("11 03 00 6b 00 03 76 86", ""),  # one bit of the CRC is wrong
        ("f8 03 00 6b 00 03 60 87", ""),  # 248 is nobody's address
        ("01 03 00 00 00 00 45 ca", "01 83 03 01 31"),  # quantity 0
    ],
)
def test_modbus_faults_are_answered_as_the_document_says(sent: str, answer: str) -> None:
    assert Line("modbus-rtu").ask(bytes.fromhex(sent)) == bytes.fromhex(answer)


def test_servo_registers_are_read_back() -> None:
    line = Line("dynamixel1")
    line.do("Write", address=3, register=30, values="01 02")
    assert line.do("Read", address=3, register=29, size=4) == {"values": b"\x00\x01\x02\x00"}
    assert line.do("Read", address=4, register=30, size=1) == {"values": b"\x00"}


def test_a_mask_changes_the_bits_that_it_names() -> None:
    """The example of the document's clause 6.16."""
    line = Line("modbus-rtu")
    line.do("WriteSingleRegister", address=17, register=4, value=0x12)
    masks = {"and_mask": 0xF2, "or_mask": 0x25}
    assert line.do("MaskWriteRegister", address=17, register=4, **masks) == {"register": 4, **masks}
    assert line.do("ReadHoldingRegisters", address=17, start=4, quantity=1) == {"values": (0x17,)}


def test_what_a_servo_registers_is_written_by_the_next_action_alone() -> None:
    line = Line("dynamixel1")
    for address in (1, 2):
        line.do("RegWrite", address=address, register=30, values="05")
        assert line.do("Read", address=address, register=30, size=1) == {"values": b"\x00"}
    assert line.ask(build(line.protocol, "Action", {"address": 254})) == b""
    for address in (1, 2):
        assert line.do("Read", address=address, register=30, size=1) == {"values": b"\x05"}
    line.do("Write", address=1, register=30, values="06")
    refused = line.ask(build(line.protocol, "Action", {"address": 1}))
    assert refused == bytes.fromhex("ff ff 01 02 40 bc")  # Instruction Error
    assert line.ask(build(line.protocol, "Action", {"address": 254})) == b""
    assert line.do("Read", address=1, register=30, size=1) == {"values": b"\x06"}


def test_a_reset_brings_back_the_registers_of_one_servo() -> None:
    line = Line("dynamixel1")
    for address in (1, 2):
        line.do("Write", address=address, register=30, values="05")
        line.do("RegWrite", address=address, register=31, values="06")
    line.do("Reset", address=1)
    told = [line.do("Read", address=one, register=30, size=1)["values"] for one in (1, 2)]
    assert told == [b"\x00", b"\x05"]
    assert line.ask(build(line.protocol, "Action", {"address": 1}))[4] == 0x40
    line.do("Action", address=2)


def test_a_write_to_several_servos_gives_each_its_own_bytes() -> None:
    line = Line("dynamixel1")
    sent = {"address": 254, "register": 30, "size": 2, "blocks": "01 aa bb 02 cc dd"}
    assert line.ask(build(line.protocol, "SyncWrite", sent)) == b""
    told = [line.do("Read", address=one, register=30, size=3)["values"] for one in (1, 2, 3)]
    assert told == [b"\xaa\xbb\x00", b"\xcc\xdd\x00", bytes(3)]


def test_a_bootloader_tells_its_signature_and_the_parameters_that_were_set() -> None:
    line = Line("stk500v1")
    assert line.do("ReadSign") == {"signature": b"\x1e\x95\x0f"}
    asked = ("30000000", "30000100", "30000200", "50000000")  # the last one: low fuses
    told = [line.do("Universal", command=one)["output"] for one in asked]
    assert told == [0x1E, 0x95, 0x0F, 0]
    assert line.do("GetParameter", parameter=0x82) == {"value": 16}
    line.do("SetParameter", parameter=0x82, value=17)
    assert line.do("GetParameter", parameter=0x82) == {"value": 17}
    line.device.power_cycle(line.now)
    assert line.do("GetParameter", parameter=0x82) == {"value": 16}


@pytest.mark.parametrize(
    ("sent", "answer"), [("30 20", "14 10"), ("99 20", "12"), ("30 21", "15"), ("30", "")]
)
def test_bootloader_answers_what_it_does_not_know(sent: str, answer: str) -> None:
    assert Line("stk500v1").ask(bytes.fromhex(sent)) == bytes.fromhex(answer)


RELAY = str(ROOT / "examples" / "relay_board.py")


def test_an_answer_tells_the_state_that_it_reports() -> None:
    line = Line(RELAY)
    told = [
        line.do(name, address=3)["state"] for name in ("Read", "On", "Read", "Off", "Toggle", "Off")
    ]
    assert told == [2, 1, 1, 2, 1, 2]
    assert line.do("On", address=1) == {"state": 1}
    assert line.do("Read", address=3) == {"state": 2}


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ('"on", Enum', '"off", Enum', "names the variable 'off', allowed are on"),
        ("plus=2", "plus=3", "reports on, and cannot hold its value 0"),
        ("Whole(0, 1)", "Whole(0, 2)", "reports on, and cannot hold its value 2"),
        ('Instruction(document="open",', 'Instruction(*STATUS.subcons, document="open",', "only"),
    ],
)
def test_a_report_that_cannot_be_is_refused(old: str, new: str, why: str) -> None:
    text = Path(RELAY).read_text(encoding="utf-8")
    assert old in text
    with pytest.raises(GrammarError, match=why):
        load(text.replace(old, new), "relay.py")


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ('value="blocks", count="size"', 'value="blocks"', "with blocks needs a count"),
        ('until="Action"', 'until="Acton"', "until Acton, and there is no such instruction"),
        ('reset="Reset"', 'reset="Rest"', "reset Rest, and there is no such instruction"),
        (
            'UNDONE = "INSTRUCTION"',
            'UNDONE = "NO"',
            "the Memory that RegWrite writes has code='NO', allowed are names of an Answer: OK, ",
        ),
        ('value="blocks"', 'value="block"', "no instruction writes or reads block there"),
        ("blocks=True", "power_on=[1]", "Memory.power_on is [1], allowed is a dict"),
        ("blocks=True", "power_on={0: -1}", "power_on is {0: -1}, allowed within it is a whole"),
    ],
)
def test_a_memory_that_cannot_be_used_is_refused(old: str, new: str, why: str) -> None:
    text = (ROOT / "spec" / SHIPPED["dynamixel1"]).read_text(encoding="utf-8")
    assert old in text
    with pytest.raises(GrammarError) as raised:
        load(text.replace(old, new), "servo.py")
    assert why in str(raised.value)


def test_more_than_an_answer_can_hold_is_not_answered() -> None:
    line = Line("dynamixel1")
    assert line.ask(build(line.protocol, "Read", {"address": 1, "register": 0, "size": 255})) == b""
    assert line.ask(build(line.protocol, "Read", {"address": 1, "register": 0, "size": 1}))


@pytest.mark.parametrize("name", NAMES)
def test_drawn_requests_are_answered_where_an_answer_is_due(name: str) -> None:
    line, chance = Line(name), Random(name)
    for _ in range(500):
        frame = drawn_request(line.protocol, chance)
        asked = judge(line.protocol, frame)
        assert asked.valid, asked.reason
        answer = line.ask(frame)
        if not answer and dict(asked.fields).get("size", 0) > 250:
            continue  # no answer can hold so much
        assert bool(answer) is asked.answer_due
        if answer:
            reply = read_reply(line.protocol, answer, asked)
            assert reply.reason == ""
            assert agrees(line.protocol, asked, reply)
        wrong = judge(line.protocol, faulty_request(line.protocol, chance))
        assert not wrong.valid
