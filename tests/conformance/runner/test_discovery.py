"""Discovery of a device's choices: what each probe shows, and the profile that follows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from bilprov.analyzer.client.operations import (
    Observation,
    Operation,
    Procedure,
    Received,
    drive,
    listen,
)
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator
from bilprov.conformance.dut.target import Observability
from bilprov.conformance.mutation.faults import fault_bank, variants
from bilprov.conformance.oracle.profile import Choices, Profile, Timers, parse_allowed, verdict_of
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.runner.discovery import discover as discovery
from bilprov.conformance.runner.discovery.answers import Experiment, Finding
from bilprov.conformance.runner.discovery.discover import reading_cases
from bilprov.conformance.runner.executor import Runner
from bilprov.conformance.runner.run import Run
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS
from tests.conformance.oracle.test_legal_variants import VARIANTS
from tests.support.faults import answers_with, late, made, reacting, sets, when
from tests.support.robots import MS, CountingLink, new_run
from tests.support.walking import at_frame

PASS, INFORMATIONAL, NON_STRICT = Verdict.PASS, Verdict.INFORMATIONAL, Verdict.NON_STRICT
INCONCLUSIVE, FAIL = Verdict.INCONCLUSIVE, Verdict.FAIL
# Probes that are made only where an option is given.
AFTER_STOP = "reading/after-stop"
ASKED = {"reading/version", "reading/led-id", "reading/led-upper-bits"}

SHOWS = {name: row["shows"] for name, row in VARIANTS.items() if "shows" in row}


def probed(
    protocol: Protocol,
    fault: Fault | None,
    *allow: str,
    link: type[CountingLink] = CountingLink,
    **circumstances: Any,
) -> Run:
    """A run that only looks at the device's own choices."""
    profile = Profile(choices=Choices(allowed=parse_allowed(protocol, allow)))
    run = new_run(protocol, timers=Timers(idle=2500 * MS), profile=profile, **circumstances)
    drive(Runner(run, []).execute(), link(Simulator(protocol, fault)), lambda: False)
    return run


def readings(run: Run) -> dict[str, CaseResult]:
    found = {r.id: r for r in run.results if r.id.startswith("reading/")}
    assert len(found) == sum(r.id.startswith("reading/") for r in run.results)
    return found


def others(run: Run) -> dict[str, str]:
    """What the device showed otherwise than the kit."""
    shown = {point: word for point, (word, _) in run.profile.choices.shown.items()}
    return {point: word for point, word in shown.items() if word != POINTS[point].default}


# -- what each probe shows ------------------------------------------------------------------------


def test_the_reference_shows_the_default_of_every_point(protocol: Protocol) -> None:
    run = probed(protocol, None)
    asked_for = {"R-version", "R-led-id", "R-led-upper-bits"}

    assert set(run.profile.choices.shown) == set(POINTS) - asked_for
    assert others(run) == {}
    found = readings(run)
    assert set(found) == {case.id for case in reading_cases(protocol)} - ASKED
    assert {result.verdict for result in found.values()} == {PASS}


@pytest.mark.sample(5)
@pytest.mark.slow
@pytest.mark.parametrize("name", [None, *sorted(SHOWS)])
def test_each_variant_shows_its_own_choices_and_no_other(
    protocol: Protocol, name: str | None
) -> None:
    variant = variants(protocol)[name] if name else None
    allow = [variant.row.allow] if variant and variant.row.allow else []

    run = probed(protocol, variant.fault if variant else None, *allow)

    wanted = SHOWS[name] if name else {}
    assert others(run) == wanted
    for result in readings(run).values():
        assert result.verdict <= NON_STRICT, (result.id, result.reason)
    # Each other choice gives its probe the verdict that the readings give it.
    for point, word in wanted.items():
        _, where = run.profile.choices.shown[point]
        assert POINTS[point].choice(word) is not None
        # What the first frames have shown already is settled by them.
        told = readings(run).values() if where not in readings(run) else [readings(run)[where]]
        assert max(result.verdict for result in told) >= verdict_of(point, word) > PASS


def test_a_variant_that_is_a_measured_time_shows_no_choice(protocol: Protocol) -> None:
    rest = set(variants(protocol)) - set(SHOWS)
    times = ("R-truncation-timeout", "R-answer-deadline", "R-stop-", "R-unsolicited", "R-power-on")

    assert all(name.startswith((*times, "R-pipelining=no", "R-resolution=")) for name in rest)
    for name in sorted(rest - {"R-pipelining=no"}):
        run = probed(protocol, variants(protocol)[name].fault)
        assert others(run) == {}, name
        assert max(r.verdict for r in readings(run).values()) <= INFORMATIONAL, name


