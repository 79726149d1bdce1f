"""The simulated device of the shipped grammars: it answers what is due, and remembers."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from bilprov.analyzer.grammar_file import SHIPPED, given_protocol
from bilprov.analyzer.simulated.device import SimulatedDevice, drawn_request, faulty_request
from bilprov.captures.schemas import MS
from bilprov.spec.codec import judge
from bilprov.spec.protocol import GrammarError, Protocol, load
from bilprov.spec.replies import agrees, read_reply
from tests.support import ROOT
from tests.support.grammars import mutated

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


def test_what_was_set_is_forgotten_when_the_power_is_switched_off() -> None:
    line = Line("stk500v1")
    assert line.ask(bytes.fromhex("40 82 11 20")) == bytes.fromhex("14 10")
    line.device.power_cycle(line.now)
    assert line.ask(bytes.fromhex("41 82 20")) == bytes.fromhex("14 10 10")


RELAY, SERVO = ROOT / "examples" / "relay_board.py", ROOT / "spec" / SHIPPED["dynamixel1"]
UNDONE = "the Memory that RegWrite writes has code='NO', allowed are names of an Answer: OK, "


@pytest.mark.parametrize(
    ("grammar", "old", "new", "why"),
    [
        (RELAY, '"on", Enum', '"off", Enum', "names the variable 'off', allowed are on"),
        (RELAY, "plus=2", "plus=3", "reports on, and cannot hold its value 0"),
        (RELAY, "Whole(0, 1)", "Whole(0, 2)", "reports on, and cannot hold its value 2"),
        (
            RELAY,
            'Instruction(document="open",',
            'Instruction(*STATUS.subcons, document="o",',
            "only",
        ),
        (SERVO, 'value="blocks", count="size"', 'value="blocks"', "with blocks needs a count"),
        (SERVO, 'until="Action"', 'until="Acton"', "until Acton, and there is no such instruction"),
        (SERVO, 'reset="Reset"', 'reset="Rest"', "reset Rest, and there is no such instruction"),
        (SERVO, 'UNDONE = "INSTRUCTION"', 'UNDONE = "NO"', UNDONE),
        (SERVO, 'value="blocks"', 'value="block"', "no instruction writes or reads block there"),
        (SERVO, "blocks=True", "power_on=[1]", "Memory.power_on is [1], allowed is a dict"),
        (SERVO, "blocks=True", "power_on={0: -1}", "is {0: -1}, allowed within it is a whole"),
    ],
)
def test_a_report_or_a_memory_that_cannot_be_is_refused(
    grammar: Path, old: str, new: str, why: str
) -> None:
    with pytest.raises(GrammarError) as raised:
        load(mutated(grammar.read_text(encoding="utf-8"), {old: new}), "mine.py")
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
