"""What frames make a robot do, in kinds of motion and the greatest speed."""

from __future__ import annotations

import pytest

from bilprov.spec.by_effect import Movement, all_movement, movement_of, movement_words
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol, load


@pytest.mark.parametrize(
    ("frames", "motions", "speed", "words"),
    [
        ("", "", None, "it is sent no motion; its wheels"),
        ("81 02,41 05", "", None, "it is sent no motion; its wheels"),
        ("20", "forward", None, "it drives, at the speed that it has"),
        ("11 50,20", "forward", 80, "it drives, at speeds up to 80 of 255"),
        ("11 50,20,11 ff,60", "forward rotate_right", 255, "it drives and turns, at speeds up to"),
        ("11 50,11 09", "", 80, "it is sent no motion, only speeds up to 80 of 255"),
        ("12 50 50,10,90,00", "", None, "it is sent no motion; its wheels"),
    ],
)
def test_frames_are_summed_up(
    protocol: Protocol, frames: str, motions: str, speed: int | None, words: str
) -> None:
    found = movement_of(protocol, (bytes.fromhex(one) for one in frames.split(",") if one))

    assert found == Movement(frozenset(map(Motion, motions.split())), speed)
    said = movement_words(protocol, found)
    assert said.startswith(words)
    assert said.endswith("; its wheels should be off the ground")


def test_all_that_a_protocol_can_do_ends_the_sum(protocol: Protocol) -> None:
    def frames() -> object:
        yield from (bytes([spec]) for spec in (0x20, 0x30, 0x60, 0x70))
        yield b"\x11\xff"
        raise AssertionError("more was taken")

    assert movement_of(protocol, frames()) == all_movement(protocol)  # type: ignore[arg-type]


def test_a_grammar_without_a_speed_says_nothing_of_it(grammar_text: str) -> None:
    begin = grammar_text.index('"Speed"')
    begin = grammar_text.rindex("\n", 0, begin) + 1
    lines = grammar_text[begin:].splitlines(keepends=True)
    entry = next(n for n, line in enumerate(lines[1:], 1) if line.strip()[:1].isdigit())
    protocol = load(grammar_text[:begin] + "".join(lines[entry:]))

    assert movement_words(protocol, all_movement(protocol)).startswith("it drives and turns; its")