def test_a_watchdogs_time_is_measured(protocol: Protocol) -> None:
    run = probed(protocol, variants(protocol)["R-watchdog=stops"].fault)

    assert run.profile.watchdog is not None
    assert 900 * MS < run.profile.watchdog < 1200 * MS


def test_with_pipelining_no_nothing_is_sent_ahead(protocol: Protocol) -> None:
    variant = variants(protocol)["R-pipelining=no"]

    found = readings(probed(protocol, variant.fault, variant.row.allow))

    assert max(result.verdict for result in found.values()) is PASS
    assert not {i for i in found if i.startswith(("reading/pipelining", "reading/drain"))}


def test_who_cannot_look_probes_the_answers_alone(protocol: Protocol) -> None:
    found = readings(probed(protocol, None, observability=Observability(available=False)))
    blind = {ident for ident, r in found.items() if r.verdict is INCONCLUSIVE}

    assert {found[i].axes["state"].actual for i in blind} == {""}
    assert blind == {ident for ident, r in found.items() if "state" in r.axes}
    assert len(found) - len(blind) > 8


# -- devices that keep to nothing -----------------------------------------------------------------


def stops(event: Event) -> bool:
    return event.judgement.frame == b"\0" and event.before.moving


@pytest.mark.parametrize(
    ("name", "ident"),
    [("stop-does-nothing", "after-stop"), ("no-stop-on-unknown-id", "after-fault")],
)
def test_a_device_that_still_moves_is_told_though_it_loses_nothing(
    protocol: Protocol, name: str, ident: str
) -> None:
    result = readings(probed(protocol, fault_bank(protocol)[name]))[f"reading/{ident}"]

    assert (result.verdict, result.reason) == (FAIL, "still moves")


@pytest.mark.parametrize(
    ("codes", "words"),
    [
        ((2,), "answered 02 BAD_DATA"),
        ((), "answered no answer"),
        ((1, 1), "answered 01 BAD_HEADER, 01"),
    ],
)
def test_an_answer_that_is_no_choice_of_the_point_fails(
    protocol: Protocol, codes: tuple[int, ...], words: str
) -> None:
    fault = at_frame("92 00 00", answers_with(*codes))

    result = readings(probed(protocol, fault))["reading/unused-length"]

    assert result.verdict is FAIL
    assert words in result.reason


@pytest.mark.parametrize(
    ("facets", "word"),
    [({"speed": 7}, "speed is 7"), ({"steering": 7}, "steering is 7"), ({"led": 3}, "LED is 3")],
)
def test_a_state_that_is_no_choice_of_the_point_fails(
    protocol: Protocol, facets: dict[str, int], word: str
) -> None:
    found = readings(probed(protocol, reacting(when(stops, sets(**facets)))))

    assert found[AFTER_STOP].verdict is FAIL
    assert word in found[AFTER_STOP].reason


def found_by_tries(
    monkeypatch: pytest.MonkeyPatch, tries: str, *, timed: bool = False
) -> list[str]:
    """Let the one probe of a run find a letter at each try; gives those that are left.

    They stand for a choice (=), another one (!), and a line that is too coarse (?).
    """
    point, left = "R-truncation-timeout", list(tries)
    kinds = {
        "=": Finding(((point, POINTS[point].default),), "one", "one"),
        "!": Finding(((point, "whole-frame"),), "one", "the other"),
        "?": Finding(((point, ""),), "one", "", coarse="the line is slow"),
    }

    def make(run: Run) -> Procedure[Finding]:
        yield from listen(0, 0)
        return kinds[left.pop(0)]

    probe = Experiment("truncation-timeout", (point,), "it keeps to one", make, timed=timed)
    monkeypatch.setattr(discovery, "_experiments", lambda protocol: iter([probe]))
    return left


@pytest.mark.parametrize(
    ("tries", "verdict", "made"),
    [
        ("==", PASS, 2),
        ("??", INFORMATIONAL, 2),
        ("=?=", PASS, 3),  # a try that told nothing is made again
        ("?=?", INFORMATIONAL, 3),
        ("=!==", INCONCLUSIVE, 4),
        ("=!=!=!=!", FAIL, 8),
        ("=!=!========", INCONCLUSIVE, 12),  # noise may be why
        ("!=!==!======", INCONCLUSIVE, 12),
        ("=!=!?=", INCONCLUSIVE, 6),  # it may have been the line
    ],
)
def test_a_try_for_which_the_line_is_too_coarse_tells_nothing(
    protocol: Protocol,
    monkeypatch: pytest.MonkeyPatch,
    tries: str,
    verdict: Verdict,
    made: int,
) -> None:
    left = found_by_tries(monkeypatch, tries)

    result = readings(probed(protocol, None))["reading/truncation-timeout"]

    assert result.verdict is verdict
    assert len(tries) - len(left) == made
    if verdict is INFORMATIONAL or (verdict is INCONCLUSIVE and "?" in tries):
        assert "the line is slow" in result.reason


