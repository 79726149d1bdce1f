"""The motion model: effects, wheels, and how far a run moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bilprov.spec.by_effect import (
    Movement,
    all_movement,
    frames_to,
    movement_of,
    movement_words,
    movers,
    reached,
    setting,
)
from bilprov.spec.motion import Motion, visible_motion
from bilprov.spec.protocol import Protocol, load
from tests.support.car import car_state, wheels
from tests.support.grammars import still_grammar
from tests.vectors import WHEELS, WheelVector

if TYPE_CHECKING:
    pass


@pytest.mark.parametrize("motion", Motion)
@pytest.mark.parametrize("speed", [0, 1])
def test_only_a_direction_with_a_speed_moves_and_is_seen(motion: Motion, speed: int) -> None:
    state = car_state(motion, speed)
    moves = speed > 0 and motion != Motion.STOPPED

    assert state.moving == moves
    assert visible_motion(state) == (motion if moves else Motion.STOPPED)
    assert (wheels(state, 255) != (0, 0)) == moves


def _sign(value: int) -> int:
    return (value > 0) - (value < 0)


@pytest.mark.parametrize("speed", [2, 200, 255])
@pytest.mark.parametrize("vector", WHEELS, ids=str)
def test_the_wheels_turn_as_the_motion_and_the_steering_say(
    vector: WheelVector, speed: int
) -> None:
    state = car_state(Motion(vector.motion), speed, vector.steering)
    left, right = wheels(state, 255)

    assert (_sign(left), _sign(right)) == (vector.left, vector.right)
    faster = "left" if abs(left) > abs(right) else "right" if abs(right) > abs(left) else ""
    assert faster == vector.faster


@pytest.mark.parametrize("motion", [Motion.FORWARD, Motion.BACKWARD])
@pytest.mark.parametrize(("steering", "inner"), [(255, 1), (-255, 0)])
def test_at_full_steering_the_inner_wheel_stands_still(
    motion: Motion, steering: int, inner: int
) -> None:
    turned = wheels(car_state(motion, 200, steering), 255)

    assert turned[inner] == 0
    assert abs(turned[1 - inner]) == 200


def test_a_robot_that_cannot_steer_drives_straight_on() -> None:
    assert wheels(car_state(Motion.FORWARD, 9), 0) == (9, 9)


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


BOTH = """\
    9: "Both"
    / Instruction(
        "pace" / Ranged(Byte, 0, 255) * "speed",
        "turn" / Ranged(Byte, 0, 255) * "strength",
        document="",
        effect=Sets(speed=From("pace"), steering=From("turn")),
    )
    * "Sets two variables.",
    10: "Drive"
    / Instruction(
        "pace" / Ranged(Byte, 0, 255) * "speed",
        document="",
        effect=Sets(motion="forward", speed=From("pace")),
    )
    * "Drives at a speed.",
"""


def joint(text: str) -> Protocol:
    """Stop, an instruction that sets two variables, and a motion with data."""
    begin, end = text.index('    1: "Speed"'), text.index("}\n\nFRAME =")
    return load(text[:begin] + BOTH + text[end:])


def test_the_cars_preamble_is_speed_led_motion_steering(protocol: Protocol) -> None:
    state = car_state(Motion.FORWARD, 80, -5, 3)
    frames = [frame.hex() for frame in frames_to(protocol, state)]
    assert frames == ["1150", "8103", "20", "5105"]
    turning = car_state(Motion.ROTATE_LEFT, 80, 5, 3)
    assert [f.hex() for f in frames_to(protocol, turning)] == ["1150", "8103", "4105", "70"]


def test_what_is_known_is_not_sent_again(protocol: Protocol) -> None:
    known, state = car_state(speed=80, led=3), car_state(Motion.FORWARD, 80, 9, 3)
    assert [frame.hex() for frame in frames_to(protocol, state, known)] == ["20", "4109"]


def test_a_setting_keeps_what_its_instruction_sets_besides(grammar_text: str) -> None:
    protocol = joint(grammar_text)
    beside = car_state(Motion.FORWARD, 80, 5)
    assert setting(protocol, "steering", 9, beside).hex() == "925009"
    assert setting(protocol, "speed", 7, beside).hex() == "920705"


def test_a_motion_with_data_is_a_mover_where_there_is_no_other(grammar_text: str) -> None:
    protocol = joint(grammar_text)
    state = car_state(Motion.FORWARD, 80, 5)
    assert [spec.name for spec in movers(protocol)] == ["Drive"]
    assert reached(protocol, state) == state


def test_a_state_that_nothing_leads_to_is_reached_as_far_as_it_can_be(grammar_text: str) -> None:
    protocol = load(still_grammar(grammar_text))
    assert reached(protocol, car_state(Motion.FORWARD, 80, 5, 3)) == car_state(speed=80)
