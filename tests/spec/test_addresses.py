"""A request to an address that the grammar does not allow: never built, and meant for nobody."""

from __future__ import annotations

import json

import pytest

from bilprov.analyzer.decode.decoded_share import near_miss
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.codec import build, judge
from bilprov.spec.explain import explain
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.commands import command

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