@pytest.mark.parametrize(("virtual", "verdict"), [(True, FAIL), (False, INCONCLUSIVE)])
def test_two_choices_of_a_time_may_be_those_of_a_busy_machine_in_real_time(
    protocol: Protocol, monkeypatch: pytest.MonkeyPatch, virtual: bool, verdict: Verdict
) -> None:
    found_by_tries(monkeypatch, "=!" * 6, timed=True)

    found = readings(probed(protocol, None, virtual=virtual))["reading/truncation-timeout"]

    assert found.verdict is verdict


@pytest.mark.parametrize(("late", "verdict"), [(MS // 2, PASS), (5 * MS, INFORMATIONAL)])
def test_a_time_out_that_the_line_cannot_resolve_is_not_judged(
    protocol: Protocol, late: int, verdict: Verdict
) -> None:
    class Uneven(CountingLink):
        """A line on which one answer in seven comes later."""

        def do(self, ask: Operation) -> int | Received | Observation:
            reply = super().do(ask)
            if isinstance(reply, Received) and self.asks % 7 == 0:
                return Received(tuple((t + late, c) for t, c in reply.answers), reply.now + late)
            return reply

    short = Fault("x", "test", "", timeout=6 * MS)

    found = readings(probed(protocol, short, link=Uneven))["reading/truncation-timeout"]

    assert found.verdict is verdict
    assert verdict is PASS or "too short for pauses" in found.reason


class OneLate(CountingLink):
    """A line on which the first answer to a truncated frame comes later, by 40 ms."""

    sent = 0
    late = 40 * MS

    def do(self, ask: Operation) -> int | Received | Observation:
        reply = super().do(ask)
        if isinstance(reply, int):
            self.sent = reply
        elif isinstance(reply, Received) and reply.answers:
            late = self.late if reply.answers[0][0] - self.sent > 30 * MS else 0
            self.late -= late
            answers = tuple((t + late, code) for t, code in reply.answers)
            return Received(answers, reply.now + late)
        return reply


def test_where_the_time_out_is_not_measured_twice_alike_pauses_inside_it_tell_nothing(
    protocol: Protocol,
) -> None:
    run = probed(protocol, None, link=OneLate)

    (measured,) = [r for r in run.results if r.id == "timing/truncation-timeout"]
    assert measured.verdict is INCONCLUSIVE
    found = readings(run)["reading/truncation-timeout"]
    assert found.verdict is INFORMATIONAL
    assert "too short for pauses" in found.reason


# Of the stops of a run the first is one of its first frames, the 14th and 15th are the probe's own.
@pytest.mark.parametrize(
    ("at", "verdict", "words"),
    [
        (1, FAIL, "zeroed in the first frames after power-on"),
        (14, INCONCLUSIVE, "flaky, met once in 4 tries: "),
        (15, INCONCLUSIVE, "flaky, met once in 4 tries: "),
    ],
)
def test_a_probe_that_showed_another_thing_once_is_inconclusive(
    protocol: Protocol, at: int, verdict: Verdict, words: str
) -> None:
    zeroed = sets(speed=0)

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        times = device.memory["times"] = device.memory.get("times", 0) + stops(event)
        return zeroed(device, event, reaction) if stops(event) and times == at else reaction

    result = readings(probed(protocol, reacting(react)))[AFTER_STOP]

    assert result.verdict is verdict
    assert words in result.reason


@pytest.mark.parametrize(("idle", "timeout"), [(50, 3), (200, 50), (500, 500)])
def test_a_device_that_discards_is_left_alone_for_as_long_as_it_needs(
    protocol: Protocol, idle: int, timeout: int
) -> None:
    device = replace(made(protocol, f"flushes {idle}", "faulty"), timeout=timeout * MS)

    run = probed(protocol, device)

    assert max(result.verdict for result in run.results) is NON_STRICT
    assert idle * MS <= run.waiting.idle <= 5 * max(idle, timeout) * MS


def test_the_answer_of_a_slow_device_behind_its_banner_is_not_unsolicited(
    protocol: Protocol,
) -> None:
    device = Simulator(protocol, Fault("", "", "", react=late(150), banner=b"ROBOT\r\n"))

    report = conform(device, grammar=protocol, options=Options(only=("valid/Stop",)))

    assert report.exit == 0
    assert not [result.id for result in report.results if result.id.startswith("line/")]
