"""Loading grammars: each gives one Protocol value, or one sentence that says what is wrong."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import re
from typing import Any

import pytest

from bilprov.spec.codec import all_data, bad_data, build, judge, nearest, raw_frame
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import GrammarError, Protocol, load
from tests.vectors import FRAMES, UNUSED_IDS


def replaced(text: str, *pairs: tuple[str, str]) -> str:
    """The grammar's text with each (old, new) put in once; every `old` must be there."""
    for old, new in pairs:
        assert old in text, f"the grammar does not say {old!r}"
        text = text.replace(old, new, 1)
    return text


def without_led(text: str) -> str:
    start, end = text.index('    8: "LED"'), text.index("}\n\nFRAME =")
    return text[:start] + text[end:]


# Facts that are read out of the grammar.


def test_a_field_tells_where_it_lies_and_what_it_allows(protocol: Protocol) -> None:
    (rgb,) = protocol.by_name["LED"].fields

    assert (rgb.offset, rgb.size, rgb.low, rgb.high, rgb.bits) == (0, 1, 0, 7, "RGB")
    assert rgb.parse(b"\x09") == 9
    assert rgb.build(9) == b"\x09"


def test_the_limits_of_the_state_come_from_fields_and_factors(protocol: Protocol) -> None:
    assert protocol.limits == {"speed": (0, 255), "steering": (-255, 255), "led": (0, 7)}


# A value among values.


def test_a_protocol_pickles_as_its_text(protocol: Protocol) -> None:
    for again in (pickle.loads(pickle.dumps(protocol)), copy.deepcopy(protocol)):
        assert again == protocol
        assert again.origin == protocol.origin
        assert [judge(again, v.frame).response.code for v in FRAMES] == [v.code for v in FRAMES]
    assert len(pickle.dumps(protocol)) < 2 * len(protocol.source.encode())


def test_two_protocols_are_equal_when_their_texts_are(protocol: Protocol, horn: Protocol) -> None:
    same = load(protocol.source, "another-name.py")

    assert same == protocol
    assert hash(same) == hash(protocol)
    assert same.sha256 == protocol.sha256
    assert horn != protocol
    assert horn.sha256 != protocol.sha256


def test_a_protocol_does_not_change(protocol: Protocol) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        protocol.name = "other"  # type: ignore[misc]


# Change the protocol in one place: instruction 9 "Horn", one byte 0 to 3.


def test_one_entry_more_is_one_instruction_more(horn: Protocol, protocol: Protocol) -> None:
    spec = horn.by_id[9]

    assert (spec.name, spec.document, spec.length) == ("Horn", "Tuta", 1)
    assert [(f.name, f.low, f.high) for f in spec.fields] == [("sound", 0, 3)]
    assert horn.unused_ids == UNUSED_IDS[1:]
    assert horn.instructions[:9] == protocol.instructions


def test_the_new_instruction_is_judged_and_its_id_is_no_longer_unused(horn: Protocol) -> None:
    codes = {value: judge(horn, bytes([0x91, value])).response.code for value in range(256)}

    assert [value for value, code in codes.items() if code == 0] == [0, 1, 2, 3]
    assert {code for value, code in codes.items() if value > 3} == {2}
    assert judge(horn, b"\x90").response.code == 4
    assert judge(horn, b"\x92\x00\x00").response.code == 3
    assert judge(horn, b"\x91").response.code == 4
    assert judge(horn, b"\xa0").response.code == 1
    assert judge(horn, b"\x91\x04").reason == (
        "Horn.sound is 4, allowed are 0 to 3 (frame 91 04, byte 1)"
    )


def test_the_new_instruction_is_built_described_and_enumerated(horn: Protocol) -> None:
    spec = horn.by_name["Horn"]

    assert build(horn, "horn", {"sound": 3}) == b"\x91\x03"
    assert judge(horn, b"\x91\x03").describe() == "Horn sound=3"
    assert list(all_data(spec)) == [bytes([value]) for value in range(4)]
    assert list(bad_data(spec)) == [bytes([value]) for value in range(4, 256)]
    assert nearest(horn, b"\x91\x09") == b"\x91\x03"
    assert spec.effect.apply(State(Motion.FORWARD, 9), {"sound": 1}) == State(Motion.FORWARD, 9)


# Other members of the family.


def test_a_grammar_without_the_led_leaves_its_id_unused(grammar_text: str) -> None:
    v1_0 = load(without_led(grammar_text))

    assert v1_0.unused_ids == (8, *UNUSED_IDS)
    assert judge(v1_0, b"\x81\x02").response.code == 1
    assert "led" not in v1_0.limits


