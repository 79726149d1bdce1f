"""A device that never gives up a frame cut short is named in one sentence, seen or not."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.dut.link import Observability
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Target, device_target
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.mutation.variants import variants
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.recheck import recheck
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.json_report import as_json
from bilprov.conformance.report.markdown import as_markdown
from bilprov.conformance.report.summary import show
from bilprov.conformance.runner.listeners.recorder import RunRecorder
from bilprov.spec.protocol import Protocol

SMOKE = Options(level="smoke")
SENTENCE = (
    "the device never gives up a frame that was cut short: the document is silent on a time-out; "
    "this kit asks for one because of section 2 (a faulty instruction stops the robot at once)"
)


def target(protocol: Protocol, name: str, *, blind: bool = False) -> Target:
    """A simulated robot with a fault or a variant's behaviour, seen by a probe or not."""
    fault = fault_bank(protocol).get(name) or variants(protocol)[name].fault
    made = device_target(protocol, Simulator(protocol, fault), name="sim", probe="sim", fault=None)
    if blind:
        sees = Observability(available=False, why="no probe")
        environment = msgspec.structs.replace(made.environment, observability=sees)
        made = replace(made, environment=environment)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("blind", [False, True])
def test_it_is_told_once_and_the_cases_that_follow_from_it_name_it(
    protocol: Protocol, blind: bool
) -> None:
    report = run_suite(target(protocol, "never-times-out", blind=blind), SMOKE)

    assert report.notices == (SENTENCE,)
    wrong = {r.id: r.reason for r in report.results if r.verdict is Verdict.FAIL}
    wrong.pop("timing/truncation-timeout", None)
    assert len(wrong) > 5
    assert all("the device never gave up the frame " in reason for reason in wrong.values())
    assert "never gave up the frame 01, which had been cut short" in wrong["truncated/Stop/1/0"]


@pytest.mark.slow
def test_every_form_of_the_report_and_a_recheck_have_the_sentence(
    protocol: Protocol, tmp_path: Path
) -> None:
    path, made = str(tmp_path / "run.mcap"), target(protocol, "never-times-out", blind=True)
    with RunRecorder(path, made) as recorder:
        report = run_suite(made, SMOKE, [recorder])
    text = Console(file=StringIO(), width=1000)
    show(report, text)

    assert isinstance(text.file, StringIO)
    assert text.file.getvalue().count(SENTENCE) == 1
    assert SENTENCE in as_markdown([report], protocol)
    assert SENTENCE in as_html([report], protocol)
    assert msgspec.json.decode(as_json(report))["notices"] == [SENTENCE]
    again = recheck(path)
    assert again.differences == ()
    assert again.report is not None
    assert again.report.notices == (SENTENCE,)


@pytest.mark.parametrize(
    "name",
    [
        *("R-truncated-known=silent", "R-truncated-known=silent-and-others-answered"),
        *(
            "R-truncation-timeout=1500-ms",
            "time-out-for-known-ids-only",
            "no-time-out-for-15-bytes",
        ),
    ],
)
def test_a_device_that_gives_up_frames_silently_or_most_of_them_is_not_meant(
    protocol: Protocol, name: str
) -> None:
    assert run_suite(target(protocol, name, blind=True), SMOKE).notices == ()
