"""A deviation that was there before the frame under test is reported with its preamble."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bilprov.conformance.api import Options, conform, run_suite
from bilprov.conformance.dut.fault import Event, Fault, Reaction
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import device_target
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.recheck import recheck
from bilprov.conformance.report.markdown import as_markdown
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.listeners.recorder import RunRecorder
from bilprov.spec.protocol import Protocol

ONLY = Options(only=("valid/Speed/*", "valid/LED/*"))


def _in_eight_bits(_: object, event: Event, reaction: Reaction) -> Reaction:
    steering = (reaction.state.steering + 128) % 256 - 128
    return replace(reaction, state=reaction.state.but(steering=steering))


EIGHT_BITS = Fault("eight-bits", "test", "keeps its steering in eight bits", react=_in_eight_bits)


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


def test_a_recheck_names_the_preamble_too(protocol: Protocol, tmp_path: Path) -> None:
    path = str(tmp_path / "run.mcap")
    device = Simulator(protocol, EIGHT_BITS)
    target = device_target(protocol, device, name="sim", probe="sim", fault=None)
    with RunRecorder(path, target) as recorder:
        report = run_suite(target, Options(only=("valid/Speed/2",)), [recorder])

    again = recheck(path)

    assert again.differences == ()
    assert again.report is not None
    told = [[result.reason for result in failed(one)] for one in (report, again.report)]
    assert told[0] == told[1]
    assert any("after its preamble" in reason for reason in told[0])