def test_the_header_may_split_its_bits_otherwise(grammar_text: str) -> None:
    protocol = load(
        replaced(
            without_led(grammar_text),
            ('"id" / BitsInteger(4)', '"id" / BitsInteger(3)'),
            ('"length" / BitsInteger(4)', '"length" / BitsInteger(5)'),
        )
    )

    assert (protocol.ids, protocol.data_lengths) == (range(8), range(32))
    assert protocol.unused_ids == ()
    assert protocol.longest_frame == 32
    assert build(protocol, "Speed", {"speed": 5}) == bytes([0b001_00001, 5])
    assert judge(protocol, bytes([0b111_00000])).name == "RotateLeft"
    assert judge(protocol, bytes([0b001_11111]) + bytes(31)).outcome is Outcome.TOO_MANY
    assert raw_frame(protocol, 7, 31) == b"\xff"


def wide_speed(text: str, low: int, high: int) -> Protocol:
    """Speed has a 16-bit field, most significant byte first, and a byte behind it."""
    return load(
        replaced(
            text,
            ("BitStruct, Byte,", "BitStruct, Byte, Int16ub,"),
            (
                '"speed" / Ranged(Byte, 0, 255)',
                f'"speed" / Ranged(Int16ub, {low}, {high}) * "v", "ramp" / Ranged(Byte, 1, 9)',
            ),
        )
    )


def test_a_field_may_have_two_bytes_and_another_may_follow(grammar_text: str) -> None:
    protocol = wide_speed(grammar_text, 0, 1000)
    spec = protocol.by_name["Speed"]

    assert spec.length == 3
    assert [(f.name, f.offset, f.size) for f in spec.fields] == [("speed", 0, 2), ("ramp", 2, 1)]
    assert build(protocol, "Speed", {"speed": 1000, "ramp": 9}) == b"\x13\x03\xe8\x09"
    assert judge(protocol, b"\x13\x03\xe8\x09").fields == (("speed", 1000), ("ramp", 9))
    assert judge(protocol, b"\x13\x03\xe9\x09").reason == (
        "Speed.speed is 1001, allowed are 0 to 1000 (frame 13 03 e9 09, byte 1)"
    )
    assert judge(protocol, b"\x13\x00\x00\x00").reason == (
        "Speed.ramp is 0, allowed are 1 to 9 (frame 13 00 00 00, byte 3)"
    )
    assert judge(protocol, b"\x13\xff\xff\x00").reason == (  # the first fault is told
        "Speed.speed is 65535, allowed are 0 to 1000 (frame 13 ff ff 00, byte 1)"
    )
    assert judge(protocol, b"\x11\xff").outcome is Outcome.TOO_FEW
    assert protocol.limits["speed"] == (0, 1000)
    assert nearest(protocol, b"\x13\xff\xff\xff") == b"\x13\x03\xe8\x09"


def test_wide_data_are_sampled_to_both_ends_and_are_what_they_promise(grammar_text: str) -> None:
    protocol = wide_speed(grammar_text, 10, 1000)
    spec = protocol.by_name["Speed"]
    good, bad = set(all_data(spec, most=16)), set(bad_data(spec))

    assert {b"\x00\x0a\x01", b"\x03\xe8\x01", b"\x00\x0a\x09"} <= good
    assert {b"\x00\x00\x01", b"\xff\xff\x01"} <= bad
    assert len(good) <= 16 + 9
    for data, valid in ((good, True), (bad, False)):
        assert {judge(protocol, b"\x13" + d).valid for d in data} == {valid}
    assert {d for d in bad if d[2:] != b"\x01"} == {
        b"\x00\x0a" + bytes([ramp]) for ramp in range(256) if not 1 <= ramp <= 9
    }


# What cannot be used is said in one sentence.

TOO_LONG = ", ".join(f'"a{i}" / Ranged(Byte, 0, 255)' for i in range(16))
STRENGTH = '"strength" / Ranged(Byte, 0, 255) * "steering strength",\n        document="Höger"'

