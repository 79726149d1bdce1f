"""The state that a grammar declares: its words, what is refused, and what follows from it."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.spec.arrays.states import Known
from bilprov.spec.arrays.tables import request_tables
from bilprov.spec.by_effect import (
    all_movement,
    change_by,
    effect_words,
    frames_to,
    movement_of,
    movement_words,
    movers,
    reached,
    setting,
)
from bilprov.spec.codec import judge
from bilprov.spec.emit.c import c_header
from bilprov.spec.errors import WrongValue
from bilprov.spec.motion import Motion, visible_motion
from bilprov.spec.protocol import GrammarError, Protocol, load
from bilprov.spec.state import AllOf, AnyOf, Variables, Whole, state_class
from tests.support.car import car_state, wheels
from tests.support.grammars import RELAY as TEXT
from tests.support.grammars import embedded, mutated, still_grammar, undeclared
from tests.vectors import WHEELS, WheelVector

BOARD = load(TEXT, "switches.py")


def test_a_grammar_without_a_rest_has_no_stop() -> None:
    assert BOARD.device == "relay board"
    assert BOARD.at_rest is BOARD.wheels is BOARD.stop_or_none is None
    assert not BOARD.stops(BOARD.on_fault)
    assert not BOARD.power_on.moving
    with pytest.raises(GrammarError, match="stops the relay board"):
        BOARD.pad_byte  # noqa: B018
    assert "FILLER" not in c_header(BOARD)


def test_it_may_come_from_a_capture() -> None:
    assert embedded(TEXT) == BOARD


def test_a_text_that_does_not_declare_the_cars_state_has_it(
    protocol: Protocol, grammar_text: str
) -> None:
    older = load(undeclared(grammar_text))
    assert older.variables == protocol.variables
    assert older.state_type is protocol.state_type
    assert older.power_on == protocol.power_on
    assert (older.device, older.at_rest) == ("robot", protocol.at_rest)
    assert older.instructions == protocol.instructions


MODE = mutated(
    TEXT,
    {
        "Byte, Struct": "Byte, Enum, Struct",
        '7: "Store"': '8: "Fan" / Instruction("mode" / Enum(Byte, off=0, low=4, high=9), '
        'document="fan", effect=Sets(fan=From("mode"))) * "Sets the fan.",\n    7: "Store"',
    },
)


@pytest.mark.parametrize("kinds", [{"of": Whole(0, 1)}, {"a": 1}, {"_a": Whole(0, 1)}])
def test_a_variable_must_have_a_name_and_a_kind(kinds: dict[str, Any]) -> None:
    with pytest.raises(WrongValue):
        Variables(**kinds)


def test_rest_is_any_or_all_of_the_values() -> None:
    specs = tuple(Variables(a=Whole(-9, 9), b=Whole(-9, 9)).specs.values())
    for condition, moving in ((AnyOf(a=0, b=0), False), (AllOf(a=0, b=0), True)):
        state = state_class(specs, condition).of({"a": 0, "b": 3})
        assert state.moving is moving
        assert state.but(a=1).moving
        assert not state.but(b=0).moving
        assert pickle.loads(pickle.dumps(state)) == state
    assert AllOf(a=0, b=0).follows({"a": 0, "b": 0})
    assert not AllOf(a=0, b=0).follows({"a": 0})
    assert AnyOf(a=0, b=0).follows({"a": 0})


PLAIN = {"on=Changed(-1, 1)": "on=1", "level=Changed(1, 1)": "level=3"}  # by no old value
LONG = PLAIN | {'Instruction(document="up"': 'Instruction("by" / Byte, "at" / Byte, document="up"'}


@pytest.mark.parametrize("changes", [PLAIN, LONG])
@given(data=st.lists(st.sampled_from([b"\x20", b"\x30", b"\x40", b"\x50", b"\x60", b"\x11\x05"])))
def test_columns_have_what_the_effects_make_one_by_one(
    changes: dict[str, str], data: list[bytes]
) -> None:
    board = load(mutated(TEXT, changes), "switches.py")
    frames = [*data, *(bytes([0x52, at, 1]) for at in range(3) if changes is LONG)]
    array = np.frombuffer(b"".join(frames), np.uint8)
    tables, state = request_tables(board), board.power_on
    requests, known = tables.cut(array, 0).whole, Known(board.power_on, None)
    expected = []
    for frame in frames:
        judged = judge(board, frame)
        effect = judged.instruction.effect if judged.instruction else None
        state = (effect if judged.valid and effect else board.on_fault).apply(
            state, dict(judged.fields)
        )
        expected.append(state.codes)
    columns = [
        tables.states.column(name, array, requests, known)[1:].tolist() for name in board.variables
    ]
    assert list(zip(*columns, strict=True)) == expected
    assert tables.states.last(array, requests, known).state.codes == state.codes


def test_all_that_a_grammar_may_change_is_told_in_words() -> None:
    assert effect_words(BOARD) == (
        "it may set relays to 0..15, set fan to high or off or low, set on to 0..1, "
        "set level to -5..5, write flash"
    )


@pytest.mark.parametrize(("changes", "known"), [("", False), (', changes=""', True)])
def test_a_grammar_that_says_of_nothing_what_it_changes_is_not_known_to_change_nothing(
    changes: str, known: bool
) -> None:
    text = f"""
from construct import Byte, Const, Struct, Switch, this
from bilprov.spec.grammars.modbus_rtu import CLAUSES, LINE, TIMING
from bilprov.spec.fields import Data, Instruction, Outcome
NAME, VERSION, DOCUMENT = "crane", "1", "a page"
INSTRUCTIONS = {{1: "Lift" / Instruction(document="lift"{changes}) * "Lifts."}}
FRAME = Struct("sync" / Const(b"U"), "id" / Byte, "data" / Switch(this.id, INSTRUCTIONS))
REPLY = Struct("sync" / Const(b"U"), "data" / Data())
SILENT = (Outcome.UNKNOWN_ID, Outcome.TOO_FEW)
"""
    crane = load(text)
    told = effect_words(crane, [b"U\x01"])
    assert bool(told) is bool(change_by(crane, b"U\x01")) is not known
    assert told in ("", effect_words(crane))


def test_a_word_is_set_from_the_names_of_an_enum() -> None:
    board = load(MODE)
    state, words = board.power_on, []
    for mode in (9, 0, 4):
        judged = judge(board, bytes([0x81, mode]))
        assert judged.instruction
        state = judged.instruction.effect.apply(state, dict(judged.fields))
        words.append(state.fan)
    assert words == ["high", "off", "low"]
    assert effect_words(board, [b"\x81\x09"]) == "it may set fan to high"
    assert "set fan to high or off or low" in effect_words(board)


def test_a_device_is_brought_to_rest_by_the_name_of_an_enum() -> None:
    changes = {
        "HEADER =": 'AT_REST = AllOf(fan="off")\nHEADER =',
        "    Answers,\n": "    AllOf,\n    Answers,\n",
        '3: "Off"': '9: "High2"',
        'Sets(fan="off")': 'Sets(fan="high")',
    }
    assert load(mutated(MODE, changes)).rest_requests == (("Fan", {"mode": 0}),)


# -- the motion model: effects, wheels, and how far a run moves ------------------------------------

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
