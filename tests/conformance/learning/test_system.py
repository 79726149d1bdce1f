"""The system under learning: what tries that disagree leave behind, and what is heard late."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from bilprov.analyzer.client.operations import drive
from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.dut.link import Observability
from bilprov.conformance.dut.simulator import Event, Fault, React, Reaction, Simulator, answers
from bilprov.conformance.dut.virtual_link import VirtualLink
from bilprov.conformance.learning.learner import Difference, NotLearned, System
from bilprov.conformance.learning.reference import Output, alphabet, reference_machine
from bilprov.conformance.oracle.choices import Choices
from bilprov.conformance.oracle.profile import Profile
from bilprov.conformance.oracle.state_model import Model
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from tests.support.faults import is_outcome, made, then, when
from tests.support.robots import BYTE_TIME, Timers

WRONG = 0x55


def system(protocol: Protocol, device: Simulator, *, looks: bool = False) -> System:
    config = RunConfig(protocol, Timers(), Observability(looks))
    run = Run(config, Profile(choices=Choices()))
    steps = alphabet(protocol)
    reference = reference_machine(Model(protocol, Choices()), steps)
    link = VirtualLink(device, BYTE_TIME)
    return System(run, lambda procedure: drive(procedure, link), steps, reference)


def letters(protocol: Protocol, *frames: str) -> bytes:
    steps = [step.frame for step in alphabet(protocol)]
    return bytes(steps.index(bytes.fromhex(frame)) for frame in frames)


def answering(outcome: Outcome, codes: Sequence[int]) -> React:
    """Such a frame is answered with these codes, one a time, and with the last of them for ever."""

    def change(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        turn = device.memory[outcome.name] = device.memory.get(outcome.name, -1) + 1
        return answers(reaction, codes[min(turn, len(codes) - 1)])

    return when(is_outcome(outcome), change)


def robot(protocol: Protocol, *reacts: React) -> Simulator:
    return Simulator(protocol, Fault("x", "test", "", react=then(*reacts)))


class AlmostBlind(Simulator):
    """A robot of which is seen whether it moves, and nothing else."""

    def look(self, now: int) -> Look:
        return CarLook(t=now, moving=super().look(now).moving)


def test_what_is_seen_twice_and_contradicts_what_was_known_is_a_deviation(
    protocol: Protocol,
) -> None:
    asked = system(protocol, robot(protocol, answering(Outcome.UNKNOWN_ID, [1, WRONG])))
    unused, stop = letters(protocol, "90"), letters(protocol, "00")
    assert asked.outputs(unused) == (Output((1,)),)

    with pytest.raises(NotLearned, match="one outcome first"):
        asked.outputs(unused + stop)

    assert asked.deviations == (Difference(unused, Output((1,)), Output((WRONG,))),)
    assert asked.sent.flaky == 1


def test_tries_that_all_disagree_teach_nothing(protocol: Protocol) -> None:
    asked = system(protocol, robot(protocol, answering(Outcome.BAD_DATA, range(100, 200))))

    with pytest.raises(NotLearned, match="6 different outcomes"):
        asked.outputs(letters(protocol, "81 08"))

    assert asked.deviations == ()
    assert asked.sent.flaky == 6


def test_a_deviation_is_told_with_the_facets_that_are_seen(protocol: Protocol) -> None:
    fault = robot(protocol, answering(Outcome.UNKNOWN_ID, [WRONG])).fault
    asked = system(protocol, AlmostBlind(protocol, fault), looks=True)
    word = letters(protocol, "90")

    asked.outputs(word)

    due = Output((1,), moving=False)
    assert asked.deviations == (Difference(word, due, due._replace(codes=(WRONG,))),)


def test_a_setting_that_is_never_answered_is_the_devices_way(protocol: Protocol) -> None:
    asked = system(protocol, Simulator(protocol, made(protocol, "silent", "instruction LED")))

    assert asked.outputs(letters(protocol, "00")) == (Output((0,)),)
