"""The grammar is a construct declaration and agrees with the document."""

from __future__ import annotations

import pytest
from construct import StreamError, ValidationError

from bilprov.spec.fields import Instruction, Ranged, Sets
from bilprov.spec.grammar import FRAME, HEADER, INSTRUCTIONS
from tests.vectors import (
    BAD_DATA_FRAMES,
    VALID_FRAMES,
    FrameVector,
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


@pytest.mark.parametrize("declaration", INSTRUCTIONS.values(), ids=lambda d: d.name)
def test_what_the_grammar_is_written_with_can_be_read_back(declaration: object) -> None:
    body = declaration.subcon.subcon  # type: ignore[attr-defined]  # docs, then name

    assert isinstance(body, Instruction)
    assert isinstance(body.effect, Sets)
    for member in body.subcons:
        ranged = member.subcon.subcon
        assert isinstance(ranged, Ranged)
        assert 0 <= ranged.low < ranged.high <= 255
