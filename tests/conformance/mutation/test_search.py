"""The search for inputs that show a fault: what it finds, shortens, and is hinted at."""

from __future__ import annotations

import pytest

from bilprov.conformance.dut.simulator import CONFORMING
from bilprov.conformance.mutation import search as room
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.mutation.search import hints, search
from bilprov.spec.protocol import Protocol
from tests.support.faults import BANK, made


@pytest.mark.slow
def test_nothing_shows_for_the_reference_nor_for_what_never_happens(protocol: Protocol) -> None:
    # A fault has stopped the robot before.
    never = made(protocol, "drives-on", "faulty, row > 0, moves forward")

    for fault in (CONFORMING, never):
        found = search(protocol, fault, 4000)
        assert found.shown == ()
        assert found.tried == 4000 + 2 * 4000
        assert str(found) == "not shown by 12,000 random inputs"


def test_what_the_fault_hints_at_is_sent_often(protocol: Protocol) -> None:
    needle = made(protocol, "twice", "id 9, length 2, first-byte 77, speed 200")

    assert search(protocol, needle, 2000).shown


def test_what_a_device_does_by_itself_shows(protocol: Protocol) -> None:
    late = search(protocol, made(protocol, "resumes-after 390", "faulty"))

    assert len(late.shown) == 3  # a speed, the motion and a fault: nothing is sent after it
    assert late.difference.endswith("is due")


@pytest.mark.sample(4)
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, fault in BANK.items() if not fault.needs])
def test_a_fault_of_the_bank_shows_unless_it_needs_a_soak(name: str, protocol: Protocol) -> None:
    assert search(protocol, fault_bank(protocol)[name]).shown


def test_of_a_shortened_sequence_nothing_can_be_left_out(
    protocol: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault, tried, try_sequence = (
        fault_bank(protocol)["stop-ignored-after-led"],
        [],
        room.try_sequence,
    )

    def noted(*given: object) -> object:
        tried.append(given[2])
        return try_sequence(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(room, "try_sequence", noted)
    found = search(protocol, fault)

    sequence = tried[-1]
    assert tuple(symbol.words for symbol in sequence) == found.shown
    # What Stop would reset, the LED, Stop.
    assert [words.split()[0] for words in found.shown[-2:]] == ["LED", "Stop"]
    for at in range(len(sequence)):
        fewer = [*sequence[:at], *sequence[at + 1 :]]
        assert try_sequence(protocol, fault, fewer) == ((), "")


@pytest.mark.parametrize(
    ("what", "when", "expected"),
    [
        ("twice", "speed >= 77", ["11 4d", "41 4d", "51 4d", "81 4d", "11 4c", "41 4c"]),
        ("twice", "value & 8, led 4", ["81 04", "81 08"]),
        ("wheels-astray half speed 100", "", ["11 64", "11 63"]),
        ("twice", "id 9, length 2", ["92 00 00"]),
        ("twice", "truncated, known, size 2, first-byte & 32", ["02 20", "03 20", "04 20"]),
    ],
)
def test_a_search_sends_what_the_words_of_a_fault_hint_at(
    protocol: Protocol, what: str, when: str, expected: list[str]
) -> None:
    found = hints(protocol, made(protocol, what, when))

    assert set(expected) <= {one.hex(" ") for one in found}
