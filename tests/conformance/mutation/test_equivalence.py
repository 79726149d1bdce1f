"""Equivalence search: it finds the shortest way to show a fault, or proves equivalence."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import CONFORMING, Fault, React
from bilprov.conformance.dut.fault_reads import Count, FaultReads, RecordingProxy
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation import equivalence
from bilprov.conformance.mutation.equivalence import Search, difference, random_search, search
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.mutation.faults.vocabulary import (
    drives_on,
    every,
    faulty,
    is_named,
    twice,
    when,
)
from bilprov.conformance.mutation.random_faults import random_fault
from bilprov.conformance.mutation.search_inputs import alphabet
from bilprov.conformance.mutation.variant_behaviour import answers_at
from bilprov.spec.codec import judge
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT

# xdist must collect the same tests everywhere: the names come from the kit's own grammar.
BANK = fault_bank(load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"), "grammar.py"))

# Each frame takes 60 ms, and the next begins when its answer has gone.
ONE_AT_A_TIME = answers_at(lambda event, free: free + 60 * MS)


def faulty_by(react: React, *hints: int) -> Fault:
    return Fault("x", "test", "", react=react, hints=hints)


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
    never = every(faulty, lambda event: event.before.speed == 77)

    found = search(protocol, faulty_by(when(never, drives_on)))

    assert found.equivalent
    assert not search(protocol, faulty_by(when(never, drives_on), 77)).equivalent


def test_the_shortest_sequence_is_found(protocol: Protocol) -> None:
    moving_back = every(faulty, lambda event: event.before.motion is Motion.BACKWARD)

    found = search(protocol, faulty_by(when(moving_back, drives_on)))

    # A speed, the motion, a fault.
    assert len(found.shown) == 3
    assert found.difference == "moving is True where False is due"
    assert not found.equivalent
    assert str(found).startswith("shows after ")


def test_a_wrong_answer_shows_at_once(protocol: Protocol) -> None:
    found = search(protocol, fault_bank(protocol)["ok-to-bad-data"])

    assert len(found.shown) == 1
    assert found.difference == "answers 00 where 02 is due"


@pytest.mark.sample(8)
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, fault in BANK.items() if not fault.needs])
def test_a_fault_of_the_bank_shows_unless_it_needs_a_soak(name: str, protocol: Protocol) -> None:
    fault = fault_bank(protocol)[name]

    found = random_search(protocol, fault, alphabet(protocol, fault.hints), 6000, 2000)

    assert found or search(protocol, fault).shown  # one that never shows would be no fault


def test_of_a_shortened_walk_nothing_can_be_left_out(protocol: Protocol) -> None:
    fault = fault_bank(protocol)["stop-ignored-after-led"]

    sequence = random_search(protocol, fault, alphabet(protocol))

    # What Stop would reset, the LED, Stop.
    assert [symbol.words.split()[0] for symbol in sequence[-2:]] == ["LED", "Stop"]
    for at in range(len(sequence)):
        fewer = sequence[:at] + sequence[at + 1 :]
        assert equivalence.try_sequence(protocol, fault, fewer) == ((), "")


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("sent-ahead-right-ignored", "sent ahead"),
        ("buffer-of-64-bytes", "70 at once"),
        ("split-is-answered-twice", "split"),
        ("cut-frame-answered-twice", "cut short"),
        ("asleep-after-150-ms", "after 170 ms"),
        ("no-stop-after-200-faults", "250 times"),
        ("answers-again-after-90-ms", ""),
        ("restarts-after-200-ms", ""),
        ("watchdog-resumes", ""),
    ],
)
def test_each_delivery_is_an_input(protocol: Protocol, name: str, word: str) -> None:
    found = search(protocol, fault_bank(protocol)[name])

    assert found.shown
    assert word in " ".join(found.shown)


@pytest.mark.slow
def test_a_search_that_is_too_small_claims_nothing(protocol: Protocol) -> None:
    found = search(protocol, CONFORMING, most=500)

    assert not found.closed
    assert not found.equivalent
    assert "not shown by any" in str(found)


@pytest.mark.parametrize(("look", "parts"), [(search, 2), (difference, 4)])
def test_each_part_of_a_search_is_as_small_as_it_is_told(
    look: Callable[..., Search], parts: int, protocol: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = []
    send = equivalence._send
    monkeypatch.setattr(equivalence, "_send", lambda *given: sent.append(1) or send(*given))

    look(protocol, CONFORMING, most=100)

    assert len(sent) == parts * 100


@pytest.mark.usefixtures("few_inputs")
@pytest.mark.slow
def test_a_count_is_told_apart_only_as_far_as_it_is_looked_at(protocol: Protocol) -> None:
    # Whether a fault came before is looked at, on which nothing depends: the space stays finite.
    harmless = when(lambda event: event.row >= 1 and event.before.speed == 77, twice)

    found = search(protocol, faulty_by(harmless))

    assert found.equivalent
    states = search(protocol, CONFORMING).states
    assert states < found.states <= 2 * states


def test_what_is_looked_at_is_noted(protocol: Protocol) -> None:
    reads = FaultReads()
    count = Count(7, "row", reads)

    assert count >= 3
    assert not count > 9
    assert count + 1 >= 8
    assert count % 4 == 3
    assert reads.seen("row", 7) == (7, (3,))
    assert reads.seen("row", 11) == reads.seen("row", 15) != reads.seen("row", 12)
    assert reads.seen("row", 9) != reads.seen("row", 13)  # 9 is not above 9, 13 is
    assert reads.seen("frames", 7) is None
    with pytest.raises(TypeError):
        count * 2  # type: ignore[operator]  # nothing else is noted, so nothing else is allowed


def test_of_the_frame_before_only_what_is_read_counts(protocol: Protocol) -> None:
    reads = FaultReads()
    stop = judge(protocol, b"\0")
    watched = RecordingProxy(stop, reads, "previous.")

    assert watched.valid is True

    led = judge(protocol, b"\x81\1")
    assert reads.of_previous(stop) is None  # not before `previous` itself was read
    reads.names.add("previous")
    assert reads.of_previous(stop) == reads.of_previous(led)
    assert reads.of_previous(stop) != reads.of_previous(judge(protocol, b"\x90"))


def test_every_hook_of_the_bank_reads_in_a_way_that_can_be_noted(protocol: Protocol) -> None:
    for fault in (*fault_bank(protocol).values(), *(random_fault(protocol, n) for n in range(150))):
        device = Simulator(protocol, fault)
        device.reads = FaultReads()
        for turn, byte in enumerate(bytes(range(256)) * 2):
            device.receive(bytes([byte]), turn * 2 * MS)
        device.advance(10**10)
        device.state_key(10**10, MS, device.reads)


def test_a_twin_goes_its_own_way(protocol: Protocol) -> None:
    device = Simulator(protocol, faulty_by(ONE_AT_A_TIME))
    device.receive(bytes.fromhex("11"), 0)
    twin = device.clone()
    assert twin.state_key(0, MS, FaultReads()) == device.state_key(0, MS, FaultReads())

    twin.receive(b"\x55", 1)
    twin.memory["more"] = 1

    assert (device.held, twin.held) == (b"\x11", b"")
    assert (device.state.speed, twin.state.speed) == (0, 0x55)
    assert device.deadline() == 50 * MS
    assert "more" not in device.memory
    assert twin.state_key(1, MS, FaultReads()) != device.state_key(1, MS, FaultReads())


def test_a_snapshot_does_not_depend_on_when_it_is_taken(protocol: Protocol) -> None:
    def at(start: int) -> object:
        device = Simulator(protocol, faulty_by(ONE_AT_A_TIME))
        device.receive(b"\0\x90\x11", start)
        return device.state_key(start + MS, 100 * MS, FaultReads())

    assert at(5 * MS) == at(7000 * MS)


def test_a_search_follows_another_grammar(horn: Protocol) -> None:
    spec = next(s for s in horn.instructions if s.name == "Horn")
    assert any("Horn" in symbol.words for symbol in alphabet(horn))

    found = search(horn, faulty_by(when(is_named(spec), twice)))

    assert len(found.shown) == 1
    assert horn.answers[Outcome.VALID].code == 0
    assert "answers 00 00" in found.difference


def test_a_hint_is_sent(protocol: Protocol) -> None:
    odd = when(lambda event: event.before.speed == 77 and faulty(event), twice)

    assert search(protocol, faulty_by(odd, 77)).shown
