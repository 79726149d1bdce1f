"""Random faults: a seed gives one fault, seeds give different ones, and almost all can show."""

from __future__ import annotations

import subprocess
import sys

import pytest

from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.catalogue import find_fault
from bilprov.conformance.mutation.random_faults import Draw, random_fault
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.commands import command
from tests.support.robots import sentence

# As drawn on CPython 3.11; `random.random()` is the same for a seed in every Python.
DOCS = {
    1: "a valid RotateLeft, while it stands: moves it rotate_right",
    2: "any fault, while it moves rotate_left, with an even announced length: is answered again "
    "12 ms later",
    8: "a valid LED: is answered and not carried out",
}


@pytest.mark.parametrize("seed", DOCS)
def test_a_seed_draws_the_same_fault_for_ever(protocol: Protocol, seed: int) -> None:
    assert random_fault(protocol, seed).doc == DOCS[seed]


def test_a_seed_draws_the_same_in_another_process_with_other_hashes() -> None:
    text = (
        "from bilprov.analyzer.grammar_file import load_protocol\n"
        "from bilprov.conformance.mutation.random_faults import random_fault\n"
        "protocol = load_protocol()\n"
        "print([random_fault(protocol, seed).doc for seed in range(40)])"
    )
    told = {
        subprocess.run(
            [sys.executable, "-c", text],
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": str(ROOT / "src")},
            capture_output=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }

    assert len(told) == 1


def test_draws_cover_their_range() -> None:
    draw = Draw(1)

    assert {draw.between(2, 5) for _ in range(200)} == {2, 3, 4, 5}
    assert {draw.pick("abc") for _ in range(100)} == set("abc")


def test_the_faults_of_300_seeds_are_many_different_ones(protocol: Protocol) -> None:
    docs = [random_fault(protocol, seed).doc for seed in range(1, 301)]

    assert len(set(docs)) > 270
    for word in ("moves", "right after", "sent ahead", "faults", "every", "light", "bit", "ms"):
        assert sum(word in doc for doc in docs) >= 5, word


def test_they_follow_another_grammar(horn: Protocol) -> None:
    docs = [random_fault(horn, seed).doc for seed in range(100)]

    assert any("Horn" in doc for doc in docs)


def test_any_bytes_leave_a_random_fault_with_a_state_that_can_be_looked_at(
    protocol: Protocol,
) -> None:
    for seed in range(60):
        device = Simulator(protocol, find_fault(protocol, f"random:{seed}"))
        device.receive(bytes(range(256)), 0)
        device.advance(10**10)
        look = device.look(10**10)
        assert look.led is not None
        assert 0 <= look.led <= 255


@pytest.mark.parametrize("name", ["random:", "random:x", "random:-1", "random:1.5", "random:²"])
def test_a_seed_that_is_none_is_refused(protocol: Protocol, name: str) -> None:
    with pytest.raises(ValueError, match="whole number, for example random:7"):
        find_fault(protocol, name)


def test_the_command_takes_a_random_fault() -> None:
    result = command("conform", "sim", "--fault", "random:8", "--only", "valid/LED/*")

    assert result.returncode == 1, result.stderr


def test_the_command_refuses_an_unknown_fault_in_one_sentence() -> None:
    result = command("conform", "sim", "--fault", "random:x")

    assert result.returncode == 2
    assert "random:7" in sentence(result)
