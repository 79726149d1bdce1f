"""What Modbus servers by others answer to faulty requests, as recorded: every answer finds its own.

The client sent a request only after an answer to the one before, or after 0.7 s without one. So an
answer is to the last request before it.
"""

from __future__ import annotations

import pytest

from bilprov.analyzer.decode.records import FaultRecord
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from tests.analyzer.decode.test_foreign_traffic import events
from tests.analyzer.decode.test_stream import same
from tests.support.decoding import decoded, devices, hosts

pytestmark = pytest.mark.usefixtures("columns_at_once")

# The answers that the document does not allow, by server.
WRONG = {
    "pymodbus": {
        "112b0e01830000000ea3",  # to a function that the grammar does not have
        "11800181c5",  # function 80, code 01, to no register at all: 83 and 03 are due
        "1105000aff00aea8",  # a coil's value 1234 is taken for "on"
    },
    "libmodbus": set(),
}


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("server", list(WRONG))
def test_every_answer_is_to_the_request_before_it(server: str, single: bool) -> None:
    protocol = load_protocol("modbus-rtu")
    chunks = list(events(f"{server}_faults", single=single))
    last, pairs = b"", []
    for chunk in events(f"{server}_faults"):
        if chunk.direction == "host":
            last = chunk.data
        else:
            pairs.append((last, chunk.data))

    records = decoded(Session(protocol), chunks)
    same(protocol, list(chunks), [1, 7, 1000])

    sent = b"".join(chunk.data for chunk in chunks if chunk.direction == "host")
    asked, answers = {one.sequence: one for one in hosts(records)}, devices(records)
    assert b"".join(one.data for one in asked.values()) == sent
    assert [one.data for one in answers] == [answer for _, answer in pairs]
    for one, (request, _) in zip(answers, pairs, strict=True):
        assert one.instruction is not None
        assert asked[one.instruction].data.endswith(request)
    assert {one.data.hex() for one in answers if one.faults} == WRONG[server]
    assert {one.faults[0].kind for one in records if isinstance(one, FaultRecord)} == {"unanswered"}


def test_recorded_faults_are_of_every_kind() -> None:
    asked = hosts(decoded(Session(load_protocol("modbus-rtu")), events("libmodbus_faults")))
    judged = {one.judgement.outcome.value for one in asked if one.judgement}

    assert judged >= {"valid", "unknown ID", "bad data", "bad checksum"}
    assert {one.kind for one in asked} == {"instruction", "truncated"}
