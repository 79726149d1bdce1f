"""The level complete: its sequences spell the words of the proof, and find every other machine."""

from __future__ import annotations

from collections import Counter
from random import Random

import pytest

from bilprov.captures.schemas import MS, Look
from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.byte_machine import byte_machine
from bilprov.conformance.cases.proof import PROOFS, proof_sequences, suite
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.machines.wp_method import Mealy, Output, minimal
from bilprov.conformance.oracle.profile import Figures
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import proven
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol
from tests.support.robots import simulated

ANSWERS, MOTION, STATE = PROOFS
ONLY_ANSWERS = Options(level="complete", only=("complete/answers/*",))


class MachineDevice:
    """A device that is a Mealy machine over the byte classes; it shows nothing but answers."""

    def __init__(self, protocol: Protocol, machine: Mealy[Output]) -> None:
        known = byte_machine(protocol, None)
        self._machine, self._silence = machine, known.silence
        self._inputs = {byte: n for n, members in enumerate(known.classes) for byte in members}
        self._timeout = int(protocol.timing.truncation_timeout * 1_000_000)
        self._state = 0
        self._due: int | None = None
        self._answers = bytearray()

    def receive(self, data: bytes, now: int) -> None:
        self._settle(now)
        for byte in data:
            self._step(self._inputs[byte])
        self._due = now + self._timeout

    def advance(self, now: int) -> bytes:
        self._settle(now)
        sent = bytes(self._answers)
        self._answers.clear()
        return sent

    def deadline(self) -> int | None:
        return self._due

    def _settle(self, now: int) -> None:
        if self._due is not None and self._due <= now:
            self._due = None
            self._step(self._silence)

    def _step(self, symbol: int) -> None:
        code, _ = self._machine.outputs[self._state][symbol]  # type: ignore[misc]
        if code is not None:
            self._answers.append(code)
        self._state = self._machine.targets[self._state][symbol]


def other_machine(draw: Random, machine: Mealy[Output]) -> Mealy[Output]:
    """The machine with one transition changed, in a way that shows."""
    while True:
        targets, outputs = list(map(list, machine.targets)), list(map(list, machine.outputs))
        state, symbol = draw.randrange(len(machine)), draw.choice(machine.inputs)
        if draw.random() < 0.7:
            targets[state][symbol] = draw.randrange(len(machine))
        else:
            outputs[state][symbol] = draw.choice([(None, None), (0, None), (3, None)])
        changed = Mealy(tuple(map(tuple, targets)), tuple(map(tuple, outputs)))
        if minimal(changed) != minimal(machine):
            return changed


@pytest.mark.slow
def test_the_device_that_is_the_machine_itself_passes(protocol: Protocol) -> None:
    report = conform(
        MachineDevice(protocol, byte_machine(protocol, None).machine),
        grammar=protocol,
        options=ONLY_ANSWERS,
        logged=False,
    )

    own = [r for r in report.results if r.id.startswith("complete/")]
    assert own
    assert {r.axes["answer"].verdict for r in own} == {Verdict.PASS}
    assert report.proof.startswith("Proven")
    assert "33 states, 43 classes of bytes and the silence" in report.proof
    assert "no probe reported the robot's motion" in report.proof


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_a_device_with_one_other_transition_is_found(protocol: Protocol, seed: int) -> None:
    machine = other_machine(Random(f"device {seed}"), byte_machine(protocol, None).machine)
    report = conform(
        MachineDevice(protocol, machine), grammar=protocol, options=ONLY_ANSWERS, logged=False
    )

    assert report.exit == 1
    assert not report.proof.startswith("Proven")


@pytest.mark.slow
def test_the_sequences_send_every_byte_and_end_each_word_with_the_reset(protocol: Protocol) -> None:
    reset = bytes([protocol.pad_byte]) * protocol.longest_frame
    sent: Counter[int] = Counter()
    for proof in (ANSWERS, MOTION):
        cases = list(proof_sequences(protocol, proof, 1, 0))
        words = suite(protocol, proof, 0).words
        resets = sum(burst.data.endswith(reset[1:]) for case in cases for burst in case.bursts)
        assert resets >= len(words)
        for case in cases:
            assert case.bursts[0].data == reset
            assert case.facets == proof.facets(protocol)
            sent.update(b"".join(case.sent))

    assert set(sent) == set(range(256))


