"""Retry of failed cases: a reproduced failure counts, a single one is flaky and never a pass."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import pytest

from bilprov.analyzer.client.operations import (
    Ended,
    Listen,
    Observation,
    Observe,
    Procedure,
    Received,
    Send,
    drive,
    listen,
)
from bilprov.captures.schemas import Look
from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.case import Case, case_of_the_run
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.dut.simulator import Event, Fault, React, Reaction, Simulator, answers
from bilprov.conformance.dut.target import VirtualLink
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict, exit_code
from bilprov.conformance.runner.retry import (
    FEW,
    LONGEST_MINIMISED,
    Attempt,
    Confirmed,
    agree,
    confirm,
)
from bilprov.conformance.runner.run import Run, result_of
from bilprov.spec.protocol import Protocol
from tests.support.faults import answers_with, drives_on, faulty, made, reacting, when
from tests.support.robots import (
    BYTE_TIME,
    MS,
    CountingLink,
    at_rest,
    case_of,
    cases_of,
    new_run,
    run_over,
)
from tests.support.walking import RESPONSES, SAFETY, burst, hand_made

INCONCLUSIVE, FAIL, PASS = Verdict.INCONCLUSIVE, Verdict.FAIL, Verdict.PASS
DRIVES = ("11 c8", "81 07", "20")
FRAME = bytes.fromhex("92 00 00")


wrong_code = answers_with(2)


def on_times(change: React, *times: int, every: int = 0, frame: bytes = FRAME) -> Fault:
    """A device that reacts otherwise at these times (from 1) that it gets the frame."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        if event.judgement.frame != frame:
            return reaction
        device.memory["times"] = now = device.memory.get("times", 0) + 1
        hit = now in times or (every and now % every == 0)
        return change(device, event, reaction) if hit else reaction

    return Fault("x", "test", "", react=react)


def judged(protocol: Protocol, fault: Fault, *cases: AnyCase, **more: Any) -> dict[str, CaseResult]:
    runner = run_over(CountingLink(Simulator(protocol, fault)), protocol, cases, **more)
    results = runner.run.results
    assert len({r.id for r in results}) == len(results)
    return {r.id: r for r in results}


@pytest.fixture
def sequence(protocol: Protocol) -> AnyCase:
    """The frame comes once in it, after five others."""
    return hand_made(
        protocol, "20", "30", "41 05", "60", "70", "92 00 00", "20", "81 02", setup=DRIVES
    )


@pytest.fixture
def single(protocol: Protocol) -> Case:
    return case_of(protocol, "unused-id/9/2")


def only(found: dict[str, CaseResult]) -> CaseResult:
    """The result of the one case that was run."""
    (mine,) = [r for i, r in found.items() if i.startswith(("sequence", "unused"))]
    return mine


# -- each time, once, now and then ----------------------------------------------------------------


def test_a_walk_that_fails_says_where_and_names_the_clause(
    protocol: Protocol, sequence: AnyCase
) -> None:
    stop = only(judged(protocol, on_times(drives_on, every=1), sequence))
    answer = only(judged(protocol, on_times(wrong_code, every=1), sequence))

    for result, axis, clause in ((stop, "stop", SAFETY), (answer, "answer", RESPONSES)):
        # After shortening it is the only one.
        assert result.axes[axis].reason.startswith("burst 1, frame 92 00 00: ")
        assert result.clause == clause


@pytest.mark.sample(1)
@pytest.mark.parametrize("change", [drives_on, wrong_code])
@pytest.mark.parametrize("times", [(1,), (2,), (1, 4)])
def test_what_fails_once_is_flaky_and_never_a_pass(
    protocol: Protocol, sequence: AnyCase, single: Case, change: React, times: tuple[int, ...]
) -> None:
    cases: tuple[AnyCase, ...] = (sequence, single)
    for case in cases:
        result = only(judged(protocol, on_times(change, *times), case))
        if times[0] == 1:
            assert result.verdict is INCONCLUSIVE
            assert "flaky, met once in " in result.reason
            assert FAIL not in {axis.verdict for axis in result.axes.values()}
        else:
            assert result.verdict is PASS  # it was sent once, and right


