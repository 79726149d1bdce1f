"""Preambles: found and waited for; robots never seen moving, and speeds that decide nothing."""

from __future__ import annotations

from dataclasses import replace
from fnmatch import fnmatchcase

import pytest

from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.dut.simulator import Event, Fault, React, Reaction, Simulator
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report.markdown import as_markdown
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.homing import preamble_of
from bilprov.conformance.runner.settings import IDENT, settings
from bilprov.spec.by_effect import moving_motions
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import InstructionSpec, Protocol
from tests.support.faults import EIGHT_BITS, accepts, becomes, every, valid, when
from tests.support.robots import Hidden, cases_of, new_run

ONLY = Options(only=("valid/Speed/2*", "valid/LED/*"))


def failed(report: Report) -> list[CaseResult]:
    return [result for result in report.results if result.verdict is Verdict.FAIL]


def test_what_the_preamble_did_wrong_is_not_booked_on_the_frame_under_test(
    protocol: Protocol,
) -> None:
    report = conform(Simulator(protocol, EIGHT_BITS), options=ONLY)

    wrong = failed(report)
    assert len(wrong) > 10
    for result in wrong:
        if result.id.startswith("valid/"):
            reason = result.axes["state"].reason
            assert reason.startswith("already so before the frame under test, after its preamble ")
            assert ": steering is " in reason
            assert result.sent[0][:1] in ("1", "8")  # the stimulus, as before
    speed = next(result for result in wrong if result.id == "valid/Speed/2")
    assert "51 " in speed.reason or "41 " in speed.reason
    assert "already so before the frame under test" in as_markdown([report], protocol)


@pytest.mark.slow
def test_what_the_frame_under_test_did_wrong_is_its_own(protocol: Protocol) -> None:
    def react(_: object, event: Event, reaction: Reaction) -> Reaction:
        led = event.judgement.valid and event.judgement.name == "LED"
        return replace(reaction, state=reaction.state.but(led=0)) if led else reaction

    dark = Fault("dark", "test", "its LED never lights", react=react)

    report = conform(Simulator(protocol, dark), options=ONLY)

    wrong = {result.id: result.reason for result in failed(report)}
    assert wrong["valid/LED/5"] == "led is 0, expected 5"
    assert "already so" in wrong["valid/Speed/2"]


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


@pytest.mark.sample(1)
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
    run = new_run(protocol)
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


def fast(event: Event) -> bool:
    return event.before.speed >= 32


def blue(event: Event) -> bool:
    return bool(event.before.led & 4)


def sets_motion(event: Event) -> bool:
    instruction = event.judgement.instruction
    return instruction is not None and instruction.effect.sets("motion")


def run_of(protocol: Protocol, react: React, *, power: bool, level: str = "smoke") -> Report:
    robot = Simulator(protocol, Fault("x", "test", "", react=react))
    device = robot if power else Hidden(robot)
    return conform(device, grammar=protocol, options=Options(level=level), logged=False)


def told(report: Report) -> list[str]:
    return [r.reason for r in report.results if r.id == IDENT]


@pytest.mark.parametrize(
    ("condition", "words"),
    [
        (fast, "moves with speed 1 after power-on, not with speed 255"),
        (blue, "moves with speed 255 after power-on, not with led 4"),
    ],
)
def test_a_setting_after_which_nothing_is_obeyed_is_named(
    protocol: Protocol, condition: object, words: str
) -> None:
    report = run_of(protocol, when(every(valid, condition), accepts), power=True)  # type: ignore[arg-type]

    assert report.exit == 1
    assert told(report) == [words]


@pytest.mark.parametrize("condition", [fast, blue])
def test_without_a_power_switch_what_followed_and_no_more_follows_fails(
    protocol: Protocol, condition: object
) -> None:
    report = run_of(protocol, when(every(valid, condition), accepts), power=False)  # type: ignore[arg-type]

    assert report.exit == 1
    failed = [r for r in report.results if r.verdict is Verdict.FAIL]
    assert any(r.reason.startswith("led is ") for r in failed)
    assert all("motor power" not in r.reason for r in failed)


@pytest.mark.parametrize("power", [False, True])
def test_a_motion_that_is_not_obeyed_at_high_speed_fails(protocol: Protocol, power: bool) -> None:
    report = run_of(protocol, when(every(valid, fast, sets_motion), accepts), power=power)

    assert told(report) == ["moves with speed 1, not with speed 255"]


@pytest.mark.parametrize("power", [False, True])
def test_without_motor_power_nothing_moves_and_nothing_fails(
    protocol: Protocol, power: bool
) -> None:
    off = becomes(lambda event, state: state.but(motion=Motion.STOPPED))

    report = run_of(protocol, off, power=power)

    assert report.exit == 3
    assert told(report) == []
    assert any("is the motor power on?" in r.reason for r in report.results)


def test_motor_power_that_is_switched_on_meanwhile_is_no_failure(protocol: Protocol) -> None:
    def off(event: Event) -> bool:
        return event.frames < 120

    react = when(off, becomes(lambda event, state: state.but(motion=Motion.STOPPED)))

    assert told(run_of(protocol, react, power=False)) == []


@pytest.mark.sample(1)
def test_another_grammar_is_tried_in_its_own_settings(each_protocol: Protocol) -> None:
    found = list(settings(each_protocol))
    _, top = each_protocol.limits["speed"]

    assert found[0].words == f"speed {top}"
    every_motion = when(every(valid, lambda event: event.before.speed >= 2, sets_motion), accepts)
    report = run_of(each_protocol, every_motion, power=True)
    assert report.exit == 1
    # Where a motion brings its own speed, the robot was seen moving.
    if not any(s.effect.sets("motion") and s.fields for s in each_protocol.instructions):
        assert told(report) == [f"moves with speed 1, not with speed {top}"]
