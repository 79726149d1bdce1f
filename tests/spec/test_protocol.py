"""Loading grammars: each gives one Protocol value, or one sentence that says what is wrong."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.codec import all_data, bad_data, build, judge
from bilprov.spec.protocol import Protocol, load
from tests.support.grammars import mutated, undeclared
from tests.vectors import FRAMES


def test_a_protocol_pickles_as_its_text(protocol: Protocol) -> None:
    for again in (pickle.loads(pickle.dumps(protocol)), copy.deepcopy(protocol)):
        assert again == protocol
        assert again.origin == protocol.origin
        assert [judge(again, v.frame).response.code for v in FRAMES] == [v.code for v in FRAMES]
    assert len(pickle.dumps(protocol)) < 2 * len(protocol.source.encode())


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
