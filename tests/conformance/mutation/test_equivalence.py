"""Equivalence search: it finds the shortest way to show a fault, or proves equivalence."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import CONFORMING
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation import equivalence
from bilprov.conformance.mutation.equivalence import (
    Search,
    alphabet,
    difference,
    hints,
    random_search,
    search,
)
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT
from tests.support.faults import made

# xdist must collect the same tests everywhere: the names come from the kit's own grammar.
BANK = fault_bank(load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"), "grammar.py"))

# Each frame takes 60 ms, and the next begins when its answer has gone.
ONE_AT_A_TIME = "late-one-at-a-time 60"


@pytest.fixture
def few_inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every third input: what is said of all of them takes a quarter of a minute."""
    monkeypatch.setattr(equivalence, "alphabet", lambda *given: alphabet(*given)[::3])


@pytest.mark.slow
def test_the_reference_is_equivalent_to_itself_and_the_search_says_over_what(
    protocol: Protocol,
) -> None:
    found = search(protocol, CONFORMING)

    assert found.equivalent
    # five kinds of motion, two speeds, three steerings, three lights
    assert found.states == 5 * 2 * 3 * 3
    assert found.symbols == len(alphabet(protocol)) > 400
    assert str(found).startswith(f"equivalent to the reference: 90 joint states x {found.symbols}")


@pytest.mark.usefixtures("few_inputs")
@pytest.mark.slow
def test_what_can_never_happen_is_proven_equivalent(protocol: Protocol) -> None:
    # A fault has stopped the robot before.
    found = search(protocol, made(protocol, "drives-on", "faulty, row > 0, moves forward"))

    assert found.equivalent
    assert not search(protocol, made(protocol, "drives-on", "faulty, moves forward")).equivalent


def test_the_shortest_sequence_is_found(protocol: Protocol) -> None:
    found = search(protocol, made(protocol, "drives-on", "faulty, motion backward"))

    # A speed, the motion, a fault.
    assert len(found.shown) == 3
    assert found.difference == "moving is True where False is due"
    assert not found.equivalent
    assert str(found).startswith("shows after ")


@pytest.mark.sample(8)
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, fault in BANK.items() if not fault.needs])
def test_a_fault_of_the_bank_shows_unless_it_needs_a_soak(name: str, protocol: Protocol) -> None:
    fault = fault_bank(protocol)[name]

    found = random_search(protocol, fault, alphabet(protocol, hints(protocol, fault)), 6000, 2000)

    assert found or search(protocol, fault).shown  # one that never shows would be no fault


def test_of_a_shortened_walk_nothing_can_be_left_out(protocol: Protocol) -> None:
    fault = fault_bank(protocol)["stop-ignored-after-led"]

    sequence = random_search(protocol, fault, alphabet(protocol))

    # What Stop would reset, the LED, Stop.
    assert [symbol.words.split()[0] for symbol in sequence[-2:]] == ["LED", "Stop"]
    for at in range(len(sequence)):
        fewer = sequence[:at] + sequence[at + 1 :]
        assert equivalence.try_sequence(protocol, fault, fewer) == ((), "")


@pytest.mark.parametrize(("look", "parts"), [(search, 2), (difference, 4)])
def test_each_part_of_a_search_is_as_small_as_it_is_told(
    look: Callable[..., Search], parts: int, protocol: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = []
    send = equivalence._send
    monkeypatch.setattr(equivalence, "_send", lambda *given: sent.append(1) or send(*given))

    found = look(protocol, CONFORMING, most=100)

    assert len(sent) == parts * 100
    assert not found.closed
    assert "not shown by any" in str(found)


@pytest.mark.usefixtures("few_inputs")
@pytest.mark.slow
@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("when", "times"),
    [
        # The last condition never holds, and what is counted is seen only as far as it matters.
        ("row >= 1, motion nowhere", 3),
        ("frames every 3, motion nowhere", 3),
        ("previous Stop too-few, motion nowhere", 2),
        ("after-truncated, motion nowhere", 2),
        ("times >= 2, motion nowhere", 4),
    ],
)
def test_history_is_told_apart_only_as_far_as_the_trigger_reads_it(
    protocol: Protocol, when: str, times: int
) -> None:
    found = search(protocol, made(protocol, "twice", when))

    assert found.equivalent
    states = search(protocol, CONFORMING).states
    assert states < found.states <= times * states


@pytest.mark.parametrize(
    ("what", "when", "expected"),
    [
        ("twice", "speed >= 77", [77, 76]),
        ("twice", "value & 8, led 4", [4, 3, 8, 7]),
        ("wheels-astray half speed 100", "", [100, 99]),
        ("twice", "id 9, length 2", ["920000"]),
        ("twice", "truncated, known, size 2, first-byte & 32", ["0220", "0320", "0420"]),
    ],
)
def test_a_search_sends_what_the_words_of_a_fault_hint_at(
    protocol: Protocol, what: str, when: str, expected: list[int | str]
) -> None:
    found = hints(protocol, made(protocol, what, when))

    assert [one.hex() if isinstance(one, bytes) else one for one in found] == expected


def test_a_twin_goes_its_own_way(protocol: Protocol) -> None:
    device = Simulator(protocol, made(protocol, ONE_AT_A_TIME))
    device.receive(bytes.fromhex("11"), 0)
    twin = device.clone()
    assert twin.state_key(0, MS) == device.state_key(0, MS)

    twin.receive(b"\x55", 1)
    twin.memory["more"] = 1

    assert (device.held, twin.held) == (b"\x11", b"")
    assert (device.state.speed, twin.state.speed) == (0, 0x55)
    assert device.deadline() == 50 * MS
    assert "more" not in device.memory
    assert twin.state_key(1, MS) != device.state_key(1, MS)


def test_a_snapshot_does_not_depend_on_when_it_is_taken(protocol: Protocol) -> None:
    def at(start: int) -> object:
        device = Simulator(protocol, made(protocol, ONE_AT_A_TIME))
        device.receive(b"\0\x90\x11", start)
        return device.state_key(start + MS, 100 * MS)

    assert at(5 * MS) == at(7000 * MS)
