"""Most faults are tried at a low speed; what a motor does not turn at decides no verdict."""

from __future__ import annotations

from fnmatch import fnmatchcase

import pytest

from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.dut.fault import Event, Fault, Reaction
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.profile import Timers
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.homing import preamble_of
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.spec.by_effect import moving_motions
from bilprov.spec.protocol import InstructionSpec, Protocol
from tests.support.robots import ALL_SEEING, cases_of

FAULTS = "bad-data/LED/*"
TIRED = 100  # cases, of 248


class Motor(Simulator):
    """A robot whose wheels turn above a speed only; notes the speeds at which faults reached it.

    The probe tells whether it moves. A motor that is `tiring` needs four times that speed after so
    many faults: from a fault on, or from a preamble on.
    """

    def __init__(self, protocol: Protocol, dead: int, tiring: str = "") -> None:
        super().__init__(protocol, Fault("noting", "test", "", react=self._note))
        self.driven: list[int] = []
        self._dead, self._tiring, self._tired = dead, tiring, False
        self._last: tuple[str, ...] = ()

    def _note(self, device: object, event: Event, reaction: Reaction) -> Reaction:
        instruction = event.judgement.instruction
        fault = not event.judgement.valid
        if fault and instruction and instruction.effect.sets("led"):
            self.driven.append(event.before.speed)
        self._last = (*self._last[-2:], "" if fault else variables(instruction))
        now = fault if self._tiring == "fault" else self._last == ("speed", "led", "motion")
        self._tired |= bool(self._tiring and now and len(self.driven) >= TIRED)
        return reaction

    def look(self, now: int) -> Look:
        moves = self.state.moving and self.state.speed > self._dead * (4 if self._tired else 1)
        return CarLook(super().look(now).t, moves)


def variables(instruction: InstructionSpec | None) -> str:
    return " ".join(name for name, _ in instruction.effect.assignments) if instruction else ""


def run(protocol: Protocol, motor: Motor) -> Report:
    return conform(motor, grammar=protocol, options=Options(only=(FAULTS,)), logged=False)


def verdicts(report: Report) -> set[Verdict]:
    return {result.verdict for result in report.results if fnmatchcase(result.id, FAULTS)}


@pytest.mark.parametrize(
    ("dead", "most"), [(0, 30), (14, 30), (15, 62), (40, 126), (63, None), (100, None)]
)
def test_faults_are_tried_at_twice_the_lowest_speed_that_is_seen(
    protocol: Protocol, dead: int, most: int | None
) -> None:
    motor = Motor(protocol, dead)

    report = run(protocol, motor)

    assert report.profile.preamble_speed == most
    assert verdicts(report) == {Verdict.PASS}
    slow = [speed for speed in motor.driven if speed == most]
    assert len(slow) > len(motor.driven) * 0.9 if most else not slow


def test_what_keeps_its_speed(protocol: Protocol) -> None:
    run = Run(RunConfig(protocol, Timers(), ALL_SEEING))
    run.profile.preamble_speed, run.profile.moves = 30, set(moving_motions(protocol))

    slow = [case for case in cases_of(protocol) if preamble_of(run, case) != case.setup]

    rest = [case for case in cases_of(protocol) if preamble_of(run, case) == case.setup]
    assert all(preamble_of(run, case).speed == 30 for case in slow)
    assert {case.kind for case in slow} == set(FrameClass) - {FrameClass.VALID}
    assert all(case.thorough or case.kind is FrameClass.VALID for case in rest)
    assert not any(case.thorough for case in slow)


def test_a_wrong_answer_is_not_explained_by_a_motor(protocol: Protocol) -> None:
    """A single one, and from then on the wheels do not turn at the speed of the preambles."""

    class Lying(Motor):
        def advance(self, now: int) -> bytes:
            data = super().advance(now)
            if data and len(self.driven) == TIRED and not self._tired:
                self._tired = True
                return bytes(code ^ 1 for code in data)
            return data

    report = run(protocol, Lying(protocol, 25))

    failed = [result for result in report.results if result.verdict is Verdict.FAIL]
    assert [result.axes["answer"].verdict for result in failed] == [Verdict.FAIL]


@pytest.mark.parametrize("tiring", ["fault", "preamble"])
def test_a_motor_that_needs_more_later_is_tried_at_the_speeds_of_the_cases(
    protocol: Protocol, tiring: str
) -> None:
    motor = Motor(protocol, 25, tiring)

    report = run(protocol, motor)

    assert verdicts(report) == {Verdict.PASS}
    assert report.profile.preamble_speed is None
    assert min(motor.driven[:TIRED]) == 62
    assert min(motor.driven[TIRED + 9 :]) > 126
