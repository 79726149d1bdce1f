"""Devices that are learned: faulty robots, other readings, bad lines, and without a probe."""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Any

import pytest

from benchmarks.noisy_device import NoisyDevice
from bilprov.analyzer.client.operations import Listen, Observation, Observe, Received, Send, drive
from bilprov.analyzer.taps.relay import Noise
from bilprov.captures.schemas import MS
from bilprov.conformance.dut.simulator import Event, Fault, React, Reaction, Simulator, answers
from bilprov.conformance.dut.target import Device, Observability, VirtualLink, device_target
from bilprov.conformance.learning.learner import (
    Difference,
    Learned,
    NotLearned,
    Output,
    System,
    alphabet,
    learn_target,
    output_of,
    reference_machine,
    reset,
)
from bilprov.conformance.machines.wp_method import Mealy
from bilprov.conformance.mutation.catalogue import find_fault
from bilprov.conformance.oracle.profile import Choices, Profile
from bilprov.conformance.oracle.state_model import Model
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from tests.support.faults import Condition, is_outcome, made, silent, then, twice, when
from tests.support.robots import BYTE_TIME, Blind, Timers


def learn(protocol: Protocol, device: Any, *, seed: int = 1) -> Learned:
    return learn_target(device_target(protocol, device), seed=seed)


def faulty(protocol: Protocol, name: str) -> Simulator:
    return Simulator(protocol, find_fault(protocol, name))


def outputs(protocol: Protocol, device: Device, learned: Learned, word: Any) -> list[Output]:
    """What a device does from power-on when it is sent a sequence, behind the settings of rest."""
    link = VirtualLink(device, BYTE_TIME)
    seen = []
    for frame in (*reset(protocol), *learned.frames_of(word)):
        link.do(Send(frame))
        heard, look = link.do(Listen(None, 100 * MS)), link.do(Observe())
        assert isinstance(heard, Received)
        assert isinstance(look, Observation)
        seen.append(output_of(protocol, heard.codes, look.look))
    return seen[-len(word) :]


# Faults that representative data can show, and how many frames the shortest sequence has.
SHOWN = {
    "silent-on-faults": 1,
    "fault-changes-led": 1,
    "rotateleft-does-nothing": 2,
    "no-stop-on-truncated": 3,
    "steering-swapped": 3,
    "stop-ignored-after-led": 4,
    "restarts-on-led-after-a-fault": 4,
}


ONE = "rotateleft-does-nothing"  # that is soon learned; the others only where every row is run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "frames"),
    [
        pytest.param(name, frames, marks=[pytest.mark.sample(0)] * (name != ONE))
        for name, frames in SHOWN.items()
    ],
)
def test_a_faulty_robot_differs_by_shortest_sequences_that_show_the_fault_again(
    protocol: Protocol, name: str, frames: int
) -> None:
    learned = learn(protocol, faulty(protocol, name))

    assert (learned.exit, learned.trouble) == (1, "")
    assert len(learned.differences[0].word) == frames
    for one in learned.differences:
        due = outputs(protocol, Simulator(protocol), learned, one.word)
        got = outputs(protocol, faulty(protocol, name), learned, one.word)
        assert due[:-1] == got[:-1]
        assert one.expected.fits(due[-1])
        assert one.actual == got[-1] != due[-1]


@pytest.mark.slow
@pytest.mark.sample(0)
@pytest.mark.parametrize(
    ("variant", "states"),
    [
        ("R-drive-steering=straight", 36),
        ("R-stop-steering=kept-by-faults-too", 60),
        ("R-truncated-known=silent", 60),
        ("R-drain-known=flushed-after-any", 60),
        ("R-stop-latency=50-ms", 60),
        ("R-speed-moving=next-motion", 60),
    ],
)
def test_another_reading_is_named_and_no_difference(
    protocol: Protocol, variant: str, states: int
) -> None:
    learned = learn(protocol, faulty(protocol, variant))

    assert (learned.exit, learned.differences) == (0, ())
    assert learned.machine is not None
    assert len(learned.machine) == states
    points = [point.partition(" ")[0] for point in learned.report.profile.other_readings]
    assert variant.partition("=")[0] in [*points, "R-stop-latency"]


def test_every_run_gives_the_same(protocol: Protocol) -> None:
    first, again = (learn(protocol, Blind(faulty(protocol, "codes-reversed"))) for _ in range(2))

    assert first == again
    assert first.exit == 1


def test_without_a_probe_answers_alone_are_learned_which_is_no_pass(
    each_protocol: Protocol,
) -> None:
    learned = learn(each_protocol, Blind(Simulator(each_protocol)))

    assert learned.machine is not None
    assert len(learned.machine) == 1
    assert (learned.exit, learned.seen, learned.differences) == (3, (), ())


