"""Mutations of the grammar: for each one a hand-typed vector fails.

Codec, simulator and generated cases would all follow a changed grammar and still agree with each
other, so only a hand-typed vector can fail.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator

from bilprov.spec.codec import field_words, judge
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import GrammarError, Protocol, load
from tests.support.grammars import mutated, undeclared
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
    RobotState,
)

# What a variable is set to where an effect leaves it as it is.
ADDED = {
    "motion": ('"stopped"', '"forward"'),
    "speed": ("0", "127"),
    "steering": ("0", "1"),
    "led": ("0", "7"),
}
RIGHT, LEFT = 'From("strength"))', 'From("strength", factor=-1)'
SPEED = '"speed" / Ranged(Byte, 0, 255)'
ID, LENGTH = '"id" / BitsInteger(4)', '"length" / BitsInteger(4)'

# What is no other number, name, order or effect.
OTHERS = {
    "the LED's bits are blue, green, red": {'bits="RGB"': 'bits="BGR"'},
    "the names of two responses are exchanged": {
        '"TOO_MANY_DATA"': '"TOO_FEW_DATA"',
        '"TOO_FEW_DATA"': '"TOO_MANY_DATA"',
    },
    "Right and Left both steer left": {RIGHT: f"{LEFT})"},
    "Speed is signed": {
        "BitStruct, Byte,": "BitStruct, Byte, Int8sb,",
        SPEED: '"speed" / Ranged(Int8sb, -128, 127)',
    },
    "the header's halves are exchanged": {ID: LENGTH, LENGTH: ID},
    "an unused ID is used": {
        "INSTRUCTIONS = {": 'INSTRUCTIONS = {12: "X" / Instruction(document=""),'
    },
}


def replacements(node: ast.AST) -> Iterator[str]:
    """What a number, a motion, an outcome, an order or an effect is mutated into."""
    match node:
        case ast.Constant(int(number)):
            yield from (str(number - 1), str(number + 1))
        case ast.Constant(str(word)) if word in set(Motion):
            yield from (f'"{other}"' for other in Motion if other != word)
        case ast.Attribute(ast.Name("Outcome"), name):
            yield from (f"Outcome.{other.name}" for other in Outcome if other.name != name)
        case ast.Dict(keys, values):
            for at in range(1, len(keys)):
                order = [*keys[: at - 1], keys[at], keys[at - 1], *keys[at + 1 :]]
                yield ast.unparse(ast.Dict(order, values))
        case ast.Call(ast.Name("Sets"), [], keywords):
            named = {word.arg: ast.unparse(word.value) for word in keywords if word.arg}
            for variable, values_added in ADDED.items():
                others = {name: value for name, value in named.items() if name != variable}
                added = [{variable: value} for value in values_added]
                for more in [{}] if variable in named else added:
                    words = (others | more).items()
                    yield f"Sets({', '.join(f'{name}={value}' for name, value in words)})"


def mutations(text: str) -> Iterator[tuple[str, str]]:
    """Each mutation's title, and the grammar's text with it."""
    raw = text.encode()
    starts = [0]
    for line in raw.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node in ast.walk(ast.parse(text)):
        for new in replacements(node):
            assert isinstance(node, ast.expr)
            assert node.end_lineno is not None
            assert node.end_col_offset is not None
            begin = starts[node.lineno - 1] + node.col_offset
            end = starts[node.end_lineno - 1] + node.end_col_offset
            broken = raw[:begin] + new.encode() + raw[end:]
            yield f"{new} in line {node.lineno}", broken.decode()
    yield from ((title, mutated(text, changes)) for title, changes in OTHERS.items())


def drive(protocol: Protocol, frames: Iterable[bytes]) -> list[tuple[int, RobotState]]:
    """The response code and the state after each frame, from power-on, of a robot of two rules.

    A valid frame does its effect, any other what a fault does.
    """
    state, seen = protocol.power_on, []
    for frame in frames:
        judgement = judge(protocol, frame)
        effect = protocol.on_fault
        if judgement.valid and judgement.instruction:
            effect = judgement.instruction.effect
        state = effect.apply(state, dict(judgement.fields))
        shown = str(state.motion), state.speed, state.steering, state.led, state.moving
        seen.append((judgement.response.code, RobotState(*shown)))
    return seen


def failing(protocol: Protocol) -> Iterator[str]:
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
        "power-on": ((*(getattr(protocol.power_on, name) for name in POWER_ON._fields),), POWER_ON),
        "colours": (
            [field_words(protocol.by_name["LED"].fields[0], value) for value in COLOURS],
            [f"rgb={value} ({' '.join(lit) or 'off'})" for value, lit in COLOURS.items()],
        ),
    }
    yield from (name for name, (ours, theirs) in facts.items() if ours != theirs)
    for vector in FRAMES:
        if not _fits(protocol, vector.frame):
            yield vector.clause
            continue
        judgement = judge(protocol, vector.frame)
        name = judgement.instruction.name if judgement.instruction else None
        if (judgement.response.code, name, judgement.fields) != vector[1:4]:
            yield vector.clause
    for sequence in SEQUENCES:
        frames = [step.frame for step in sequence.steps]
        expected = [(step.code, step.state) for step in sequence.steps]
        if not all(_fits(protocol, frame) for frame in frames) or (
            drive(protocol, frames) != expected
        ):
            yield sequence.title


def _fits(protocol: Protocol, frame: bytes) -> bool:
    """Whether the bytes are at most one frame, which they are not for every header."""
    return len(frame) <= 1 + protocol.lengths[frame[0]]


def test_no_vector_fails_the_grammar(protocol: Protocol) -> None:
    assert list(failing(protocol)) == []


def test_some_vector_catches_each_mutation(protocol: Protocol, grammar_text: str) -> None:
    survivors, loaded, whole = [], 0, undeclared(grammar_text)
    for title, text in mutations(whole):
        try:
            broken = load(text)
        except GrammarError:
            continue
        loaded += 1
        if not any(failing(broken)):
            survivors.append(title)

    at = 1 + whole[: whole.index("POWER_ON = ")].count("\n")
    without = [title for title in survivors if title.endswith(f" in line {at}")]
    assert survivors == without  # power-on names what a state is anyway
    assert len(without) == len(ADDED)
    assert loaded > 120
