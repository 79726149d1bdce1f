"""How long a device waits for the rest of a frame, and devices that wait for ever."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest

from bilprov.analyzer.client.operations import Ended, Procedure, drive
from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.dut.simulator import Fault, Simulator
from bilprov.conformance.dut.target import Observability, Target, device_target
from bilprov.conformance.mutation.catalogue import find_fault
from bilprov.conformance.oracle.profile import Timers
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.runner.executor import Runner
from bilprov.conformance.runner.run import Run
from bilprov.conformance.runner.truncation_timeout import measure_timeout
from bilprov.spec.protocol import Protocol
from tests.support.faults import watchdog
from tests.support.pairs import pairs
from tests.support.robots import MS, CountingLink, new_run, simulated

STEPS = 120  # operations of a measurement, at most
WATCHDOG = Fault("", "", "", react=watchdog(1000))


def measured(protocol: Protocol, fault: Fault) -> tuple[Run, CaseResult]:
    """A run that only finds out what the device chooses, and its result for the time-out."""
    run = new_run(protocol, timers=Timers(idle=2500 * MS))
    drive(Runner(run, []).execute(), CountingLink(Simulator(protocol, fault)), lambda: False)
    return run, next(result for result in run.results if result.id == "timing/truncation-timeout")


def test_a_short_time_out_that_only_the_stop_shows_is_not_taken_for_a_longer_one(
    protocol: Protocol,
) -> None:
    name = "R-truncated-known=silent-and-others-answered and R-truncation-timeout=3-ms"
    run, _ = measured(protocol, pairs(protocol)[name])

    assert run.profile.truncation_timeout is not None
    assert 3 * MS <= run.profile.truncation_timeout < 5 * MS
    assert max(result.verdict for result in run.results) < Verdict.INCONCLUSIVE


def test_the_stop_of_a_watchdog_is_not_that_of_the_time_out(protocol: Protocol) -> None:
    run, result = measured(protocol, replace(WATCHDOG, timeout=1500 * MS))

    assert run.profile.truncation_timeout == 1500 * MS
    assert result.verdict is Verdict.NON_STRICT  # for the time alone: its answer came at once
    assert set(result.axes) == {"answer", "state"}
    assert result.axes["answer"].verdict is Verdict.PASS
    assert max(result.verdict for result in run.results) < Verdict.INCONCLUSIVE


def test_a_stop_at_the_time_out_counts_although_the_answer_comes_later(
    protocol: Protocol,
) -> None:
    name = "R-answer-deadline=150-ms-after-faults"
    run, _ = measured(protocol, find_fault(protocol, name))

    assert run.profile.truncation_timeout is not None
    assert 50 * MS <= run.profile.truncation_timeout < 60 * MS


def test_a_time_out_that_never_comes_is_no_pass_where_a_watchdog_stops_the_robot(
    protocol: Protocol,
) -> None:
    _, result = measured(protocol, replace(WATCHDOG, timeout=None))

    assert result.verdict is Verdict.INCONCLUSIVE
    assert "hides the time-out" in result.axes["stop"].reason


def test_a_measurement_that_is_interrupted_after_its_answer_is_no_pass(protocol: Protocol) -> None:
    verdicts = []
    for stop_at in range(STEPS):
        run = new_run(protocol)
        link = CountingLink(Simulator(protocol))

        def script(run: Run = run) -> Procedure[bool]:
            try:
                yield from measure_timeout(run)
            except Ended:
                return False
            return True

        if not drive(script(), link, lambda link=link, at=stop_at: link.asks >= at):  # type: ignore[misc]
            verdicts += [result.verdict for result in run.results]
    assert verdicts
    assert set(verdicts) == {Verdict.INCONCLUSIVE}


SMOKE = Options(level="smoke")
SENTENCE = (
    "the device never gives up a frame that was cut short: the document is silent on a time-out; "
    "this kit asks for one because of section 2 (a faulty instruction stops the robot at once)"
)


def target(protocol: Protocol, name: str, *, blind: bool = False) -> Target:
    """A simulated robot with a fault or a variant's behaviour, seen by a probe or not."""
    made = device_target(protocol, simulated(protocol, name), name="sim", probe="sim", fault=None)
    if blind:
        sees = Observability(available=False, why="no probe")
        environment = msgspec.structs.replace(made.environment, observability=sees)
        made = replace(made, environment=environment)
    return made


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("blind", [False, True])
def test_it_is_told_once_however_many_cases_follow_from_it(protocol: Protocol, blind: bool) -> None:
    report = run_suite(target(protocol, "never-times-out", blind=blind), SMOKE)

    assert report.notices == (SENTENCE,)
    assert report.counts["fail"] > 5


@pytest.mark.parametrize(
    "name",
    [
        *("R-truncated-known=silent", "R-truncated-known=silent-and-others-answered"),
        *("R-truncation-timeout=1500-ms", "time-out-for-known-ids-only"),
        "no-time-out-for-15-bytes",
    ],
)
def test_a_device_that_gives_up_frames_silently_or_most_of_them_is_not_meant(
    protocol: Protocol, name: str
) -> None:
    assert run_suite(target(protocol, name, blind=True), SMOKE).notices == ()
