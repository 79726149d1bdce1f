"""JSON lines: each record by itself, whatever frames came before."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record, serious_faults
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.output.json_text import JsonText
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import conversation, decoded
from tests.support.traffic import ACTS, SETTINGS, Act, played


def told(record: HostRecord | DeviceRecord) -> dict[str, Any]:
    """What the line of a frame or an answer tells, from the record alone."""
    host = isinstance(record, HostRecord)
    judgement = record.judgement if host else record.answered
    spec = judgement.instruction if host and judgement else None
    answer = None if host else record.answer
    latency = None if host else record.latency
    return {
        "t": record.t / 1e9,
        "direction": "host" if host else "device",
        "kind": record.kind if host else "response",
        "hex": record.hex,
        "name": spec.name if spec else answer.name if answer else None,
        "fields": dict(judgement.fields) if host and judgement else {},
        "judgement": judgement.response.name if judgement else None,
        "reason": record.reason,
        "latency": None if latency is None else latency / 1e9,
        "state": {name: getattr(record.state, name) for name in record.state.__struct_fields__},
        "sequence": record.sequence if host else None,
        "answers": None if host else record.instruction,
        "agrees": None if host else record.agrees,
        "faults": [fault.kind for fault in serious_faults(record)],
    }


def lines(records: list[Record]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in JsonText().text(records).splitlines()]


@pytest.mark.sample(1)
@pytest.mark.slow
@settings(max_examples=100)
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
