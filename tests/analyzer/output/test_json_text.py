"""JSON lines: each record by itself, whatever frames came before."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given

from bilprov.analyzer.decode.json_lines import JsonLine
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record, serious_faults
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.output.outputs import JsonText
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import conversation, decoded
from tests.support.traffic import ACTS, SETTINGS, Act, played


def told(record: HostRecord | DeviceRecord) -> dict[str, Any]:
    """What the line of a frame or an answer tells, from the record alone; the keys in order."""
    others = ("outcome", "address", "uncertain")  # of grammars with more around the data
    line: dict[str, Any] = {key: None for key in JsonLine.__struct_fields__ if key not in others}
    line |= {"t": record.t / 1e9, "hex": record.hex, "reason": record.reason, "fields": {}}
    line["state"] = msgspec.structs.asdict(record.state)
    line["faults"] = [fault.kind for fault in serious_faults(record)]
    if isinstance(record, DeviceRecord):
        answered, latency = record.answered, record.latency
        return line | {
            "direction": "device",
            "kind": "response",
            "name": record.answer.name if record.answer else None,
            "judgement": answered.response.name if answered else None,
            "latency": None if latency is None else latency / 1e9,
            "answers": record.instruction,
            "agrees": record.agrees,
        }
    line |= {"direction": "host", "kind": record.kind, "sequence": record.sequence}
    if record.judgement is None:
        return line
    spec = record.judgement.instruction
    return line | {
        "name": spec.name if spec else None,
        "fields": dict(record.judgement.fields),
        "judgement": record.judgement.response.name,
    }


def lines(records: list[Record]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in JsonText().text(records).splitlines()]


@pytest.mark.sample(1)
@pytest.mark.slow
@given(ACTS, SETTINGS)
def test_a_line_tells_what_its_record_has(
    each_protocol: Protocol, acts: list[Act], chosen: dict[str, Any]
) -> None:
    records = decoded(Session(each_protocol, **chosen), played(each_protocol, acts))

    shown = [line for line in lines(records) if line["hex"]]
    own = [told(one) for one in records if isinstance(one, HostRecord | DeviceRecord)]
    assert [list(line.items()) for line in shown] == [list(line.items()) for line in own]


def test_a_frame_is_named_by_the_grammar_that_decoded_it(
    protocol: Protocol, horn_text: str
) -> None:
    horn = load(horn_text, "horn.py")
    said = conversation([(b"\x91\x03", b"\0")] * 2)

    for _ in range(2):
        names = [
            [line["name"] for line in lines(decoded(Session(p), said))] for p in (protocol, horn)
        ]
        assert names == [[None, "OK"] * 2, ["Horn", "OK"] * 2]
