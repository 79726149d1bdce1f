"""Random faults: a seed gives one fault, seeds give different ones, and almost all can show."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.catalogue import find_fault
from bilprov.spec.protocol import Protocol, load
from tests.support.grammars import short_grammar, still_grammar

# As drawn on CPython 3.11; `random.random()` is the same for a seed in every Python.
DOCS = {
    "random:1": "instruction RotateLeft, speed >= 115: drives-on",
    "random:5": "outcome too-many, length 14: answers-with 121",
    "random:8": "instruction LED, moves rotate_left: loses-next-byte",
    "random:1.8": "outcome too-many, length 8, id 7, previous Forward: answers-with 90",
    "random:1.20": "times every 50: answers-with 2",
    "random:1.25": "truncated, size 3, known, second-byte 127: drives-on",
    "random:1.28": "always: wheels-astray half speed 224",
    "random:1.42": "instruction Forward Backward RotateRight RotateLeft, led & 4: drives-on",
}
WIDER = ("needle", "context", "rhythm", "settings", "wheels")


@pytest.mark.parametrize("name", DOCS)
def test_a_name_draws_the_same_fault_for_ever(protocol: Protocol, name: str) -> None:
    assert find_fault(protocol, name).doc == DOCS[name]


def test_the_faults_of_300_seeds_are_many_different_ones(protocol: Protocol) -> None:
    docs = [find_fault(protocol, f"random:{seed}").doc for seed in range(1, 301)]

    assert len(set(docs)) > 270
    for word in ("moves", "previous", "pipelined", "faults", "every", "led", "turns-bits", "gap"):
        assert sum(word in doc for doc in docs) >= 5, word


def test_the_wider_faults_are_of_six_families_and_many_different_ones(protocol: Protocol) -> None:
    faults = [find_fault(protocol, f"random:5.{number}") for number in range(1, 301)]

    families = Counter(fault.family for fault in faults)
    assert families.keys() == {"random", *(f"random {kind}" for kind in WIDER)}
    assert min(families.values()) >= 8, families
    assert len({fault.doc for fault in faults}) > 280
    assert {fault.doc for fault in faults} != {find_fault(protocol, "random:6.1").doc}
    for word in ("-byte", "size", "after-truncated", "every 1000", "wheels", "led &"):
        assert sum(word in fault.doc for fault in faults) >= 3, word


@pytest.mark.slow
def test_wider_faults_follow_any_grammar(each_protocol: Protocol) -> None:
    names = {spec.name for spec in each_protocol.instructions}
    for number in range(1, 201):
        fault = find_fault(each_protocol, f"random:1.{number}")
        named = re.search("instruction ([A-Za-z]+)", fault.doc)
        assert named is None or named[1] in names
        device = Simulator(each_protocol, fault)
        for turn, byte in enumerate(bytes(range(256))):
            device.receive(bytes([byte]), turn * 2 * MS)
            device.look(turn * 2 * MS)


@pytest.mark.parametrize("edited", [short_grammar, still_grammar])
def test_faults_are_drawn_of_a_grammar_with_few_lengths_or_without_motions(
    edited: Callable[[str], str], grammar_text: str
) -> None:
    small = load(edited(grammar_text), "small.py")
    lengths = {length for _, length in small.headers}

    docs = [find_fault(small, f"random:{seed}").doc for seed in range(1, 121)]
    docs += [find_fault(small, f"random:5.{number}").doc for number in range(1, 121)]

    assert len(set(docs)) > 100
    announced = [int(n) for doc in docs for n in re.findall(r"length (\d+)", doc)]
    assert lengths.issuperset(announced)
    if edited is still_grammar:
        assert not any("steering" in doc or re.search("moves [^s]", doc) for doc in docs)


@pytest.mark.parametrize(
    "name",
    ["random:", "random:x", "random:-1", "random:1.", "random:.5", "random:1.2.3", "random:²"],
)
def test_a_seed_that_is_none_is_refused(protocol: Protocol, name: str) -> None:
    with pytest.raises(ValueError, match=r"whole number, for example random:7 or random:7\.1"):
        find_fault(protocol, name)
