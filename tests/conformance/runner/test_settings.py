"""A robot that was never seen moving: it has no motor power, or obeys only in some settings."""

from __future__ import annotations

import pytest

from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.fault import Event, Fault, React
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.settings import IDENT, settings
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
from tests.support.faults import accepts, becomes, every, valid, when
from tests.support.robots import Hidden


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
