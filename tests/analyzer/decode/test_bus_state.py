"""The state of each device on a bus is that of the frames to its address."""

from __future__ import annotations

from pathlib import Path

import pytest

from bilprov.analyzer.decode.checkpoint import decoded, encoded
from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.decode.session import Session
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.codec import build
from bilprov.spec.protocol import Protocol, load

RELAY = Path(__file__).parents[3] / "examples" / "relay_board.py"


@pytest.fixture
def relay() -> Protocol:
    return load(RELAY.read_text(encoding="utf-8"), RELAY.name)


@pytest.fixture
def for_all() -> Protocol:
    """A relay board on which 0 stands for all relays."""
    text = RELAY.read_text(encoding="utf-8")
    return load(text.replace("Address(Byte, 1, 4)", "Address(Byte, 1, 4, broadcast=0)"), "all.py")


def states(session: Session, protocol: Protocol, *sent: tuple[str, int]) -> list[int | None]:
    """Whether each addressed relay is on after its frame, as is predicted; None: not known."""
    found = []
    for place, (name, address) in enumerate(sent):
        frame = build(protocol, name, {"address": address})
        records = session.feed(Chunk(place * MS, "host", frame))
        found += [record.state.on for record in records if isinstance(record, HostRecord)]
    return found


def test_a_frame_changes_the_state_of_its_address_only(relay: Protocol) -> None:
    sent = (("On", 1), ("Read", 2), ("Toggle", 2), ("Read", 1), ("Off", 1), ("Read", 2))
    assert states(Session(relay), relay, *sent) == [1, 0, 1, 1, 0, 1]


def test_what_is_sent_to_all_changes_each_state(for_all: Protocol) -> None:
    sent = (("Toggle", 1), ("On", 0), ("Read", 1), ("Read", 4), ("Off", 0), ("Read", 1))
    assert states(Session(for_all), for_all, *sent) == [1, 1, 1, 1, 0, 0]


def test_a_state_that_no_frame_tells_is_not_known(relay: Protocol) -> None:
    assert states(Session(relay), relay, ("Pulse", 3), ("Toggle", 3), ("On", 3)) == [None, None, 1]


def test_a_checkpoint_has_the_state_of_each_address(relay: Protocol) -> None:
    session, other = Session(relay), Session(relay)
    states(session, relay, ("On", 1), ("Pulse", 2))
    saved = session.saved()
    assert saved is not None
    again = decoded(encoded(saved), relay)
    assert again == saved
    other.resume(again)
    assert states(other, relay, ("Read", 1), ("Read", 2), ("Read", 3)) == [1, None, 0]
