"""The wire log of each case: what it holds, what it omits, and that it changes nothing else."""

from __future__ import annotations

from bilprov.analyzer.client.operations import Listen, Received, Send
from bilprov.conformance.api import Options, conform
from bilprov.conformance.oracle.verdicts import Verdict, WireEvent
from bilprov.conformance.runner.listeners.listener import HEAD, TAIL, WIDEST, WireLog
from bilprov.spec.protocol import Protocol
from tests.support.reports import a_case, a_run
from tests.support.robots import simulated


def came(log: WireLog, data: bytes, t: int) -> None:
    """One read: bytes that came at `t`."""
    log.done(Listen(1, 0), Received(tuple((t, code) for code in data), t))


def went(log: WireLog, data: bytes, t: int) -> None:
    """One write: bytes of which the last one was sent at `t`."""
    log.done(Send(data), t)


def test_a_log_tells_set_up_stimulus_looks_and_homing_in_order(protocol: Protocol) -> None:
    report = a_run(protocol, "bad-data/LED/9", fault="ok-to-bad-data")
    (case,) = [result for result in report.results if result.verdict is Verdict.FAIL]
    kinds = [(event.kind, event.hex) for event in case.log]
    at = kinds.index(("sent", "81 09"))

    assert case.log[0] == WireEvent(0, "sent", case.log[0].hex)
    # Answers to a long send come while it still goes: each kind is in order by itself.
    for received in (True, False):
        times = [event.t for event in case.log if (event.kind == "received") is received]
        assert times == sorted(times)
    before, after = case.log[:at], case.log[at + 1 :]
    assert [e for e in before if e.kind == "look" and e.look.startswith("moving")]
    assert (after[0].kind, after[0].hex) == ("received", case.received[0].hex)
    assert [e for e in after if e.kind == "look"]
    homing = " ".join(["00"] * protocol.longest_frame)
    assert ("sent", homing) in kinds[at:]
    assert kinds[-1] == ("received", "00")


def test_a_case_does_not_have_what_was_before_its_begin(protocol: Protocol) -> None:
    report = a_run(protocol, "valid/LED/1")
    first, second = report.results[:2]

    assert [(event.kind, event.t) for event in first.log] == [("look", 0)]
    assert second.log[0].kind == "sent"


def test_a_case_that_never_began_has_no_log(protocol: Protocol) -> None:
    options = Options(only=("unused-id/*",), fail_fast=True)
    report = conform(simulated(protocol, "no-stop-on-unknown-id"), options=options)
    skipped = [result for result in report.results if result.verdict is Verdict.SKIPPED]

    assert len(skipped) > 5
    assert all(result.log == () for result in skipped)


def test_the_middle_of_an_endless_log_is_left_out_and_counted() -> None:
    log = WireLog()
    log.begin("flood")
    for t in range(10_000):
        came(log, bytes([t % 256]), t)
    events = log.attached(a_case("flood", Verdict.FAIL)).log

    assert len(events) == HEAD + TAIL + 1
    clipped = events[HEAD]
    assert (clipped.kind, clipped.hex) == ("clipped", "")
    assert clipped.look == f"{10_000 - HEAD - TAIL} entries are left out here"
    assert [e.ns for e in events[:HEAD]] == list(range(HEAD))
    assert [e.ns for e in events[HEAD + 1 :]] == list(range(10_000 - TAIL, 10_000))


def test_a_read_that_is_too_long_is_cut_and_says_so() -> None:
    log = WireLog()
    log.begin("flood")
    came(log, bytes(5000), 7)

    first, second = log.attached(a_case("flood", Verdict.FAIL)).log

    assert first == WireEvent(0, "received", " ".join(["00"] * WIDEST))
    assert second == WireEvent(0, "clipped", look=f"{5000 - WIDEST} bytes more are left out here")


def test_cases_that_begin_before_the_one_before_is_final_keep_their_own_logs() -> None:
    log = WireLog()
    log.begin("first")
    went(log, b"\1", 1)
    log.begin("second")
    went(log, b"\2", 5)

    first = log.attached(a_case("first", Verdict.PASS)).log
    came(log, b"\2", 6)
    second = log.attached(a_case("second", Verdict.PASS)).log
    went(log, b"\3", 9)

    assert first == (WireEvent(0, "sent", "01"),)
    assert second == (WireEvent(0, "sent", "02"), WireEvent(1e-9, "received", "02"))
    assert log.attached(a_case("second", Verdict.PASS)).log == second


def test_a_case_that_is_tried_again_begins_anew() -> None:
    log = WireLog()
    log.begin("again")
    went(log, b"\1", 1)
    log.begin("again")
    went(log, b"\2", 5)

    assert log.attached(a_case("again", Verdict.PASS)).log == (WireEvent(0, "sent", "02"),)
