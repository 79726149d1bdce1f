"""The kit's grammars against hand-typed vectors: by construct alone, and as the kit reads them."""

from __future__ import annotations

import ast
import copy
import io
import pickle
import runpy
from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import Any

import pytest
from construct import (
    ChecksumError,
    ConstError,
    Construct,
    ConstructError,
    Container,
    EnumInteger,
    ListContainer,
    StreamError,
    ValidationError,
)
from msgspec.structs import astuple

from benchmarks.construct_alone import question
from bilprov.analyzer.grammar_file import SHIPPED, load_protocol
from bilprov.spec.codec import Judgement, all_data, bad_data, build, judge
from bilprov.spec.data import DataSpec
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.replies import agrees, read_reply, reply_size
from bilprov.spec.safe_grammar import require_declarations
from tests import vectors_dynamixel1, vectors_modbus_rtu, vectors_stk500v1
from tests.frame_vectors import ReplyVector, RequestVector
from tests.support import ROOT
from tests.support.framed_traffic import FRAMED
from tests.support.grammars import mutated, undeclared
from tests.vectors import FRAMES

VECTORS: dict[str, ModuleType] = {
    "modbus-rtu": vectors_modbus_rtu,
    "stk500v1": vectors_stk500v1,
    "dynamixel1": vectors_dynamixel1,
}
REQUESTS = [(name, one) for name, module in VECTORS.items() for one in module.REQUESTS]
REPLIES = [(name, one) for name, module in VECTORS.items() for one in module.REPLIES]
RAISES = {
    "truncated": StreamError,
    "too-few": StreamError,
    "bad-checksum": ChecksumError,
    "bad-sync": ConstError,
    "bad-data": ValidationError,
}
"""What construct alone raises for a faulty request; it takes those of other outcomes."""
PLACES = {
    "modbus-rtu": {"address": 0, "id": 1},
    "stk500v1": {"id": 0},
    "dynamixel1": {"address": 2, "id": 4},
}
"""Where a request has the parts that its answer may repeat."""
MOST_LINES = 150  # of declarations


def identity(value: object) -> str:
    """The name of a test: the grammar's, or the bytes."""
    if isinstance(value, RequestVector | ReplyVector):
        return value.frame.hex()[:32]
    return str(value)


def declared(name: str) -> dict[str, Any]:
    """The declarations of a grammar, run as Python."""
    return runpy.run_path(str(ROOT / "spec" / SHIPPED[name]))


def parsed(frame: Construct, raw: bytes, **context: Any) -> dict[str, Any]:
    """The values that construct alone parses from all of the bytes."""
    stream = io.BytesIO(raw)
    values = dict(flat(frame.parse_stream(stream, **context)))
    assert stream.read() == b""
    return values


