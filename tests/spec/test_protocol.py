"""Loading grammars: each gives one Protocol value, or one sentence that says what is wrong."""

from __future__ import annotations

import copy
import json
import pickle
from typing import Any

import pytest

from bilprov.analyzer.decode.decoded_share import near_miss
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.codec import all_data, bad_data, build, judge, nearest, raw_frame
from bilprov.spec.explain import explain
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT
from tests.support.car import car_state
from tests.support.commands import command
from tests.support.grammars import mutated, undeclared
from tests.vectors import FRAMES, UNUSED_IDS


def without_led(text: str) -> str:
    start, end = text.index('    8: "LED"'), text.index("}\n\nFRAME =")
    return text[:start] + text[end:]


# A value among values.


def test_a_protocol_pickles_as_its_text(protocol: Protocol) -> None:
    for again in (pickle.loads(pickle.dumps(protocol)), copy.deepcopy(protocol)):
        assert again == protocol
        assert again.origin == protocol.origin
        assert [judge(again, v.frame).response.code for v in FRAMES] == [v.code for v in FRAMES]
    assert len(pickle.dumps(protocol)) < 2 * len(protocol.source.encode())


# Change the protocol in one place: instruction 9 "Horn", one byte 0 to 3.


def test_one_entry_more_is_one_instruction_more(horn: Protocol, protocol: Protocol) -> None:
    spec = horn.by_id[9]

    assert (spec.name, spec.document, spec.length) == ("Horn", "Tuta", 1)
    assert horn.unused_ids == UNUSED_IDS[1:]
    assert horn.instructions[:9] == protocol.instructions
    assert list(all_data(spec)) == [bytes([value]) for value in range(4)]
    assert list(bad_data(spec)) == [bytes([value]) for value in range(4, 256)]
    assert build(horn, "horn", {"sound": 3}) == b"\x91\x03"
    assert nearest(horn, b"\x91\x09") == b"\x91\x03"
    assert spec.effect.apply(car_state(Motion.FORWARD, 9), {"sound": 1}) == car_state(
        Motion.FORWARD, 9
    )


# Other members of the family.


def test_a_grammar_without_the_led_leaves_its_id_unused(grammar_text: str) -> None:
    v1_0 = load(without_led(grammar_text))

    assert v1_0.unused_ids == (8, *UNUSED_IDS)
    assert judge(v1_0, b"\x81\x02").response.code == 1
    assert "led" not in v1_0.limits


def test_the_header_may_split_its_bits_otherwise(grammar_text: str) -> None:
    protocol = load(
        mutated(
            without_led(grammar_text),
            {
                '"id" / BitsInteger(4)': '"id" / BitsInteger(3)',
                '"length" / BitsInteger(4)': '"length" / BitsInteger(5)',
            },
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
    two = f'"speed" / Ranged(Int16ub, {low}, {high}) * "v", "ramp" / Ranged(Byte, 1, 9)'
    changes = {
        "BitStruct, Byte,": "BitStruct, Byte, Int16ub,",
        '"speed" / Ranged(Byte, 0, 255)': two,
    }
    return load(mutated(undeclared(text), changes))


def test_wide_data_are_sampled_to_both_ends_and_are_what_they_promise(grammar_text: str) -> None:
    protocol = wide_speed(grammar_text, 10, 1000)
    spec = protocol.by_name["Speed"]
    good, bad = set(all_data(spec)), set(bad_data(spec))

    assert {b"\x00\x0a\x01", b"\x03\xe8\x01", b"\x00\x0a\x09"} <= good
    assert {b"\x00\x00\x01", b"\xff\xff\x01"} <= bad
    assert len(good) <= 256 + 9
    for data, valid in ((good, True), (bad, False)):
        assert {judge(protocol, b"\x13" + d).valid for d in data} == {valid}
    assert {d for d in bad if d[2:] != b"\x01"} == {
        b"\x00\x0a" + bytes([ramp]) for ramp in range(256) if not 1 <= ramp <= 9
    }


# --------------------------------------------------------------------------------------------------


GRAMMAR = str(ROOT / "examples" / "relay_board.py")
TO_NINE = bytes.fromhex("5556000000 09 01 B5")
TO_ONE = bytes.fromhex("5556000000 01 01 AD")


@pytest.fixture(name="relay")
def _relay() -> Protocol:
    return load_protocol(GRAMMAR)


@pytest.mark.parametrize("words", [("encode",), ("send", "sim")])
def test_a_request_to_an_address_out_of_range_is_refused(words: tuple[str, ...]) -> None:
    sent = ("On", "address=5") if words == ("encode",) else ("On address=5",)

    result = command(*words, *sent, "--grammar", GRAMMAR)

    assert (result.returncode, result.stdout) == (2, b"")
    assert b"address is 5, allowed are 1 to 4" in result.stderr
    assert result.stderr.count(b"\n") == 1


def test_all_are_an_address_too() -> None:
    modbus = load_protocol("modbus-rtu")
    values = {"register": 1, "value": 3}

    assert build(modbus, "WriteSingleRegister", {**values, "address": 0})[0] == 0
    with pytest.raises(ValueError, match="address is 248, allowed are 1 to 247, and 0 for all"):
        build(modbus, "WriteSingleRegister", {**values, "address": 248})


@pytest.mark.parametrize(
    ("name", "values", "cells", "due"),
    [
        ("WriteMultipleRegisters", {"quantity": 3, "values": [4]}, "values", "3, not 1"),
        ("WriteMultipleCoils", {"quantity": 9, "coils": "01"}, "coils", "2, not 1"),
    ],
)
def test_a_count_that_is_not_that_of_its_values_is_refused(
    name: str, values: dict[str, Any], cells: str, due: str
) -> None:
    modbus, asked = load_protocol("modbus-rtu"), {"address": 1, "start": 0, **values}
    with pytest.raises(ValueError, match=f"so the length of {cells} must be {due}"):
        build(modbus, name, asked)
    assert judge(modbus, build(modbus, name, {**asked, "quantity": 1})).valid


def test_one_number_in_place_of_bytes_is_refused() -> None:
    coils = {"address": 1, "start": 0, "quantity": 40, "coils": 5}
    with pytest.raises(ValueError, match="coils is 5, allowed are bytes in hex"):
        build(load_protocol("modbus-rtu"), "WriteMultipleCoils", coils)


def test_nobody_is_meant_by_such_a_request(relay: Protocol) -> None:
    judgement = judge(relay, TO_NINE)
    told = explain(relay, TO_NINE).frames[0]
    near = near_miss(relay, TO_NINE)

    assert (judgement.outcome, judgement.answer_due) == (Outcome.OTHER_ADDRESS, False)
    assert judgement.describe() == "@9 On, other address"
    assert judgement.reason == "address is 9, allowed are 1 to 4: it is for no device"
    assert (told.action, told.changes) == ("is not meant, and does nothing", ())
    assert [group.meaning for group in told.groups if group.fault] == [
        "which relay; allowed are 1 to 4"
    ]
    assert near is not None
    assert (near.name, near.obstacle) == ("On", "address")


def test_json_lines_say_that_a_right_request_is_valid() -> None:
    sent = (TO_ONE + TO_NINE).hex()
    result = command("decode", sent, "--grammar", GRAMMAR, "--format", "jsonl")
    rows = [json.loads(line) for line in result.stdout.splitlines()]

    assert [row["judgement"] for row in rows] == ["valid", "no answer"]
    assert [row["outcome"] for row in rows] == ["valid", "other-address"]
