"""Recorded traffic of foreign devices decodes to the last byte, and nothing in it is odd."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Chunk
from tests.support import ROOT
from tests.support.decoding import decoded, devices, hosts

FOLDER = ROOT / "tests" / "data" / "foreign"
# The file, its grammar, and how many requests it has of each name.
TRAFFIC = {
    "sr_wizmodbus": ("modbus-rtu", {"ReadHoldingRegisters": 40, "WriteSingleRegister": 4}),
    "sr_flowmeter_graph_tool": ("modbus-rtu", {"ReadHoldingRegisters": 9}),
    "sr_flowmeter_target_15liter_per_min": (
        "modbus-rtu",
        {"ReadHoldingRegisters": 64, "WriteMultipleRegisters": 2},
    ),
    "optiboot44_avrdude": ("stk500v1", {}),
    "optiboot83_avrdude": ("stk500v1", {}),
    "atmegaboot_avrdude": ("stk500v1", {}),
}


def events(name: str, *, single: bool = False) -> Iterator[Chunk]:
    """The chunks of a recording; with `single` each byte is one."""
    for line in (FOLDER / f"{name}.jsonl").read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        data, t = bytes.fromhex(row["hex"]), round(row["t"] * 1e9)
        parts = [bytes([byte]) for byte in data] if single else [data]
        yield from (Chunk(t, row["dir"], part) for part in parts)


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", list(TRAFFIC))
def test_every_byte_is_in_a_frame_and_every_request_has_its_answer(name: str, single: bool) -> None:
    grammar, counts = TRAFFIC[name]
    chunks = list(events(name, single=single))
    records = decoded(Session(load_protocol(grammar)), chunks)
    asked, answers = hosts(records), devices(records)

    for direction, frames in (("host", asked), ("device", answers)):
        sent = b"".join(chunk.data for chunk in chunks if chunk.direction == direction)
        assert b"".join(record.data for record in frames) == sent
    assert [record for record in records if record.faults] == []
    assert [one.instruction for one in answers] == [one.sequence for one in asked]
    assert {one.agrees for one in answers} == {True}
    assert len(records) == len(asked) + len(answers)
    names = [one.value.name for one in asked]
    assert {one: names.count(one) for one in names if counts} == counts


@pytest.mark.parametrize("name", [name for name in TRAFFIC if name.endswith("avrdude")])
def test_what_avrdude_writes_is_what_it_reads_back(name: str) -> None:
    records = decoded(Session(load_protocol("stk500v1")), events(name))
    judged = [one.judgement for one in hosts(records) if one.judgement]
    fields = [dict(one.fields) for one in judged]
    written = [one["content"] for one in fields if "content" in one]
    read = [dict(one.reply.fields).get("content") for one in devices(records) if one.reply]
    signatures = [dict(one.reply.fields).get("signature") for one in devices(records) if one.reply]

    assert sum(map(len, written)) >= 400
    assert b"".join(one for one in read if one).endswith(b"".join(written))
    assert bytes.fromhex("1e950f") in signatures
