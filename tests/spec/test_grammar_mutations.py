"""Mutations of the grammar: for each one a hand-typed vector fails.

Each mutation changes the grammar's text in one way. Codec, simulator and generated cases would all
follow it and still agree with each other, so only a hand-typed vector can fail.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from bilprov.spec.codec import bit_names, judge
from bilprov.spec.protocol import Protocol, load
from tests.support.grammars import mutated
from tests.vectors import (
    COLOURS,
    FRAMES,
    HEADERS,
    LINE,
    POWER_ON,
    RESPONSES,
    SEQUENCES,
    TIMING,
    UNUSED_IDS,
)

if TYPE_CHECKING:
    from tests.conftest import Drive

STOP = "effect=Sets(motion=Motion.STOPPED, steering=0),  #"
RIGHT = 'effect=Sets(steering=From("strength")),'
LEFT = 'effect=Sets(steering=From("strength", factor=-1)),'
FAULTY = "FAULTY = Sets(motion=Motion.STOPPED, steering=0)"
POWER = "POWER_ON = Sets(motion=Motion.STOPPED, speed=0, steering=0, led=0)"
ID = '"id" / BitsInteger(4)'
LENGTH = '"length" / BitsInteger(4)'
LED = 'Ranged(Byte, 0, 7, bits="RGB"'
SPEED = '"speed" / Ranged(Byte, 0, 255)'
SETS_SPEED = 'effect=Sets(speed=From("speed"))'

# Each mutation: what is replaced by what, all at once.
MUTATIONS = {
    "the LED takes four bits": {LED: 'Ranged(Byte, 0, 15, bits="RGB"'},
    "the LED takes any byte": {LED: 'Ranged(Byte, 0, 255, bits="RGB"'},
    "the LED takes two bits": {LED: 'Ranged(Byte, 0, 3, bits="RGB"'},
    "the LED cannot be switched off": {LED: 'Ranged(Byte, 1, 7, bits="RGB"'},
    "the LED's bits are blue, green, red": {LED: 'Ranged(Byte, 0, 7, bits="BGR"'},
    "the LED has the ID of example 5.3": {'8: "LED"': '9: "LED"'},
    "the LED does nothing": {'effect=Sets(led=From("rgb"))': "effect=Sets()"},
    "the LED stops": {
        'effect=Sets(led=From("rgb"))': 'effect=Sets(led=From("rgb"), motion=Motion.STOPPED)'
    },
    "Right steers left": {RIGHT: LEFT},
    "Left steers right": {LEFT: RIGHT},
    "Right and Left are exchanged": {'4: "Right"': '5: "Right"', '5: "Left"': '4: "Left"'},
    "Right starts to drive": {
        RIGHT: 'effect=Sets(steering=From("strength"), motion=Motion.FORWARD),'
    },
    "Left ends a motion": {
        LEFT: 'effect=Sets(steering=From("strength", factor=-1), motion=Motion.STOPPED),'
    },
    "Right takes no data": {
        '"strength" / Ranged(Byte, 0, 255) * "steering strength",\n        document="Höger"': (
            'document="Höger"'
        ),
        RIGHT: "effect=Sets(steering=255),",
    },
    "Stop keeps steering": {STOP: "effect=Sets(motion=Motion.STOPPED),  #"},
    "Stop zeroes the speed": {STOP: "effect=Sets(motion=Motion.STOPPED, steering=0, speed=0),  #"},
    "Stop puts out the LED": {STOP: "effect=Sets(motion=Motion.STOPPED, steering=0, led=0),  #"},
    "a fault keeps steering": {FAULTY: "FAULTY = Sets(motion=Motion.STOPPED)"},
    "a fault zeroes the speed": {
        FAULTY: "FAULTY = Sets(motion=Motion.STOPPED, steering=0, speed=0)"
    },
    "a fault puts out the LED": {FAULTY: "FAULTY = Sets(motion=Motion.STOPPED, steering=0, led=0)"},
    "too many and too few are exchanged": {
        "Outcome.TOO_MANY": "Outcome.TOO_FEW",
        "Outcome.TOO_FEW": "Outcome.TOO_MANY",
    },
    "bad header and bad data are exchanged": {
        "Outcome.UNKNOWN_ID": "Outcome.BAD_DATA",
        "Outcome.BAD_DATA": "Outcome.UNKNOWN_ID",
    },
    "valid is 5": {"        0: Answer(": "        5: Answer("},
    "the names of two responses are exchanged": {
        '"TOO_MANY_DATA"': '"TOO_FEW_DATA"',
        '"TOO_FEW_DATA"': '"TOO_MANY_DATA"',
    },
    "Speed has two bytes": {
        "BitStruct, Byte,": "BitStruct, Byte, Int16ub,",
        SPEED: '"speed" / Ranged(Int16ub, 0, 255)',
    },
    "Speed ends at 254": {SPEED: '"speed" / Ranged(Byte, 0, 254)'},
    "Speed begins at 1": {SPEED: '"speed" / Ranged(Byte, 1, 255)'},
    "Speed is signed": {
        "BitStruct, Byte,": "BitStruct, Byte, Int8sb,",
        SPEED: '"speed" / Ranged(Int8sb, -128, 127)',
    },
    "Speed counts double": {SETS_SPEED: 'effect=Sets(speed=From("speed", factor=2))'},
    "Speed drives off": {SETS_SPEED: 'effect=Sets(speed=From("speed"), motion=Motion.FORWARD)'},
    "Speed stops": {SETS_SPEED: 'effect=Sets(speed=From("speed"), motion=Motion.STOPPED)'},
    "the IDs of the rotations are exchanged": {
        '6: "RotateRight"': '7: "RotateRight"',
        '7: "RotateLeft"': '6: "RotateLeft"',
    },
    "the rotations turn the other way": {
        "Motion.ROTATE_RIGHT": "Motion.ROTATE_LEFT",
        "Motion.ROTATE_LEFT": "Motion.ROTATE_RIGHT",
    },
    "a rotation resets steering": {
        "Sets(motion=Motion.ROTATE_LEFT)": "Sets(motion=Motion.ROTATE_LEFT, steering=0)"
    },
    "Forward drives backward": {"Motion.FORWARD": "Motion.BACKWARD"},
    "Forward resets steering": {
        "effect=Sets(motion=Motion.FORWARD)": "effect=Sets(motion=Motion.FORWARD, steering=0)"
    },
    "Backward sets a speed": {
        "effect=Sets(motion=Motion.BACKWARD)": "effect=Sets(motion=Motion.BACKWARD, speed=127)"
    },
    "the header's halves are exchanged": {ID: LENGTH, LENGTH: ID},
    "an unused ID is used": {
        "INSTRUCTIONS = {": 'INSTRUCTIONS = {12: "X" / Instruction(document=""),'
    },
    "it has a speed at power-on": {POWER: "POWER_ON = Sets(speed=127)"},
    "it steers at power-on": {POWER: "POWER_ON = Sets(steering=1)"},
    "the LED is lit at power-on": {POWER: "POWER_ON = Sets(led=7)"},
    "a frame may pause for half a second": {"truncation_timeout=50": "truncation_timeout=500"},
    "an answer may take a second": {"answer_deadline=100": "answer_deadline=1000"},
    "a stop may take a second": {"stop_longest=100": "stop_longest=1000"},
    "the line is slow": {"baud=115200": "baud=9600"},
}


def failing(protocol: Protocol, drive: Drive) -> Iterator[str]:
    """Every vector that the protocol contradicts."""
    facts = {
        "instructions": (
            [
                (s.id, s.name, s.document, s.length, s.fields[0].name if s.fields else "")
                for s in protocol.instructions
            ],
            list(HEADERS),
        ),
        "unused IDs": (protocol.unused_ids, UNUSED_IDS),
        "responses": ([(r.code, r.name, r.document) for r in protocol.responses], list(RESPONSES)),
        "timing": ({name: getattr(protocol.timing, name) for name in TIMING}, TIMING),
        "line": ({name: getattr(protocol.line, name) for name in LINE}, LINE),
        "power-on": (
            (*(getattr(protocol.power_on, name) for name in POWER_ON._fields),),
            POWER_ON,
        ),
        "colours": (
            {v: bit_names(protocol.by_name["LED"].fields[0], v) for v in COLOURS},
            COLOURS,
        ),
    }
    yield from (name for name, (ours, theirs) in facts.items() if ours != theirs)
    for vector in FRAMES:
        title = f"{vector.frame.hex(' ')} ({vector.clause})"
        if not _fits(protocol, vector.frame):
            yield title
            continue
        judgement = judge(protocol, vector.frame)
        name = judgement.instruction.name if judgement.instruction else None
        if (judgement.response.code, name, judgement.fields) != vector[1:4]:
            yield title
    for sequence in SEQUENCES:
        frames = [step.frame for step in sequence.steps]
        expected = [(step.code, step.state) for step in sequence.steps]
        if not all(_fits(protocol, frame) for frame in frames) or (
            drive(protocol, frames) != expected
        ):
            yield f"{sequence.title} ({sequence.clause})"


def _fits(protocol: Protocol, frame: bytes) -> bool:
    """Whether the bytes are at most one frame, which they are not for every header."""
    return len(frame) <= 1 + protocol.lengths[frame[0]]


def test_no_vector_fails_the_grammar(protocol: Protocol, drive: Drive) -> None:
    assert list(failing(protocol, drive)) == []


@pytest.mark.parametrize("title", MUTATIONS)
def test_some_vector_catches_the_mutation(grammar_text: str, drive: Drive, title: str) -> None:
    broken = load(mutated(grammar_text, MUTATIONS[title]))

    assert list(failing(broken, drive)) != []


# What shows in a table of facts only.
FACTS_ONLY = {
    "the names of two responses are exchanged",
    "the LED's bits are blue, green, red",
    "a frame may pause for half a second",
    "an answer may take a second",
    "a stop may take a second",
    "the line is slow",
}


@pytest.mark.parametrize("title", [t for t in MUTATIONS if t not in FACTS_ONLY])
def test_what_the_robot_answers_or_does_gives_the_mutation_away(
    grammar_text: str, drive: Drive, title: str
) -> None:
    """The tables of facts are not needed: bytes, answers and states alone show it."""
    broken = load(mutated(grammar_text, MUTATIONS[title]))

    assert any(found.endswith(")") for found in failing(broken, drive))


def test_a_mutation_that_finds_nothing_to_change_is_an_error(grammar_text: str) -> None:
    with pytest.raises(AssertionError, match="does not say"):
        mutated(grammar_text, {"no such words": "others"})


def test_two_changes_exchange_two_words() -> None:
    assert mutated("a b", {"a": "b", "b": "a"}) == "b a"