def test_a_stop_that_is_missed_now_and_then_is_no_noise(protocol: Protocol, single: Case) -> None:
    # A byte that the line changed shows in an answer too. Twice in a run the device is to blame.
    other = case_of(protocol, "unused-id/9/3")

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        name = event.judgement.frame.hex()
        met = device.memory.get(name, 0)
        device.memory[name] = 1
        mine = event.judgement.frame in (single.frame, other.frame)
        return drives_on(device, event, reaction) if mine and not met else reaction

    fault = Fault("x", "test", "", react=react)

    found = judged(protocol, fault, single, other)

    assert found["unused-id/9/2"].verdict is INCONCLUSIVE
    assert found["unused-id/9/3"].verdict is FAIL


@pytest.mark.parametrize(
    ("every", "verdict"), [(2, FAIL), (3, FAIL), (5, FAIL), (7, FAIL), (30, INCONCLUSIVE)]
)
def test_what_shows_every_so_often_fails_unless_it_is_as_seldom_as_noise(
    protocol: Protocol, sequence: AnyCase, every: int, verdict: Verdict
) -> None:
    # The first time, so that there is something to try again, and then each so-manyth.
    react = on_times(drives_on, 1, every=every)

    assert only(judged(protocol, react, sequence)).verdict is verdict


def test_a_line_that_is_trusted_is_not_tried_again(protocol: Protocol) -> None:
    bad = cases_of(protocol, "bad-data/LED/[89]", "bad-data/LED/1?", "bad-data/LED/2[0-3]")
    fault = made(protocol, "drives-on", "outcome bad-data")
    link = CountingLink(Simulator(protocol, fault))

    runner = run_over(link, protocol, bad)

    sent = Counter(one.data for one in link.operations if isinstance(one, Send))
    failed = [r for r in runner.run.results if r.id.startswith("bad") and r.verdict is FAIL]
    assert len(failed) == len(bad)
    assert [sent[case.frame] for case in bad[:6]] == [3] * 6
    assert [sent[case.frame] for case in bad[6:]] == [1] * 10


# -- ends in the middle ---------------------------------------------------------------------------


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("hangs", [1, 2, 3])
def test_a_device_that_hangs_while_it_is_tried_again_fails_there_and_the_rest_is_open(
    protocol: Protocol, sequence: AnyCase, single: Case, hangs: int
) -> None:
    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        times = device.memory["times"] = device.memory.get("times", 0) + (
            event.judgement.frame == FRAME
        )
        if times >= hangs:
            return answers(reaction)
        return wrong_code(device, event, reaction) if event.judgement.frame == FRAME else reaction

    others = [case_of(protocol, f"unused-id/1{number}/0") for number in range(3)]
    for case in (sequence, single):
        device = Simulator(protocol, Fault("x", "test", "", react=react))
        runner = run_over(CountingLink(device), protocol, [case, *others])
        results = {r.id: r for r in runner.run.results}

        assert results[case.id].verdict is FAIL
        assert results[case.id].axes["answer"].verdict is FAIL
        for other in others:
            assert results[other.id].verdict is INCONCLUSIVE
            assert f"stopped answering after {case.id}" in results[other.id].reason
        assert len(results) == len(runner.run.results)
        assert at_rest(device)


