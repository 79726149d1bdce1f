"""What the tests share: the grammar's text and its Protocol, a copy with a Horn, a tiny robot."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from hypothesis import settings

from spec.codec import judge
from spec.protocol import Protocol, load
from tests.vectors import RobotState

ROOT = Path(__file__).resolve().parent.parent

Drive = Callable[[Protocol, Iterable[bytes]], list[tuple[int, RobotState]]]

# No test asserts a wall-clock time.
settings.register_profile("house", deadline=None, max_examples=60)
settings.load_profile("house")

HORN = """\
    9: "Horn"
    / Instruction(
        "sound" / Ranged(Byte, 0, 3) * "which of the four sounds, 0 is silence",
        document="Tuta",
    )
    * "Sounds the horn.",
"""


@pytest.fixture(scope="session")
def grammar_text() -> str:
    """The text of the kit's own grammar."""
    return (ROOT / "spec" / "grammar.py").read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def protocol(grammar_text: str) -> Protocol:
    return load(grammar_text, "grammar.py")


@pytest.fixture(scope="session")
def horn_text(grammar_text: str) -> str:
    """A copy of the grammar with one literal entry more: instruction 9 "Horn", one byte 0 to 3."""
    end = "}\n\nFRAME ="
    assert grammar_text.count(end) == 1
    return grammar_text.replace(end, HORN + end)


@pytest.fixture(scope="session")
def horn(horn_text: str) -> Protocol:
    return load(horn_text, "horn.py")


@pytest.fixture(scope="session")
def drive() -> Drive:
    """A robot of two rules: a valid frame does its effect, any other what a fault does.

    Gives the response code and the state after each frame, from power-on.
    """

    def driven(protocol: Protocol, frames: Iterable[bytes]) -> list[tuple[int, RobotState]]:
        state, seen = protocol.power_on, []
        for frame in frames:
            judgement = judge(protocol, frame)
            if judgement.valid and judgement.instruction:
                state = judgement.instruction.effect.apply(state, dict(judgement.fields))
            else:
                state = protocol.on_fault.apply(state)
            shown = RobotState(
                str(state.motion), state.speed, state.steering, state.led, state.moving
            )
            seen.append((judgement.response.code, shown))
        return seen

    return driven
