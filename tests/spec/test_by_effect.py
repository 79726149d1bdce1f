"""The search for the frames that bring a robot from one state to another."""

from __future__ import annotations

from bilprov.spec.by_effect import frames_to, movers, reached, setting
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol, load
from tests.support.car import car_state
from tests.support.grammars import still_grammar

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