@pytest.mark.sample(4)
@pytest.mark.slow
@pytest.mark.parametrize("asks", [*range(0, 420, 30), *range(420, 700, 17)])
def test_an_interrupt_while_it_is_tried_again_is_never_a_pass(
    protocol: Protocol, sequence: AnyCase, single: Case, asks: int
) -> None:
    device = Simulator(protocol, on_times(drives_on, every=1))
    link = CountingLink(device)

    runner = run_over(link, protocol, [sequence, single], interrupted=lambda: link.asks >= asks)

    results = [r for r in runner.run.results if r.id in (sequence.id, single.id)]
    assert sorted(r.id for r in results) == sorted([sequence.id, single.id])
    assert {r.verdict for r in results} <= {INCONCLUSIVE, FAIL}
    # What was reproduced stays a failure, also while it is only being shortened.
    assert results[0].verdict is FAIL or runner.run.counters.reproduced == 0
    assert at_rest(device)


def test_a_port_that_goes_while_it_is_tried_again_is_no_failure_of_what_was_not_tried(
    protocol: Protocol, sequence: AnyCase, single: Case
) -> None:
    for asks in range(150, 420, 15):

        def broken(done: int, asks: int = asks) -> None:
            if done >= asks:
                raise Ended("the port is gone", error=True, line_works=False)

        link = CountingLink(Simulator(protocol, on_times(drives_on, every=1)), broken)
        results = run_over(link, protocol, [sequence, single]).run.results

        mine = {r.id: r.verdict for r in results if r.id in (sequence.id, single.id)}
        assert len(mine) == 2
        assert PASS not in mine.values()
        assert exit_code(r.verdict for r in results) in (1, 2)


# -- the reproducer -------------------------------------------------------------------------------

STATELESS = (
    *("backward-again-stops-it", "left-again-ignored", "no-stop-while-rotate-left"),
    *("no-stop-on-bad-data-while-backward", "speed-0-ignored", "right-bit-4-lost"),
    *("sent-ahead-fault-does-not-stop", "sent-ahead-speed-ignored", "forward-does-nothing"),
    *("split-fault-does-not-stop", "accepts-led-bit-3"),
    *("speed-ignored-after-forward", "runs-data-of-length-2", "wrong-code-for-bad-data"),
)
SHORT = 9  # frames beside the set-up's four
SHORTENED = 5  # walks in a run; the others are given as they are


def played(device: Simulator, items: Sequence[str]) -> list[tuple[tuple[int, ...], Look]]:
    """What `bilprov send` with these items gets from a device, and what is seen after each."""
    link = VirtualLink(device, BYTE_TIME)
    seen: list[tuple[tuple[int, ...], Look]] = []
    together = items[0] == "--together"

    def note(wait: int) -> None:
        heard, looked = link.do(Listen(None, wait)), link.do(Observe())
        assert isinstance(heard, Received)
        assert isinstance(looked, Observation)
        seen.append((heard.codes, msgspec.structs.replace(looked.look, t=0)))

    for item in items[together:]:
        if item.startswith("pause="):
            link.do(Listen(None, int(item.removeprefix("pause=")) * MS))
            continue
        link.do(Send(bytes.fromhex(item)))
        note(0 if together else 60 * MS)
    note(60 * MS)
    return seen


@pytest.mark.slow
@pytest.mark.sample(1)
@pytest.mark.parametrize("name", STATELESS)
def test_the_reproducer_is_short_and_shows_the_failure_on_a_fresh_device(
    protocol: Protocol, name: str
) -> None:
    fault = fault_bank(protocol)[name]
    report = conform(Simulator(protocol, fault), grammar=protocol, options=Options(level="smoke"))

    given = [r for r in report.results if r.sends][:SHORTENED]
    # What contradicts a reading that was shown elsewhere takes both places to show.
    given = [r for r in given if not any("keeps to one" in a.reason for a in r.axes.values())]
    assert given
    for result in given:
        items = result.reproduce.removeprefix("bilprov send PORT ").split()
        assert played(Simulator(protocol, fault), items) != played(Simulator(protocol), items), (
            result.id,
            result.reproduce,
        )
        sent = [item for item in items if not item.startswith(("pause", "--"))]
        assert len(sent) <= 4 + SHORT
    assert min(len(r.reproduce.split()) for r in given) <= 10 or "split" in name


