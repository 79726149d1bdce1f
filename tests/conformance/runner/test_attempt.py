"""One attempt at a case: it returns a result, whatever stopped it, and publishes nothing."""

from __future__ import annotations

from typing import Any

import pytest

from bilprov.analyzer.client.operations import Ended, Procedure, drive, followed
from bilprov.conformance.cases.case import Case
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator, answers
from bilprov.conformance.oracle.profile import Profile, Timers
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.runner.homing import home
from bilprov.conformance.runner.retry import Attempt, attempt
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.conformance.runner.truncation_timeout import measure_timeout
from bilprov.conformance.runner.waiting import GaveUp
from bilprov.spec.protocol import Protocol
from tests.support.robots import ALL_SEEING, MS, CountingLink, case_of

STEPS = 120  # operations of one attempt at a short case, at most


@pytest.fixture
def run(protocol: Protocol) -> Run:
    return Run(RunConfig(protocol, Timers(), ALL_SEEING), Profile(truncation_timeout=50 * MS))


def tried(run: Run, device: Any, case: Any, stop_at: int | None = None) -> Attempt:
    """One attempt on a homed line; interrupted before that operation of it."""
    link = CountingLink(device)
    drive(home(run), link, lambda: False)
    start = link.asks
    return drive(
        followed(attempt(run, case), run.sight),
        link,
        lambda: stop_at is not None and link.asks - start >= stop_at,
    )


def answers_late(protocol: Protocol, case: Case, delay: int) -> Simulator:
    """A device whose answer to the case's frame comes `delay` ns too late, and well else."""

    def react(device: Any, event: Event, reaction: Reaction) -> Reaction:
        if event.judgement.frame != case.frame:
            return reaction
        ((time, code),) = reaction.answers
        return answers(reaction, code, delay=time + delay)

    return Simulator(protocol, Fault("x", "test", "", react=react))


def test_an_attempt_returns_its_result_and_publishes_nothing(run: Run, protocol: Protocol) -> None:
    found = tried(run, Simulator(protocol), case_of(protocol, "unused-id/9/0"))

    assert (found.result.verdict, found.stopped) == (Verdict.PASS, None)
    assert run.results == []


def test_what_comes_while_the_line_is_homed_counts_against_the_case(
    run: Run, protocol: Protocol
) -> None:
    case = case_of(protocol, "unused-id/9/0")
    device = answers_late(protocol, case, 1500 * MS)

    found = tried(run, device, case)

    assert found.failed
    assert found.stopped is None
    assert len(found.result.received) == 1


def test_a_device_that_stops_answering_gives_up_with_a_failure(
    run: Run, protocol: Protocol
) -> None:
    case = case_of(protocol, "unused-id/9/0")

    def react(device: Any, event: Event, reaction: Reaction) -> Reaction:
        device.memory["dead"] = device.memory.get("dead") or event.judgement.frame == case.frame
        return answers(reaction) if device.memory["dead"] else reaction

    found = tried(run, Simulator(protocol, Fault("x", "test", "", react=react)), case)

    assert found.failed
    assert isinstance(found.stopped, GaveUp)
    assert str(found.stopped) == f"the device stopped answering after {case.id}"
    assert run.results == []


def test_a_measurement_that_is_interrupted_after_its_answer_is_no_pass(protocol: Protocol) -> None:
    verdicts = []
    for stop_at in range(STEPS):
        run = Run(RunConfig(protocol, Timers(), ALL_SEEING))
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
