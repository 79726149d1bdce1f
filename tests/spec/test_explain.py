"""Explanations: they account for every bit and say what follows from it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.explain import explain
from bilprov.spec.protocol import load
from tests import vectors_dynamixel1, vectors_modbus_rtu, vectors_stk500v1
from tests.frame_vectors import RequestVector
from tests.support import ROOT
from tests.support.grammars import mutated

PROTOCOL = load_protocol()


def only(frame: str):  # type: ignore[no-untyped-def]
    (one,) = explain(PROTOCOL, bytes.fromhex(frame)).frames
    return one


@given(st.binary(max_size=60))
def test_every_bit_stands_in_exactly_one_group(data: bytes) -> None:
    explanation = explain(PROTOCOL, data)
    assert b"".join(frame.judgement.frame for frame in explanation.frames) == data
    for frame in explanation.frames:
        bits = "".join(group.bits for group in frame.groups)
        assert bits == "".join(f"{byte:08b}" for byte in frame.judgement.frame)
        for group in frame.groups:
            assert len(group.bits) == group.high - group.low + 1
            assert group.meaning
        assert frame.missing == frame.judgement.length + 1 - len(frame.judgement.frame)
        assert (frame.nearest is None) == frame.judgement.valid
        assert frame.nearest is None or (frame.stops and frame.nearest.valid)
        assert bool(frame.differences) != frame.judgement.valid
        assert any(group.fault for group in frame.groups) <= (not frame.judgement.valid)


@pytest.mark.parametrize(
    ("frame", "faulty"),
    [
        ("11 7f", []),
        ("81 09", ["rgb"]),
        ("91 02", ["id"]),
        ("13 01 02 03", ["length"]),
        ("40", ["length"]),
        ("11", []),
    ],
)
def test_the_bits_that_make_it_faulty_are_marked(frame: str, faulty: list[str]) -> None:
    assert [group.name for group in only(frame).groups if group.fault] == faulty


FOREIGN = [
    (name, one)
    for name, module in (
        ("modbus-rtu", vectors_modbus_rtu),
        ("stk500v1", vectors_stk500v1),
        ("dynamixel1", vectors_dynamixel1),
    )
    for one in module.REQUESTS
    if one.outcome not in ("bad-sync", "truncated") or name == "stk500v1"
]


@pytest.mark.parametrize(("name", "vector"), FOREIGN, ids=lambda value: str(value)[:40])
def test_every_bit_of_a_frame_of_any_layout_stands_in_one_group(
    name: str, vector: RequestVector
) -> None:
    protocol = load_protocol(name)
    (frame,) = explain(protocol, vector.frame).frames
    bits = "".join(group.bits for group in frame.groups)

    assert bits == "".join(f"{byte:08b}" for byte in vector.frame)
    assert frame.judgement.valid is (vector.outcome == "valid")
    assert all(group.meaning for group in frame.groups)
    faulty = [group for group in frame.groups if group.fault]
    assert bool(faulty) is (vector.outcome not in ("valid", "truncated"))
    assert frame.device == protocol.device


@pytest.mark.parametrize(
    ("sent", "meanings", "reason"),
    [
        ("5556000000 01 00 000102 AF", ["fixed", "fixed", "fixed"], ""),
        (
            "5556000000 01 00 000202 B0",
            ["fixed", "must be 01", "fixed"],
            "Read.rest is 00 02 02, allowed are 00 01 02",
        ),
    ],
)
def test_fixed_data_are_explained_byte_by_byte(sent: str, meanings: list[str], reason: str) -> None:
    text = (ROOT / "examples" / "relay_board.py").read_text(encoding="utf-8")
    read, silent = '"Read" / Instruction(', "SILENT = ("
    const = f'{read}"rest" / Const(b"\\0\\1\\2"), '
    protocol = load(mutated(text, {read: const, silent: f"{silent}Outcome.BAD_DATA, "}))
    (frame,) = explain(protocol, bytes.fromhex(sent)).frames

    assert [group.meaning for group in frame.groups if group.name == "rest"] == meanings
    assert frame.judgement.reason == reason
    assert "means nothing" not in [group.meaning for group in frame.groups]


def test_what_belongs_to_no_frame_is_refused_with_the_right_beginning() -> None:
    with pytest.raises(ValueError, match="ff fe belong to no frame; a frame begins with ff ff"):
        explain(load_protocol("dynamixel1"), bytes.fromhex("FFFE FFFF 01 02 01 FB"))
