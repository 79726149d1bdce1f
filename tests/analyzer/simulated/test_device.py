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


def test_what_was_set_is_forgotten_when_the_power_is_switched_off() -> None:
    line = Line("stk500v1")
    line.do("SetParameter", parameter=0x82, value=17)
    line.device.power_cycle(line.now)
    assert line.do("GetParameter", parameter=0x82) == {"value": 16}


RELAY = str(ROOT / "examples" / "relay_board.py")


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