BROKEN: dict[str, tuple[Any, ...]] = {
    "no header": (
        ("HEADER = BitStruct(", "HEAD = BitStruct("),
        ('"header" / HEADER', '"header" / HEAD'),
        "it declares no HEADER",
    ),
    "header without id": (
        ('"id" / BitsInteger(4)', '"kind" / BitsInteger(4)'),
        "HEADER must have the parts id and length",
    ),
    "header of two bytes": (
        ('"id" / BitsInteger(4)', '"id" / BitsInteger(12)'),
        "HEADER is 2 bytes long; it must be one byte",
    ),
    "header that does not fill its byte": (
        ('"id" / BitsInteger(4)', '"id" / BitsInteger(5)'),
        "the parts of HEADER have 9 bits together; they must have 8",
    ),
    "instruction that is none": (
        ('8: "LED"', '10: "Lamp" / Byte,\n    8: "LED"'),
        'instruction 10 must be written "Name" / Instruction(...)',
    ),
    "field without range": (
        ('"strength" / Ranged(Byte, 0, 255)', '"strength" / Byte'),
        "Right.strength has no range: write Ranged(Byte, low, high)",
    ),
    "range the wrong way round": (
        ("Ranged(Byte, 0, 7,", "Ranged(Byte, 7, 0,"),
        "LED.rgb has the range 7 to 0, which holds nothing",
    ),
    "range that a byte cannot carry": (
        ("Ranged(Byte, 0, 255)", "Ranged(Byte, 0, 256)"),
        "Speed.speed cannot carry its range 0 to 256",
    ),
    "effect of an unknown field": (
        ('From("strength")', 'From("force")'),
        "an effect names the field force, which is not there",
    ),
    "fault that needs a field": (
        ("FAULTY = Sets(motion=Motion.STOPPED", 'FAULTY = Sets(motion=From("x")'),
        "an effect names the field x, which is not there",
    ),
    "effect that is not a number": (
        ("steering=0)", 'steering="left")'),
        "what an effect sets steering to is 'left', allowed is a whole number",
    ),
    "motion that is none": (
        ("motion=Motion.FORWARD", 'motion="sideways"'),
        "an effect sets motion to 'sideways', allowed is a Motion",
    ),
    "same name twice": (('5: "Left"', '5: "Right"'), "two instructions are named Right"),
    "same name in another case": (
        ('5: "Left"', '5: "RIGHT"'),
        "two instructions are named Right",
    ),
    "same field twice": (
        (STRENGTH, f'"strength" / Ranged(Byte, 0, 1), {STRENGTH}'),
        "Right has two fields named strength",
    ),
    "same id twice": (('5: "Left"', '4: "Left"'), "the number 4 stands twice in line"),
    "two responses for one outcome": (
        (
            '"TOO_FEW_DATA",\n            Outcome.TOO_FEW',
            '"TOO_FEW_DATA",\n            Outcome.TOO_MANY',
        ),
        "no response stands for too few data bytes",
    ),
    "id out of the header": (('8: "LED"', '16: "LED"'), "the header cannot carry the ID 16"),
    "negative id": (('8: "LED"', '-1: "LED"'), "the header cannot carry the ID -1"),
    "id that is not a number": (
        ('8: "LED"', '"8": "LED"'),
        "an ID in INSTRUCTIONS is '8', allowed is a whole number",
    ),
    "too long data": (
        (STRENGTH, f'{TOO_LONG}, document="Höger"'),
        ('From("strength")),', 'From("a0")),'),
        "Right has 16 data bytes; a header announces at most 15",
    ),
    "no stop": (
        ("effect=Sets(motion=Motion.STOPPED, steering=0),  #", "effect=Sets(steering=0),  #"),
        "no instruction without data stops the robot; the kit needs one to home",
    ),
    "missing response": (
        ("Outcome.TOO_FEW,", "Outcome.TOO_MANY,"),
        "no response stands for too few data bytes",
    ),
    "no timing": (("TIMING = Timing(", "TIMES = Timing("), "it declares no TIMING"),
    "timing of another kind": (
        ("TIMING = Timing(", "TIMING = dict("),
        "TIMING is a dict, not a Timing",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_grammar_that_cannot_be_used_is_refused_in_a_sentence(
    grammar_text: str, name: str
) -> None:
    *pairs, sentence = BROKEN[name]
    with pytest.raises(GrammarError) as raised:
        load(replaced(grammar_text, *pairs), "mine.py")

    message = str(raised.value)
    assert message.startswith("the grammar mine.py cannot be used: ")
    assert sentence in message
    assert "\n" not in message


def test_a_syntax_error_is_told_with_its_line(grammar_text: str) -> None:
    lines = grammar_text.splitlines()
    line = lines.index("INSTRUCTIONS = {") + 1
    lines[line - 1] = "INSTRUCTIONS = = {"
    with pytest.raises(GrammarError) as raised:
        load("\n".join(lines), "mine.py")

    assert str(raised.value) == (
        f"the grammar mine.py does not load: SyntaxError: invalid syntax, line {line}; "
        "start from a copy of spec/grammar.py"
    )


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            'steering=From("strength")',
            'steer=From("strength")',
            "TypeError: the motion state has no variable steer; "
            "it has motion, speed, steering, led",
        ),
        (
            "from bilprov.spec.motion",
            "from bilprov.spec.motor",
            "ModuleNotFoundError: No module named 'bilprov.spec.motor'",
        ),
        ("Motion.BACKWARD", "Motion.REVERSE", "AttributeError: .*REVERSE"),
        ("HEADER = BitStruct(", "HEAD = BitStruct(", "NameError: name 'HEADER' is not defined"),
        ('8: "LED"', '8: 1 / 0 or "LED"', "ZeroDivisionError: division by zero"),
    ],
)
def test_a_grammar_that_does_not_run_is_refused_in_a_sentence(
    grammar_text: str, old: str, new: str, sentence: str
) -> None:
    with pytest.raises(GrammarError) as raised:
        load(replaced(grammar_text, (old, new)), "mine.py")

    assert re.fullmatch(
        rf"the grammar mine\.py does not load: {sentence}; start from a copy of spec/grammar\.py",
        str(raised.value),
    )