def test_without_a_probe_a_wrong_code_is_a_difference(protocol: Protocol) -> None:
    learned = learn(protocol, Blind(faulty(protocol, "wrong-code-for-bad-data")))

    assert learned.exit == 1
    assert {len(one.word) for one in learned.differences} == {1}
    assert learned.send_line(learned.differences[0]).startswith("bilprov send PORT ")


def test_a_rhythm_is_no_pass_though_no_sequence_shows_it_twice(protocol: Protocol) -> None:
    device = Blind(faulty(protocol, "every-100th-frame-unanswered"))

    learned = learn(protocol, device)
    assert learned.sent.flaky > 0
    assert learned.exit == 1


def sent_ahead(event: Event) -> bool:
    """A stop of homing."""
    return event.pipelined and event.judgement.valid


def at_times(condition: Condition, change: React, turns: Container[int]) -> Fault:
    """A robot that misbehaves at some frames of this kind, by their count."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        if not condition(event):
            return reaction
        turn = device.memory["turn"] = device.memory.get("turn", 0) + 1
        return change(device, event, reaction) if turn in turns else reaction

    return Fault("between", "test", "", react=react)


@pytest.mark.sample(0)
@pytest.mark.parametrize(
    ("condition", "change", "turns", "case"),
    [
        (sent_ahead, silent, range(300, 1 << 20, 300), "line/lost"),
        (sent_ahead, twice, [400], "line/unsolicited"),
    ],
)
@pytest.mark.slow
def test_what_a_robot_does_between_the_sequences_counts(
    protocol: Protocol, condition: Condition, change: React, turns: Container[int], case: str
) -> None:
    fault = at_times(condition, change, turns)
    learned = learn(protocol, Simulator(protocol, fault))
    assert learned.machine is not None
    assert [ident for ident, _ in learned.beside] == [case]
    assert learned.exit == 1

    robot = Simulator(protocol, fault)
    robot.lossless = False
    learned = learn(protocol, Blind(robot))
    assert learned.sent.flaky == 1
    assert learned.verdict is Verdict.INCONCLUSIVE


@pytest.mark.slow
def test_what_begins_late_and_then_stays_is_a_difference(protocol: Protocol) -> None:
    learned = learn(protocol, faulty(protocol, "dark-after-40000-frames"))

    assert learned.machine is None
    assert (learned.exit, len(learned.differences), learned.sent.flaky) == (1, 1, 1)


@pytest.mark.sample(0)
@pytest.mark.slow
def test_a_bad_line_changes_nothing_about_the_machine(protocol: Protocol) -> None:
    robot = faulty(protocol, "R-drive-steering=straight")
    learned = learn(protocol, NoisyDevice(robot, Noise(1e-4, 1e-4, 1e-4), 3))

    assert learned.machine is not None
    assert (len(learned.machine), learned.differences) == (36, ())
    assert "R-drive-steering" in learned.report.profile.other_readings
    assert learned.sent.flaky > 0
    assert learned.verdict is Verdict.INCONCLUSIVE


def test_what_contradicts_itself_ends_in_one_sentence(protocol: Protocol) -> None:
    device = NoisyDevice(Blind(Simulator(protocol)), Noise(flipped=0.03), seed=1)
    learned = learn(protocol, Blind(device))

    assert learned.machine is None
    assert learned.trouble
    assert "\n" not in learned.trouble
    assert learned.exit in (1, 3)


def test_a_line_of_send_names_the_grammar_that_it_needs(horn: Protocol) -> None:
    learned = learn(horn, Blind(Simulator(horn)))
    word = bytes([learned.names.index("Horn sound=3")])

    line = learned.send_line(Difference(word, Output((0,)), Output((1,))))
    assert line.startswith("bilprov --grammar horn.py send PORT")
    assert line.endswith("'Horn 3'")


# -- tries that disagree ---------------------------------------------------------------------------


WRONG = 0x55


def reference(protocol: Protocol) -> Mealy[Output]:
    return reference_machine(Model(protocol, Choices()), alphabet(protocol))


def system(protocol: Protocol, device: Simulator, *, looks: bool = False) -> System:
    config = RunConfig(protocol, Timers(), Observability(looks))
    run = Run(config, Profile(choices=Choices()))
    link = VirtualLink(device, BYTE_TIME)
    return System(
        run, lambda procedure: drive(procedure, link), alphabet(protocol), reference(protocol)
    )


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


def test_a_setting_that_is_never_answered_is_the_devices_way(protocol: Protocol) -> None:
    asked = system(protocol, Simulator(protocol, made(protocol, "silent", "instruction LED")))

    assert asked.outputs(letters(protocol, "00")) == (Output((0,)),)
