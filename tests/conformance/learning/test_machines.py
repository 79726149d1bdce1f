"""Machines as values: outputs, numbering, minimal machines, where two of them differ."""

from __future__ import annotations

import random

import pytest

from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.learning.drawing import dot_text
from bilprov.conformance.learning.learner import (
    Difference,
    Learner,
    Output,
    alphabet,
    differences,
    item_of,
    name_of,
    output_of,
    reference_machine,
)
from bilprov.conformance.machines.wp_method import Mealy, minimal, state_cover
from bilprov.conformance.oracle.profile import Choices
from bilprov.conformance.oracle.state_model import Model
from bilprov.spec.protocol import Protocol

OK, NO = Output((0,)), Output((1,))


def machine(*rows: str) -> Mealy[Output]:
    """A machine of rows like `1! 0`: for each input the next state, and ! where it answers 1."""
    cells = [row.split() for row in rows]
    return Mealy(
        tuple(tuple(int(one.strip("!")) for one in row) for row in cells),
        tuple(tuple(NO if "!" in one else OK for one in row) for row in cells),
    )


def reference(protocol: Protocol) -> Mealy[Output]:
    return reference_machine(Model(protocol, Choices()), alphabet(protocol))


@pytest.mark.parametrize(
    ("look", "words"),
    [
        (CarLook(t=0, moving=False), "stopped"),
        (CarLook(t=0, moving=True), "moving"),
        (CarLook(t=0, moving=None), ""),
        (CarLook(t=0, moving=True, motion="forward", led=5), "forward, led 5"),
        (CarLook(t=0, moving=False, motion="forward", left=0, right=0), "stopped"),
        (CarLook(t=0, moving=True, left=9, right=4), "forward, left wheel ahead"),
        (CarLook(t=0, moving=True, left=-9, right=4), "backward, left wheel ahead"),
        (CarLook(t=0, moving=True, left=-4, right=-9), "backward, right wheel ahead"),
        (CarLook(t=0, moving=True, left=9, right=-8), "rotate_right"),
        (CarLook(t=0, moving=True, left=-9, right=9), "rotate_left"),
        (
            CarLook(t=0, moving=True, motion="forward", left=-9, right=-9),
            "forward, by its wheels backward",
        ),
    ],
)
def test_a_look_counts_by_the_sign_and_the_order_of_the_wheels(
    protocol: Protocol, look: Look, words: str
) -> None:
    assert output_of(protocol, (0,), look).look_words == words


def test_a_facet_that_is_not_seen_fits_any_and_another_value_does_not() -> None:
    seen = Output((0,), moving=True, lights=(("led", 3),))

    assert seen.fits(Output((0,)))
    assert seen.fits(Output((0,), motion="forward", lights=(("led", 3),)))
    assert not seen.fits(Output((0,), lights=(("led", 2),)))
    assert not seen.fits(Output((), moving=True, lights=(("led", 3),)))


def test_a_minimal_machine_behaves_alike_and_is_numbered_by_its_behaviour() -> None:
    three = machine("2 1", "2 1!", "0 1")  # 0 and 2 behave alike
    word = bytes([1, 1, 0, 1])

    assert minimal(three) == machine("0 1", "0 1!")
    assert minimal(three).run(word) == three.run(word) == (OK, NO, OK, OK)
    assert state_cover(three) == (b"", bytes([1]), bytes([0]))


def test_the_shortest_difference_comes_first_and_each_kind_of_difference_once() -> None:
    due, given = machine("1 0", "1 2", "2 2"), machine("1 0", "1 2", "2! 2!")

    assert list(differences(due, due)) == []
    assert list(differences(due, given)) == [
        Difference(bytes([0, 1, 0]), OK, NO),
        Difference(bytes([0, 1, 1]), OK, NO),
    ]


def test_every_kind_of_fault_and_every_instruction_is_an_input(each_protocol: Protocol) -> None:
    steps = alphabet(each_protocol)

    valid = {step.frame[0] for step in steps if not step.faulty}
    assert valid == {each_protocol.header_bytes[s.id, s.length] for s in each_protocol.instructions}
    assert {step.kind for step in steps} >= {"valid", "unused-id", "wrong-length", "truncated"}
    names = [name_of(each_protocol, step) for step in steps]
    assert len(set(names)) == len(names) == len({step.frame for step in steps})


class Knowing:
    """A teacher that knows a machine."""

    def __init__(self, known: Mealy[Output]) -> None:
        self.known = known

    def outputs(self, word: bytes) -> tuple[Output, ...]:
        return self.known.run(word)


def test_any_small_machine_is_learned_whatever_is_expected() -> None:
    draw = random.Random("machines")
    for size in range(1, 9):
        rows = [
            " ".join(f"{draw.randrange(size)}{draw.choice(['', '!'])}" for _ in range(3))
            for _ in range(size)
        ]
        known = minimal(machine(*rows))
        expected = machine("0 0 0")
        learner = Learner(Knowing(known), expected)

        assert learner.learn() == known
        assert learner.differences == list(differences(expected, known))[:12]


def test_the_machine_of_any_protocol_is_learned_as_its_minimal_one(each_protocol: Protocol) -> None:
    due = reference(each_protocol)
    learner = Learner(Knowing(due), due)

    assert learner.learn() == minimal(due)
    assert learner.differences == []


def test_a_drawing_has_a_node_for_each_kind_of_motion(protocol: Protocol) -> None:
    forward = Output((0,), moving=True, motion="forward", lights=(("led", 0),))
    stopped = Output((0,), moving=False, motion="stopped", lights=(("led", 0),))
    bright = forward._replace(lights=(("led", 7),))
    refused = stopped._replace(codes=(1,))
    one = Mealy(
        ((1, 0, 0), (1, 2, 0), (2, 2, 0)),
        ((forward, stopped, refused), (forward, bright, stopped), (bright, bright, refused)),
    )

    text = dot_text(protocol, one, ["Forward", "LED", 'Say "go"'], "a car", {(2, 2)})

    assert text.startswith('digraph "a car" {')
    assert '0 [label="stopped\\n1 state"' in text
    assert '1 [label="forward\\n2 states"' in text
    assert '0 -> 1 [label="Forward: 00 OK" tooltip="Forward: 00 OK"];' in text
    assert '1 -> 1 [label="Forward: 00 OK\\nLED: 00 OK"' in text
    red = '1 -> 0 [label="Say \\"go\\": 00 OK\\nSay \\"go\\": 01 BAD_HEADER"'
    assert next(line for line in text.splitlines() if "#c62828" in line).startswith(red)
    assert text.count("->") == 5  # the start, and one arrow between two kinds each way


def test_inputs_of_an_arrow_are_counted_where_they_are_many(protocol: Protocol) -> None:
    go, refused = Output((0,)), Output((1,))
    one = Mealy(((0, 0, 0, 0),), ((go, go, go, refused),))

    text = dot_text(protocol, one, ["A", "B", "C", "D"], "a car", {(0, 3)})

    assert 'label="4 inputs\\nD: 01 BAD_HEADER" tooltip="A: 00 OK\\n' in text


def test_a_frame_is_written_as_send_takes_it(protocol: Protocol) -> None:
    stop = item_of(protocol, bytes([protocol.pad_byte]))

    assert stop == protocol.stop.name
    assert item_of(protocol, b"\x92\x00\x00") == "920000"
