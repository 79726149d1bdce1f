"""The runner leaves the robot at rest on every way out, and each case has exactly one result."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import count

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bilprov.analyzer.client.operations import (
    Ended,
    Observation,
    Observe,
    Operation,
    Received,
    Send,
    drive,
)
from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.case import Case
from bilprov.conformance.dut.simulator import Event, Reaction, Simulator
from bilprov.conformance.oracle.profile import Timers
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict, exit_code
from bilprov.conformance.runner.executor import Runner
from bilprov.conformance.runner.homing import watch
from bilprov.conformance.runner.waiting import GaveUp
from bilprov.spec.protocol import Protocol
from tests.support.faults import (
    answers_with,
    drives_on,
    faulty,
    late,
    reacting,
    resumes_after,
    when,
)
from tests.support.robots import MS, CountingLink, Hidden, at_rest, cases_of, new_run, run_over
from tests.support.walking import at_frame

ONLY = (
    *("valid/Stop", "valid/Forward", "valid/LED/[67]", "unused-id/9/[01]"),
    *("wrong-length/Speed/[03]", "bad-data/LED/8", "truncated/LED/0", "recovery/*/Forward"),
)
# Cases that the runner itself stands for.
BEFORE = ("power-on", "link", "timing", "reading", "leave", "line")
ASKS = 860  # a little more than a whole run asks
PROBING = 450  # what the probes of the device's own choices ask besides


@pytest.fixture(scope="module")
def cases(protocol: Protocol) -> tuple[Case, ...]:
    return cases_of(protocol, *ONLY)


def require_complete(results: Sequence[CaseResult], cases: Sequence[Case]) -> None:
    """Every case has one result, and no other case has any."""
    mine = Counter(r.id for r in results if not r.id.startswith(BEFORE))
    assert mine == Counter(case.id for case in cases)
    assert max(Counter(r.id for r in results).values()) == 1


def after(asks: int) -> Callable[[], bool]:
    """Turns true after so many asks and stays so, as Ctrl-C does."""
    counter = count()
    return lambda: next(counter) >= asks


def test_a_run_that_goes_to_its_end_leaves_the_robot_at_rest(
    protocol: Protocol, cases: tuple[Case, ...]
) -> None:
    device = Simulator(protocol)
    link = CountingLink(device)

    runner = run_over(link, protocol, cases)

    require_complete(runner.run.results, cases)
    passed = {r.id for r in runner.run.results if r.verdict is Verdict.PASS}
    assert passed >= {case.id for case in cases}
    assert at_rest(device)
    assert link.asks < ASKS
    assert link.looks[-1].moving is False


def test_the_run_begins_with_a_look_and_then_with_bytes_that_must_not_move_it(
    protocol: Protocol, cases: tuple[Case, ...]
) -> None:
    link = CountingLink(Simulator(protocol))

    runner = run_over(link, protocol, cases)

    done = [one for one in link.operations if isinstance(one, Send | Observe)]
    assert done[:2] == [Observe(), Send(bytes.fromhex("11 7f"))]
    sent = [one.data for one in done if isinstance(one, Send)]
    assert sent[1:4] == [b"\x90", b"\x10", bytes(16)]
    assert [result.id for result in runner.run.results[:4]] == [
        *("power-on/at-rest", "power-on/Speed", "link/unused-id", "link/too-few")
    ]


@given(asks=st.integers(0, ASKS))
@example(asks=0)
@example(asks=1)
@settings(max_examples=25)
def test_an_interrupt_at_any_moment_leaves_the_robot_at_rest(
    protocol: Protocol, cases: tuple[Case, ...], asks: int
) -> None:
    device = Simulator(protocol)

    runner = run_over(CountingLink(device), protocol, cases, interrupted=after(asks))

    results = runner.run.results
    require_complete(results, cases)
    assert at_rest(device)
    assert device.deadline() is None  # nothing owed: the line is at a frame boundary
    assert exit_code(r.verdict for r in results) in (0, 3)
    if runner.ended:
        assert not runner.ended.error
        left = [r for r in results if r.verdict is Verdict.INCONCLUSIVE]
        assert all(r.reason == "interrupted" for r in left)


@given(asks=st.integers(0, ASKS + PROBING), discover=st.booleans())
@example(asks=ASKS, discover=True)
def test_a_line_that_breaks_at_any_moment_charges_the_case_that_ran(
    protocol: Protocol, cases: tuple[Case, ...], asks: int, discover: bool
) -> None:
    def broken(done: int) -> None:
        if done >= asks:
            raise Ended("the port is gone", error=True, line_works=False)

    begun: list[str] = []
    run = new_run(protocol, begin=begun.append)
    runner = Runner(run, cases, discover=discover)
    link = CountingLink(Simulator(protocol), broken)

    drive(runner.execute(), link, lambda: False)

    require_complete(run.results, cases)
    assert link.asks <= asks  # nothing more is tried on a line that is gone
    errors = [r for r in run.results if r.verdict is Verdict.ERROR]
    left = [r for r in run.results if r.verdict is Verdict.INCONCLUSIVE]
    if runner.ended is None:
        assert errors == left == []
        return
    assert str(runner.ended) == "the port is gone"
    assert len(errors) == (1 if left or errors else 0)
    assert exit_code(r.verdict for r in run.results) in ((2,) if errors else (0,))
    assert all("the port is gone" in r.reason for r in (*errors, *left))
    if errors and begun and not begun[-1].startswith(BEFORE):
        position = [case.id for case in cases].index(errors[0].id)
        assert errors[0].id == begun[-1] or cases[position - 1].id == begun[-1]


@pytest.mark.parametrize(("moving", "in_vain"), [(True, True), (False, False)])
def test_looking_for_what_does_not_happen_counts_as_waiting_in_vain(
    protocol: Protocol, moving: bool, in_vain: bool
) -> None:
    run = new_run(protocol, timers=Timers(waiting_budget=99 * MS))
    link = CountingLink(Simulator(protocol))

    seen = drive(watch(run, moving=moving, patience=100 * MS), link, lambda: False)

    assert seen.look.moving is False
    with pytest.raises(GaveUp) if in_vain else nullcontext():
        run.waiting.require_budget()


@given(looks=st.integers(0, 150), more=st.none() | st.integers(0, 12))
@settings(max_examples=40)
def test_a_probe_that_hangs_up_at_any_moment_leaves_the_robot_at_rest(
    protocol: Protocol, cases: tuple[Case, ...], looks: int, more: int | None
) -> None:
    """Also where the run is interrupted soon after, when `more` is asked."""
    device = Simulator(protocol)
    hung_up = False
    asked = 0

    class Blinded(CountingLink):
        def do(self, ask: Operation) -> int | Received | Observation:
            nonlocal hung_up
            if isinstance(ask, Observe) and len(self.looks) >= looks:
                hung_up = True
                raise Ended("the probe hung up", error=True, line_works=True)
            return super().do(ask)

    def interrupted() -> bool:
        nonlocal asked
        asked += hung_up
        return more is not None and asked > more

    runner = run_over(Blinded(device), protocol, cases, interrupted=interrupted)

    require_complete(runner.run.results, cases)
    assert at_rest(device)
    if more is not None:
        return
    assert device.deadline() is None
    if any(r.verdict > Verdict.PASS for r in runner.run.results):
        assert exit_code(r.verdict for r in runner.run.results) == 2


@pytest.mark.parametrize("frames", [110, 300, 350])
def test_a_device_that_stops_answering_fails_by_name_and_the_rest_is_not_judged(
    protocol: Protocol, cases: tuple[Case, ...], frames: int
) -> None:
    silent = when(lambda event: event.frames >= frames, answers_with())
    device = Simulator(protocol, reacting(silent))

    runner = run_over(CountingLink(device), protocol, cases)

    results = runner.run.results
    require_complete(results, cases)
    assert exit_code(r.verdict for r in results) == 1
    failed = [r for r in results if r.verdict is Verdict.FAIL]
    assert len(failed) == 1
    assert "answer" in failed[0].reason
    rest = [r for r in results if r.verdict is Verdict.INCONCLUSIVE and r.id != "line/lost"]
    assert rest
    where = "before the first case" if failed[0].id == "line/lost" else f"after {failed[0].id}"
    assert (where == "before the first case") is (frames == 110)
    assert all(f"stopped answering {where}" in r.reason for r in rest)
    assert at_rest(device)


def test_a_robot_that_cannot_be_stopped_is_reported_aloud(protocol: Protocol) -> None:
    def no_setting(event: Event) -> bool:
        return event.before.moving and event.judgement.id not in (1, 4, 5, 8)

    # One that cannot be switched off: for a cause it would be, and then stand.
    device = Hidden(Simulator(protocol, reacting(when(no_setting, drives_on))))

    report = conform(device, grammar=protocol, options=Options(only=("valid/Stop",)))

    (leaving,) = [r for r in report.results if r.id == "leave/stopped"]
    assert report.exit == 1
    assert leaving.reason == "THE ROBOT STILL MOVES"


def test_a_robot_that_needs_many_stops_gets_them_at_the_end(protocol: Protocol) -> None:
    stop, stops = bytes([protocol.pad_byte]), [0]
    needed = 3 * protocol.longest_frame  # more than homing and the first stops send

    def react(_: Simulator, event: Event, reaction: Reaction) -> Reaction:
        stops[0] = stops[0] + 1 if event.judgement.frame == stop else 0
        deaf = 0 < stops[0] < needed and event.before.moving
        return replace(reaction, state=event.before) if deaf else reaction

    device = Simulator(protocol, reacting(react))

    report = conform(device, grammar=protocol, options=Options(only=("valid/Forward",)))

    assert "leave/stopped" not in {r.id for r in report.results}
    assert at_rest(device)


def test_a_late_answer_is_charged_to_the_case_before_and_not_to_the_next(
    protocol: Protocol,
) -> None:
    cases = cases_of(protocol, "unused-id/9/[0-3]", "unused-id/1?/0")
    device = Simulator(protocol, at_frame("a0", late(1500)))

    runner = run_over(CountingLink(device), protocol, cases)

    failed = [r for r in runner.run.results if r.verdict is Verdict.FAIL]
    assert [r.id for r in failed] == ["unused-id/10/0"]
    assert [byte.hex for byte in failed[0].received] == ["01"]


@pytest.mark.parametrize(("level", "longest"), [("smoke", 300), ("standard", 1200)])
def test_a_robot_that_a_fault_stopped_is_watched_as_long_as_one_that_drives(
    protocol: Protocol, level: str, longest: int
) -> None:
    for milliseconds, verdict in ((longest - 50, Verdict.FAIL), (longest + 50, Verdict.PASS)):
        device = Simulator(protocol, reacting(when(faulty, resumes_after(milliseconds))))
        report = conform(device, options=Options(level=level, only=("unused-id/9/0",)))
        assert [r.verdict for r in report.results if r.id == "unused-id/9/0"] == [verdict]