def test_a_seed_gives_the_same_sequences_and_another_others(protocol: Protocol) -> None:
    first, again, other = (
        next(iter(proof_sequences(protocol, ANSWERS, seed, 0))) for seed in (1, 1, 2)
    )

    assert first == again
    assert first.sent != other.sent


def test_a_word_is_followed_at_the_places_under_test_by_a_pause_or_an_answer(
    protocol: Protocol,
) -> None:
    words = suite(protocol, ANSWERS, 0)

    assert all(words.places(word) for word in words.words if word)
    pauses = [
        burst.pauses
        for case in proof_sequences(protocol, ANSWERS, 1, 0)
        for burst in case.bursts
        if burst.pauses
    ]
    assert len(pauses) > 1000
    assert max(map(len, pauses)) <= 4


def test_too_many_words_are_refused_in_one_sentence(protocol: Protocol) -> None:
    with pytest.raises(UserError, match=r"^--extra 3 takes 123,687,168 words .* smaller N"):
        suite(protocol, ANSWERS, 3)


@pytest.mark.slow
def test_a_device_that_reads_the_document_otherwise_passes_but_nothing_is_proven(
    protocol: Protocol,
) -> None:
    device = simulated(protocol, "R-truncated-long=too-many")
    report = conform(device, grammar=protocol, options=ONLY_ANSWERS, logged=False)

    assert report.exit == 0
    assert not report.proof.startswith("Proven")
    assert "differently from the machine (R-truncated-long)" in report.proof


@pytest.mark.slow
def test_a_part_of_the_sequences_proves_nothing(protocol: Protocol) -> None:
    options = Options(level="complete", only=("complete/answers/000?",))
    report = conform(grammar=protocol, options=options, logged=False)

    assert report.exit == 0
    assert (
        "Nothing is proven by answers: 9 of its 17 sequences were run and passed." in report.proof
    )
    assert conform(options=Options(only=("valid/Stop",)), logged=False).proof is None


class GapDevice:
    """The reference; counts the silences on its line that last at least so many ns."""

    lossless = True

    def __init__(self, protocol: Protocol, least: int) -> None:
        self._device, self._least, self._last = Simulator(protocol), least, 0
        self.advance, self.deadline = self._device.advance, self._device.deadline
        self.gaps = 0

    def receive(self, data: bytes, now: int) -> None:
        self.gaps += now - self._last >= self._least
        self._last = now
        self._device.receive(data, now)


class SeeingGapDevice(GapDevice):
    def look(self, now: int) -> Look:
        return self._device.look(now)


@pytest.mark.slow
def test_silences_between_frames_are_kept_where_no_probe_sees_the_robot(protocol: Protocol) -> None:
    least = int(protocol.timing.truncation_timeout * MS)
    seeing, blind = SeeingGapDevice(protocol, least), GapDevice(protocol, least)
    for device in (seeing, blind):
        report = conform(device, grammar=protocol, options=ONLY_ANSWERS, logged=False)
        assert report.proof.startswith("Proven: ")

    assert min(blind.gaps, seeing.gaps) > 50


@pytest.mark.parametrize(
    ("profile", "why"),
    [
        ({"truncation_timeout_ms": 500}, "the time-out is 500 ms, and the silences between frames"),
        (
            {"truncation_timeout_ms": 50, "all_but_two_answers_ms": 25},
            "answers take up to 25 ms and the time-out is 50 ms",
        ),
    ],
)
def test_what_the_profile_says_may_leave_nothing_proven(
    protocol: Protocol, profile: dict[str, float], why: str
) -> None:
    told = proven(protocol, [], Options(level="complete"), Figures(**profile))

    assert told.startswith(f"Nothing is proven by answers: {why}")