def test_a_walk_shrinks_to_its_set_up_and_what_matters(protocol: Protocol) -> None:
    noise = ["30", "41 05", "60", "81 03", "50", "81 01", "11 90", "00", "51 20", "70"]

    def after_led(event: Event) -> bool:
        return faulty(event) and event.previous is not None and event.previous.frame == b"\x81\x04"

    frames = [*noise, "20", "81 04", "92 00 00", *noise]
    case = hand_made(protocol, *frames, setup=DRIVES)

    result = only(judged(protocol, reacting(when(after_led, drives_on)), case))

    assert result.reproduce in ("11c8 8107 20 8104 920000", "11c8 8107 20 20 8104 920000")


def test_what_goes_wrong_in_the_set_up_is_reproduced_by_its_frames(protocol: Protocol) -> None:
    bad = on_times(wrong_code, every=1, frame=b"\x81\x07")
    case = hand_made(protocol, "30", setup=DRIVES)

    assert only(judged(protocol, bad, case)).reproduce == "11c8 8107"


def test_pauses_of_a_split_frame_are_in_the_reproducer(protocol: Protocol) -> None:
    split = reacting(when(lambda event: event.pause > MS and faulty(event), drives_on))
    case = hand_made(
        protocol, "30", "41 05", burst(protocol, "92 00 00", pauses=(1,)), setup=DRIVES
    )

    items = only(judged(protocol, split, case)).reproduce.split()

    assert items[0] == "--together"
    assert items[-3:] == ["92", "pause=3", "0000"]
    waits = [item for item in items[1:-3] if item.startswith("pause=")]
    assert len(waits) == len(items[1:-3]) // 2  # for the answers between the bursts


def test_only_a_few_walks_are_shortened_in_a_run_and_each_says_where(protocol: Protocol) -> None:
    sequences = [
        replace(hand_made(protocol, "30", "20", "92 00 00", setup=DRIVES), id=f"sequence/hand/{n}")
        for n in range(9)
    ]

    found = judged(protocol, on_times(drives_on, every=1), *sequences)

    given = [found[case.id].reproduce for case in sequences]
    assert given[:5] == ["11c8 8107 20 920000"] * 5
    assert {len(line.split()) for line in given[5:]} <= {0, 6}
    for number, case in enumerate(sequences):
        burst = 1 if number < LONGEST_MINIMISED else 3  # in the sequence as it was shortened
        assert found[case.id].axes["stop"].reason.startswith(f"burst {burst}, frame 92 00 00: ")
        assert found[case.id].clause == SAFETY


# -- when a failure is confirmed -------------------------------------------------------------------


def confirmed(run: Run, outcomes: str) -> Confirmed:
    """What is found where the tries fail (x) or not (.) in this order."""
    left: Iterator[str] = iter(outcomes)
    case = case_of_the_run(run.protocol, "line/lost")

    def tried(*, fails: bool) -> Attempt:
        verdict = Verdict.FAIL if fails else Verdict.PASS
        return Attempt(result_of(case, {"answer": Axis(verdict, "", "", "a reason")}))

    def again() -> Procedure[Attempt]:
        yield from listen(None, 0)
        return tried(fails=next(left) == "x")

    found: list[Confirmed] = []

    def procedure() -> Procedure[None]:
        found.append((yield from confirm(run, case, tried(fails=True), again, FEW)))

    drive(procedure(), CountingLink(Simulator(run.protocol)), lambda: False)
    return found[0]


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        ("xxx", Confirmed(True, 3, 3)),
        ("xx.x", Confirmed(True, 4, 3)),
        ("...", Confirmed(False, 3, 0)),
        ("x..", Confirmed(False, 3, 1)),
        ("xx..", Confirmed(False, 4, 2)),
    ],
)
def test_a_trial_is_repeated_until_its_failures_are_no_noise_or_few(
    protocol: Protocol, outcomes: str, expected: Confirmed
) -> None:
    assert confirmed(new_run(protocol), outcomes) == expected


