"""The grammar is a construct declaration and agrees with the document."""

from __future__ import annotations

import pytest
from construct import StreamError, ValidationError

from bilprov.spec.fields import Instruction, Ranged, Sets
from bilprov.spec.grammar import FRAME, HEADER, INSTRUCTIONS, RESPONSE
from bilprov.spec.protocol import Protocol
from tests.vectors import (
    BAD_DATA_FRAMES,
    HEADERS,
    LINE,
    LONGEST_FRAME,
    RESPONSES,
    TIMING,
    UNUSED_IDS,
    VALID_FRAMES,
    VERSION,
    FrameVector,
    InstructionRow,
    ResponseRow,
)

by_bytes = pytest.mark.parametrize("vector", VALID_FRAMES, ids=lambda v: v.frame.hex(" "))


@by_bytes
def test_a_frame_parses_as_construct(vector: FrameVector) -> None:
    parsed = FRAME.parse(vector.frame)
    fields = {name: value for name, value in parsed.data.items() if name[0] != "_"}

    assert (parsed.header.id, parsed.header.length) == (vector.frame[0] >> 4, len(vector.frame) - 1)
    assert fields == dict(vector.fields)


@by_bytes
def test_a_frame_builds_as_construct(vector: FrameVector) -> None:
    identity = vector.frame[0] >> 4
    header = {"id": identity, "length": len(vector.frame) - 1}

    assert FRAME.build({"header": header, "data": dict(vector.fields)}) == vector.frame


@pytest.mark.parametrize("vector", BAD_DATA_FRAMES, ids=lambda v: v.frame.hex(" "))
def test_data_out_of_range_neither_parse_nor_build(vector: FrameVector) -> None:
    with pytest.raises(ValidationError):
        FRAME.parse(vector.frame)
    with pytest.raises(ValidationError):
        FRAME.build({"header": {"id": 8, "length": 1}, "data": dict(vector.fields)})


def test_a_frame_without_its_data_does_not_parse() -> None:
    with pytest.raises(StreamError):
        FRAME.parse(b"\x11")


def test_the_header_is_four_bits_of_id_and_four_of_length() -> None:
    for byte in range(256):
        parsed = HEADER.parse(bytes([byte]))
        assert (parsed.id, parsed.length) == (byte >> 4, byte & 0b1111)


@pytest.mark.parametrize("row", RESPONSES, ids=lambda r: r.name)
def test_a_response_parses_to_its_name_and_builds_from_it(row: ResponseRow) -> None:
    assert RESPONSE.parse(bytes([row.code])) == row.name
    assert RESPONSE.build(row.name) == bytes([row.code])


@pytest.mark.parametrize("row", HEADERS, ids=lambda r: r.name)
def test_every_instruction_is_the_documents(protocol: Protocol, row: InstructionRow) -> None:
    spec = protocol.by_id[row.id]

    assert (spec.name, spec.document, spec.length) == (row.name, row.document, row.length)
    assert [field.name for field in spec.fields] == [row.field] * row.length
    assert spec.prose.endswith(".")
    assert all(field.prose for field in spec.fields)


def test_the_instructions_and_the_unused_ids_are_all_ids(protocol: Protocol) -> None:
    assert [s.id for s in protocol.instructions] == [row.id for row in HEADERS]
    assert protocol.unused_ids == UNUSED_IDS
    assert protocol.longest_frame == LONGEST_FRAME


def test_the_responses_are_the_documents(protocol: Protocol) -> None:
    assert [(r.code, r.name, r.document) for r in protocol.responses] == list(RESPONSES)
    assert all(r.prose for r in protocol.responses)


def test_what_the_document_leaves_open_is_as_we_read_it(protocol: Protocol) -> None:
    assert {name: getattr(protocol.timing, name) for name in TIMING} == TIMING
    assert {name: getattr(protocol.line, name) for name in LINE} == LINE
    assert protocol.version == VERSION


@pytest.mark.parametrize("declaration", INSTRUCTIONS.values(), ids=lambda d: d.name)
def test_what_the_grammar_is_written_with_can_be_read_back(declaration: object) -> None:
    body = declaration.subcon.subcon  # type: ignore[attr-defined]  # docs, then name

    assert isinstance(body, Instruction)
    assert isinstance(body.effect, Sets)
    for member in body.subcons:
        ranged = member.subcon.subcon
        assert isinstance(ranged, Ranged)
        assert 0 <= ranged.low < ranged.high <= 255
