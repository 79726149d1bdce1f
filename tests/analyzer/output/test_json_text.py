"""JSON lines made in bulk: the same text as each record's own line."""

from __future__ import annotations

from typing import Any

import pytest
from bilprov.analyzer.columns.decoder import Records, StreamDecoder
from hypothesis import given, settings

from bilprov.analyzer.decode.json_lines import encode, json_line
from bilprov.analyzer.output.json_text import JsonText
from bilprov.spec.protocol import Protocol
from tests.support.traffic import ACTS, BATCHES, SETTINGS, Act, played, told

pytestmark = pytest.mark.usefixtures("columns_at_once")


@pytest.mark.sample(1)
@pytest.mark.slow
@settings(max_examples=100)
@given(ACTS, BATCHES, SETTINGS)
def test_the_text_of_a_part_is_that_of_its_records_one_by_one(
    each_protocol: Protocol, acts: list[Act], batches: list[int], chosen: dict[str, Any]
) -> None:
    text = JsonText()

    for part in told(StreamDecoder(each_protocol, **chosen), played(each_protocol, acts), batches):
        lines = [json_line(record) for record in part.records()]
        expected = "".join(encode(line).decode() + "\n" for line in lines if line is not None)
        in_bulk = text.records(part.listed) if isinstance(part, Records) else text.stretch(part)
        assert in_bulk == expected
        assert text.records(part.records()) == expected
