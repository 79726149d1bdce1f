"""The simulated device of the shipped grammars: it answers what is due, and remembers."""

from __future__ import annotations

from random import Random

import pytest

from bilprov.analyzer.grammar_file import given_protocol
from bilprov.analyzer.simulated.device import SimulatedDevice, drawn_request, faulty_request
from bilprov.captures.schemas import MS
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import agrees, read_reply

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