def test_on_a_line_that_was_flaky_before_more_failures_are_needed(protocol: Protocol) -> None:
    run = new_run(protocol)
    run.counters.flaky, run.answers = 20, 2000

    assert confirmed(run, "xxx") == Confirmed(False, 3, 3)


@dataclass(frozen=True)
class Shown:
    """What an observation showed: a letter; x is a failure."""

    word: str
    coarse: str = ""

    @property
    def fault(self) -> bool:
        return self.word == "x"

    def fits(self, other: Shown) -> bool:
        return self == other


@pytest.mark.parametrize(
    ("shown", "kinds"),
    [
        ("aa", ["aa"]),
        ("xxx", ["xxx"]),
        ("abaa", ["aaa", "b"]),
        ("xaaa", ["aaa", "x"]),
        ("abcdef", [*"abcdef"]),
        ("abababab", ["aaaa", "bbbb"]),  # until noise does not explain that b came as well
    ],
)
def test_what_is_observed_until_it_agrees_is_observed_more_often_where_it_differs_or_fails(
    protocol: Protocol, shown: str, kinds: list[str]
) -> None:
    run, left = new_run(protocol), iter(shown)
    found: list[str] = []

    def observed() -> Procedure[Shown]:
        yield from listen(None, 0)
        return Shown(next(left))

    def procedure() -> Procedure[None]:
        outcomes = yield from agree(run, case_of_the_run(protocol, "line/lost"), observed)
        found.extend("".join(one.word for one in kind) for kind in outcomes)

    drive(procedure(), CountingLink(Simulator(protocol)), lambda: False)

    assert found == kinds
    assert next(left, "") == ""


# -- stray answers ---------------------------------------------------------------------------------


def told(run: Run) -> list[tuple[str, Verdict]]:
    return [(result.id, result.verdict) for result in run.results]


@pytest.mark.parametrize(
    ("on_line", "unasked", "missing", "keeps_all", "results", "words"),
    [
        (0, [], [], True, [], ""),
        (0, [1], [], True, [("line/unsolicited", INCONCLUSIVE)], "once"),
        (0, [1, 1], [], True, [("line/unsolicited", INCONCLUSIVE)], "2 times"),
        (0, [1] * 5, [], True, [("line/unsolicited", FAIL)], "came"),
        (0, [3], [], True, [("line/unsolicited", FAIL)], "came"),
        (5_000, [1] * 18, [], True, [("line/unsolicited", INCONCLUSIVE)], "18 times"),
        (5_000, [1] * 19, [], True, [("line/unsolicited", FAIL)], "came"),
        (0, [1, 5], [], True, [("line/unsolicited", FAIL)], "came"),
        (0, [], [1, 0, 15], True, [("line/lost", INCONCLUSIVE)], "16 times"),
        (0, [], [3], False, [], ""),  # it may lose what follows a fault
    ],
)
def test_three_at_once_or_more_in_all_than_noise_makes_are_the_devices(
    protocol: Protocol,
    on_line: int,
    unasked: list[int],
    missing: list[int],
    keeps_all: bool,
    results: list[tuple[str, Verdict]],
    words: str,
) -> None:
    run = new_run(protocol)
    run.bytes = on_line
    for count in unasked:
        run.strays.unexpected([(number, 0) for number in range(count)], "came")
    for count in missing:
        run.strays.missing(count)
    # What may be the line's is not told before the run is over: more may come.
    assert told(run) == [one for one in results if one[1] is FAIL]

    run.strays.close(keeps_all=keeps_all)

    assert told(run) == results
    assert all(words in result.reason for result in run.results)


def test_a_device_that_stopped_answering_fails_and_that_is_all(protocol: Protocol) -> None:
    run = new_run(protocol)
    run.strays.missing(3)
    run.strays.silent("the device stopped answering")
    run.strays.close(keeps_all=True)

    assert told(run) == [("line/lost", FAIL)]
    assert run.results[0].reason == "the device stopped answering"