def flat(container: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """The values inside each other by name."""
    for name, value in container.items():
        if isinstance(value, dict):
            yield from flat(value)
        elif not name.startswith("_"):
            yield name, list(value) if isinstance(value, ListContainer) else value


def asked(name: str, frame: Construct, request: bytes) -> Container:
    """The request of an answer; of a faulty one only the parts that an answer repeats."""
    try:
        return question(frame, request)
    except ConstructError:
        parts = {part: request[at] for part, at in PLACES[name].items()}
        return Container(parts, _answer=None)


def by_name(data: DataSpec, values: Mapping[str, Any]) -> dict[str, Any]:
    """The kit's values as the vectors have them: a list, and the name of a value that has one."""
    names = {part.name: {number: word for word, number in part.names} for part in data.fields}
    plain = {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}
    return {
        name: value if isinstance(value, list | bytes) else names[name].get(value, value)
        for name, value in plain.items()
    }


def numbers(data: DataSpec, fields: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a vector as numbers where they have a name."""
    names = {part.name: dict(part.names) for part in data.fields}
    return {
        name: names[name].get(value, value) if isinstance(value, str) else value
        for name, value in fields.items()
    }


@pytest.mark.parametrize("name", list(VECTORS))
def test_each_instruction_and_outcome_is_in_a_vector(name: str) -> None:
    module, protocol = VECTORS[name], load_protocol(name)
    outcomes = {one.outcome for one in module.REQUESTS}

    assert len(module.REQUESTS) + len(module.REPLIES) >= 25
    assert {one.name for one in module.REQUESTS if one.outcome == "valid"} == {*protocol.by_name}
    assert {"valid", "unknown-id", "truncated"} <= outcomes
    assert ("bad-checksum" in outcomes) is (protocol.layout.check is not None)


# Baud, parity, stop bits, and the times (ms) in the order of Timing.
LINES = {
    "modbus-rtu": (19_200, "E", 1, 50, 1.75, 1000, 1000, 5000, 1000),
    "stk500v1": (115_200, "N", 1, 1000, 500, 2000, 500, 5000, 1000),
    "dynamixel1": (1_000_000, "N", 1, 100, 5, 1000, 50, 1000, 1000),
}


@pytest.mark.parametrize("name", LINES)
def test_the_line_and_its_times_are_as_typed_by_hand(name: str) -> None:
    protocol = load_protocol(name)

    assert astuple(protocol.line) + astuple(protocol.timing) == LINES[name]


@pytest.mark.parametrize(
    ("file", "most"),
    [
        *((f"spec/{SHIPPED[name]}", MOST_LINES) for name in VECTORS),
        ("examples/relay_board.py", 100),
        ("examples/roboclaw.py", 100),
    ],
)
def test_a_grammar_is_a_page_of_declarations(file: str, most: int) -> None:
    text = (ROOT / file).read_text(encoding="utf-8")
    tree = ast.parse(text)
    body = [node for node in tree.body if not isinstance(node, ast.ImportFrom | ast.Expr)]

    require_declarations(text)
    assert ast.get_docstring(tree)
    assert sum((one.end_lineno or 0) - one.lineno + 1 for one in body) <= most


@pytest.mark.parametrize(("name", "vector"), REQUESTS, ids=identity)
def test_construct_alone_parses_a_request(name: str, vector: RequestVector) -> None:
    grammar = declared(name)
    frame, instructions = grammar["FRAME"], grammar["INSTRUCTIONS"]

    try:
        values = dict(flat(frame.parse(vector.frame)))
    except RAISES.get(vector.outcome, ()):
        return
    if vector.outcome == "bad-data":  # an Enum takes a value without a name as a number
        assert EnumInteger in map(type, values.values())
        return
    assert vector.outcome not in RAISES
    assert (
        instructions[values["id"]].name == vector.name
        if vector.name
        else (values["id"] not in instructions)
    )
    if vector.outcome == "valid":
        whole = parsed(frame, vector.frame)
        assert {key: whole[key] for key in vector.fields} == vector.fields
        assert whole.get("address" if vector.address is not None else "") == vector.address


@pytest.mark.parametrize(("name", "vector"), REQUESTS, ids=identity)
def test_the_kit_judges_a_request_and_builds_a_valid_one(name: str, vector: RequestVector) -> None:
    protocol = load_protocol(name)
    judged = judge(protocol, vector.frame)
    outcome = judged.outcome.name.lower().replace("_", "-")

    assert ("truncated" if judged.truncated else outcome) == vector.outcome
    if vector.name:
        assert judged.name == vector.name
    if vector.outcome == "valid":
        assert judged.instruction
        assert by_name(judged.instruction, dict(judged.fields)) == vector.fields
        assert judged.address == vector.address
        fields = numbers(judged.instruction, vector.fields)
        to = {} if vector.address is None else {"address": vector.address}
        assert build(protocol, str(vector.name), {**fields, **to}) == vector.frame


@pytest.mark.parametrize(("name", "vector"), REPLIES, ids=identity)
def test_construct_alone_parses_an_answer(name: str, vector: ReplyVector) -> None:
    grammar = declared(name)
    request = asked(name, grammar["FRAME"], vector.request)
    laid_out = [grammar["REPLY"], grammar["ERROR"]]
    values: dict[str, Any] | None = None
    for one in laid_out:
        try:
            values = values or parsed(one, vector.frame, asked=request)
        except ConstructError:
            continue

    assert values is not None
    assert {key: values[key] for key in vector.fields} == vector.fields
    assert sorted(values.get("code", "").split()) == sorted(vector.code.split())


@pytest.mark.parametrize(("name", "vector"), REPLIES, ids=identity)
def test_the_kit_reads_an_answer(name: str, vector: ReplyVector) -> None:
    protocol = load_protocol(name)
    request = judge(protocol, vector.request)
    begun = [reply_size(protocol, vector.frame[:n], request) for n in range(len(vector.frame))]
    reply = read_reply(protocol, vector.frame, request)
    answer = request.instruction.answer if request.instruction else None

    assert all(size is None or size == len(vector.frame) for size in begun)
    assert reply_size(protocol, vector.frame, request) == len(vector.frame)
    assert (reply.reason, reply.response is None) == ("", False)
    assert by_name(answer or DataSpec(), dict(reply.fields)) == vector.fields
    assert sorted(reply.names) == sorted(vector.code.split())
    assert agrees(protocol, request, reply)


def test_a_wrong_answer_does_not_agree() -> None:
    protocol = load_protocol("modbus-rtu")
    request: Judgement = judge(protocol, bytes.fromhex("11 05 0028 0001 8E92"))

    echo = read_reply(protocol, bytes.fromhex("11 05 0028 0001 8E92"), request)
    refused = read_reply(protocol, bytes.fromhex("11 85 01 82 95"), request)

    assert not agrees(protocol, request, echo)
    assert not agrees(protocol, request, refused)


def test_a_refusal_without_data_has_no_fields() -> None:
    text = FRAMED["dynamixel1"].replace('"values" / Bytes(asked.size)', '"values" / GreedyBytes')
    protocol = load(text)
    asked = judge(protocol, build(protocol, "Read", {"address": 1, "register": 30, "size": 2}))
    refused = read_reply(protocol, bytes.fromhex("ff ff 01 02 40 bc"), asked)
    assert refused.describe() == "@1 INSTRUCTION"
    assert refused.fields == ()
    empty = read_reply(protocol, bytes.fromhex("ff ff 01 02 00 fc"), asked)
    assert empty.fields == (("values", b""),)


# -- the grammars in examples/ ---------------------------------------------------------------------


RELAY, ROBOCLAW = "relay_board", "roboclaw"
# Instruction, its values, the request, its answer, the answer's fields.
EXCHANGES = [
    (RELAY, "Read", {"address": 1}, "5556000000 01 00 AC", "333C000000 01 01 71", {"state": 1}),
    (RELAY, "On", {"address": 2}, "5556000000 02 01 AE", "333C000000 02 01 72", {"state": 1}),
    (RELAY, "Off", {"address": 1}, "5556000000 01 02 AE", "333C000000 01 02 72", {"state": 2}),
    (RELAY, "Toggle", {"address": 4}, "5556000000 04 03 B2", "333C000000 04 02 75", {"state": 2}),
    (ROBOCLAW, "MainBattery", {"address": 0x81}, "81 18", "007C FE55", {"voltage": 124}),
    (ROBOCLAW, "MainBattery", {"address": 0x80}, "80 18", "007C 88E1", {"voltage": 124}),
    (ROBOCLAW, "Currents", {"address": 0x80}, "80 31", "000A 0014 E7EB", {"m1": 10, "m2": 20}),
    (ROBOCLAW, "ForwardM1", {"address": 0x80, "speed": 0}, "80 00 00 3B5A", "FF", {}),
]


def protocol_of(name: str) -> Protocol:
    return load_protocol(str(ROOT / "examples" / f"{name}.py"))


@pytest.mark.parametrize("row", EXCHANGES, ids=lambda row: f"{row[0]}-{row[1]}")
def test_requests_and_answers_are_read_and_built(row: tuple[object, ...]) -> None:
    name, instruction, values, asked, answered, fields = row
    protocol = protocol_of(str(name))
    request = judge(protocol, bytes.fromhex(str(asked)))
    reply = read_reply(protocol, bytes.fromhex(str(answered)), request)

    assert build(protocol, str(instruction), values) == request.frame  # type: ignore[arg-type]
    assert (request.valid, request.name) == (True, instruction)
    assert (reply.reason, dict(reply.fields)) == ("", fields)
    assert agrees(protocol, request, reply)


def test_more_data_than_a_header_announces_are_refused() -> None:
    values = {"address": 1, "register": 1}
    protocol = load_protocol("dynamixel1")

    assert len(build(protocol, "Write", {**values, "values": "00" * 252})) == 259
    with pytest.raises(ValueError, match="Write has 254 data bytes; a header announces at most"):
        build(protocol, "Write", {**values, "values": "00" * 253})


# -- loading grammars: each gives one Protocol value, or one sentence that says what is wrong ------


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
