"""What a port that was lost and is there again does to the case under way, and to the run."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bilprov.analyzer.client.operations import Operation, Reconnected, Reply, Send, drive
from bilprov.conformance.cases.levels import level_cases
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import VirtualLink
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.runner.executor import Runner
from bilprov.conformance.runner.run import Run
from bilprov.spec.protocol import Protocol
from tests.support.robots import BYTE_TIME, MS, cases_of, new_run, simulated

GAP = 1000_000 * MS
UNKNOWN = "unused-id/10/[01]"  # ID 9 is sent in the opening too


class Unplugged(VirtualLink):
    """A link in virtual time whose port is away for 1,000 s, once, when `loses` says so."""

    def __init__(self, device: Simulator, loses: Callable[[Operation], bool]) -> None:
        super().__init__(device, BYTE_TIME)
        self.sent: list[bytes] = []
        self.lost_after: int | None = None
        self._loses = loses

    def do(self, operation: Operation) -> Reply:
        if self.lost_after is None and self._loses(operation):
            self.lost_after, lost = len(self.sent), self.now
            self._pass(lost + GAP)
            raise Reconnected("the port was lost; it was there again", lost, self.now)
        if isinstance(operation, Send):
            self.sent.append(operation.data)
        return super().do(operation)


def judged(
    protocol: Protocol, loses: Callable[[Operation], bool], fault: str = ""
) -> tuple[dict[str, CaseResult], Unplugged, Runner]:
    """The results of two cases over a port that is lost, the link and the runner."""
    link = Unplugged(simulated(protocol, fault), loses)
    run = new_run(protocol, announced=5.0)
    runner = Runner(run, cases_of(protocol, UNKNOWN), discover=False)
    drive(runner.execute(), link, lambda: False)
    return {result.id: result for result in run.results}, link, runner


def nth(protocol: Protocol, number: int) -> Callable[[Operation], bool]:
    """Whether an operation sends the first case's stimulus for that time."""
    frame = cases_of(protocol, UNKNOWN)[0].frame
    times = iter(range(1, 1000))
    return lambda operation: operation == Send(frame) and next(times) == number


def test_the_robot_is_homed_before_the_next_case(protocol: Protocol) -> None:
    results, link, _ = judged(protocol, nth(protocol, 1))

    assert link.lost_after is not None
    after = b"".join(link.sent[link.lost_after :])
    home = bytes([protocol.pad_byte]) * (1 + protocol.longest_frame)
    assert after.startswith(home)
    assert results["unused-id/10/0"].verdict is Verdict.INCONCLUSIVE
    assert results["unused-id/10/1"].verdict is Verdict.PASS


def test_the_gap_does_not_count_as_time_of_the_run(protocol: Protocol) -> None:
    _, link, runner = judged(protocol, nth(protocol, 1))

    assert link.now > GAP
    assert runner.ended is None


@pytest.mark.parametrize("before_the_end", [1, 2])
def test_a_port_that_is_lost_in_the_last_homing_loses_no_verdict(
    protocol: Protocol, before_the_end: int
) -> None:
    """The robot may have booted meanwhile: it is homed as after any other gap, and seen at rest."""
    done: list[Operation] = []
    judged(protocol, lambda operation: bool(done.append(operation)))
    last = len(done) - before_the_end

    done.clear()

    def loses(operation: Operation) -> bool:
        done.append(operation)
        return len(done) == last + 1

    results, link, runner = judged(protocol, loses)

    assert runner.ended is None
    assert {r.verdict for r in results.values()} == {Verdict.PASS, Verdict.SKIPPED}  # power-on
    assert link.lost_after is not None
    home = bytes([protocol.pad_byte]) * (1 + protocol.longest_frame)
    assert b"".join(link.sent[link.lost_after :]).startswith(home)


def test_a_failure_that_cannot_be_tried_again_is_inconclusive(protocol: Protocol) -> None:
    results, _, _ = judged(protocol, nth(protocol, 2), "ok-to-unknown-id")

    first = results["unused-id/10/0"]
    assert first.verdict is Verdict.INCONCLUSIVE
    assert "not tried again: the port was lost" in first.axes["answer"].reason
    assert results["unused-id/10/1"].verdict is Verdict.FAIL


def test_a_failure_that_was_reproduced_stays(protocol: Protocol) -> None:
    """The port is lost while the sequence that failed is shortened."""
    runs: list[Run] = []
    link = Unplugged(
        simulated(protocol, "ok-to-unknown-id"),
        lambda operation: isinstance(operation, Send) and runs[0].counters.reproduced > 0,
    )
    runs.append(new_run(protocol))
    case = next(c for c in level_cases(protocol, "smoke", 1) if c.id.startswith("sequence/tour/"))

    drive(Runner(runs[0], [case], discover=False).execute(), link, lambda: False)

    (result,) = (result for result in runs[0].results if result.id == case.id)
    assert result.verdict is Verdict.FAIL
    assert link.lost_after is not None
