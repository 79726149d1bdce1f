"""An answer that reports a variable sets what is predicted from then on."""

from __future__ import annotations

from random import Random

import pytest

from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.simulated.device import SimulatedDevice
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.codec import build, judge
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.replies import build_reply
from tests.support.decoding import Event, decoded
from tests.support.framed_traffic import FRAMED, drawn_request

RELAYS = load(FRAMED["relay_board"])

FAN = load(
    FRAMED["relay_board"]
    .replace("STATE = Variables(on=Whole(0, 1))", 'STATE = Variables(on=Word("off", "on"))')
    .replace(
        'Reports("on", Enum(Byte, on=1, off=2), factor=-1, plus=2)',
        'Reports("on", Enum(Byte, on=1, off=2))',
    )
    .replace("on=1))", 'on="on"))')
    .replace("on=0)", 'on="off")')
    .replace("on=Changed(-1, 1)", "on=Unknown()")
    .replace("    Whole,\n", "    Whole,\n    Word,\n")
)


def asked(protocol: Protocol, name: str, value: int, t: int, address: int = 1) -> list[Event]:
    """A request, and an answer that reports a value of the field `state`."""
    frame = build(protocol, name, {"address": address})
    answer = build_reply(protocol, judge(protocol, frame), {"state": value})
    return [Chunk(t, "host", frame), Chunk(t + MS, "device", answer)]


def states(protocol: Protocol, events: list[Event]) -> list[object]:
    return [record.state.on for record in decoded(Session(protocol), events)]


def test_an_answer_sets_what_is_predicted_from_then_on() -> None:
    on, off = 1, 2
    events = [*asked(RELAYS, "On", off, 0), *asked(RELAYS, "Read", on, 10 * MS)]

    assert states(RELAYS, events) == [1, 0, 0, 1]
    assert states(FAN, events) == ["on", "off", "off", "on"]


def test_what_is_not_known_is_known_once_it_is_reported() -> None:
    events = [*asked(RELAYS, "Pulse", 1, 0), *asked(RELAYS, "Toggle", 2, 10 * MS)]

    assert states(RELAYS, events) == [None, 1, 0, 0]


def test_each_device_of_a_bus_has_what_it_reported() -> None:
    events = [*asked(RELAYS, "Read", 1, 0, 3), *asked(RELAYS, "Read", 2, 10 * MS, 2)]
    events += [Chunk(20 * MS, "host", build(RELAYS, "Read", {"address": one})) for one in (3, 2)]

    assert states(RELAYS, events) == [0, 1, 0, 0, 1, 0]


def test_an_answer_to_an_older_request_does_not_undo_a_newer_one() -> None:
    read, on = (build(RELAYS, name, {"address": 1}) for name in ("Read", "On"))
    answers = [build_reply(RELAYS, judge(RELAYS, one), {"state": 2}) for one in (read, on)]
    events = [Chunk(0, "host", read + on), *(Chunk(MS, "device", one) for one in answers)]

    assert states(RELAYS, events) == [0, 1, 1, 0]


def test_what_the_variable_cannot_be_is_not_taken_over() -> None:
    assert states(RELAYS, asked(RELAYS, "On", 7, 0)) == [1, 1]


@pytest.mark.parametrize("protocol", [RELAYS, FAN], ids=["number", "word"])
def test_the_prediction_agrees_with_a_simulated_device_that_changed_unseen(
    protocol: Protocol,
) -> None:
    device, session, random = SimulatedDevice(protocol), Session(protocol), Random(3)
    for step in range(60):
        t, request = step * 1000 * MS, drawn_request(protocol, random)
        device.receive(request, t)
        if random.random() < 0.3:
            device.advance(t + MS)
            continue  # nobody has seen it
        session.feed(Chunk(t, "host", request))
        (record,) = session.feed(Chunk(t + MS, "device", device.advance(t + MS)))

        known = device.state(judge(protocol, request).address)
        assert known.on is None or record.state == known
