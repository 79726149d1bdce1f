"""The Protocol's byte machine: its size, its classes, and that the simulator behaves as it says."""

from __future__ import annotations

from random import Random

import pytest

from bilprov.conformance.cases.byte_machine import ByteMachine, byte_machine
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol, load
from tests.support.grammars import wide_grammar


def size(known: ByteMachine) -> tuple[int, int]:
    return len(known.machine), len(known.classes)


def test_seen_by_answers_it_has_33_states_and_43_byte_classes(protocol: Protocol) -> None:
    assert size(byte_machine(protocol, None)) == (33, 43)


@pytest.mark.slow
def test_more_that_is_seen_tells_more_states_and_bytes_apart(protocol: Protocol) -> None:
    assert size(byte_machine(protocol, ())) == (100, 47)
    assert size(byte_machine(protocol, ("steering", "led"))) == (340, 48)


def test_every_byte_is_in_one_class(protocol: Protocol) -> None:
    for variables in (None, ()):
        known = byte_machine(protocol, variables)

        assert sorted(byte for members in known.classes for byte in members) == list(range(256))
        assert known.silence == len(known.machine.inputs) - 1
        assert known.input_of(protocol.pad_byte) < known.silence


def test_a_byte_class_by_hand(protocol: Protocol) -> None:
    classes = byte_machine(protocol, None).classes

    # Speed, Right and Left with one byte; the four motions; every unused ID without data.
    assert {(0x11, 0x41, 0x51), (0x20, 0x30, 0x60, 0x70), (0x81,), (0,)} <= set(classes)
    assert tuple(range(0x90, 0x100, 0x10)) in classes
    # Stop with 1 to 7 bytes is a colour of the LED too; the other IDs are none.
    assert {(0x01,), (0x21, 0x31, 0x61, 0x71)} <= set(classes)


def test_another_instruction_makes_another_machine(horn_text: str) -> None:
    horn = byte_machine(load(horn_text), None)

    # The horn has sounds 0 to 3: one state more, in which 4 to 7 are bad data.
    assert size(horn) == (34, 44)
    assert (0x91,) in horn.classes


def walked(protocol: Protocol, variables: tuple[str, ...] | None, draw: Random) -> None:
    """The simulator gives the outputs of the machine for drawn bytes and silences."""
    known, robot = byte_machine(protocol, variables), Simulator(protocol)
    if variables is not None:
        robot.state = robot.state.but(speed=1)
    numbers = {byte: n for n, members in enumerate(known.classes) for byte in members}
    state, now = 0, 0
    for _ in range(600):
        byte = draw.choice((None, draw.randrange(256), draw.choice((0, 1, 0x11, 0x20, 0x81))))
        symbol = known.silence if byte is None else numbers[byte]
        now += 1
        if byte is None:
            now += 100_000_000
        else:
            robot.receive(bytes([byte]), now)
        answers = robot.advance(now)
        code, seen = known.machine.outputs[state][symbol]  # type: ignore[misc]
        assert list(answers) == ([] if code is None else [code])
        if seen is not None:
            motion, *signs = seen
            look = robot.look(now)
            assert look.motion == motion
            values = [getattr(look, name) for name in variables or ()]
            assert [(v > 0) - (v < 0) for v in values] == signs
        state = known.machine.targets[state][symbol]


@pytest.mark.parametrize("variables", [None, ()])
def test_the_simulator_does_what_the_machine_says(
    protocol: Protocol, variables: tuple[str, ...] | None
) -> None:
    walked(protocol, variables, Random(3))


@pytest.mark.slow
def test_the_simulator_of_another_grammar_does_too(horn_text: str) -> None:
    walked(load(horn_text), ("steering", "led"), Random(4))


def test_a_field_of_several_bytes_is_refused_in_one_sentence(grammar_text: str) -> None:
    with pytest.raises(UserError, match="takes fields of one byte, and speed has more"):
        byte_machine(load(wide_grammar(grammar_text)), None)
