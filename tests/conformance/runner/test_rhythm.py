"""Rhythm: mismatches at equal distances are the device's, on a line that may lose something too."""

from __future__ import annotations

from random import Random

import pytest

from bilprov.analyzer.client.link import drive
from bilprov.analyzer.client.operations import Procedure, followed, listen, power_cycle, send
from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.rhythm import LONGEST, Rhythm, fit
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.conformance.runner.tally import FAULT, FRAME, VALID, Place, Sent, Tally
from bilprov.spec.protocol import Protocol
from tests.support.faults import (
    Condition,
    answers_with,
    every,
    every_nth,
    faulty,
    silent,
    steered_to,
    twice,
    when,
)
from tests.support.robots import ALL_SEEING, MS, CountingLink, Hidden, Timers

wrong = answers_with(2)


def over_a_line(protocol: Protocol, react: React, level: str = "smoke") -> Report:
    """A run against a device that says nothing of its line."""
    device = Hidden(Simulator(protocol, Fault("x", "test", "", react=react)))
    return conform(device, grammar=protocol, options=Options(level=level), logged=False)


def reasons(report: Report) -> list[str]:
    failed = [r for r in report.results if r.verdict is Verdict.FAIL]
    return [axis.reason for r in failed for axis in r.axes.values()]


def each(number: int, counted: Condition, change: React) -> React:
    """The change at every so-manyth of the frames that are counted."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if not counted(event):
            return reaction
        device.memory["met"] = met = (device.memory.get("met", 0) + 1) % number
        return reaction if met else change(device, event, reaction)

    return react


def of_kind(identity: int) -> Condition:
    return lambda event: event.judgement.valid and event.judgement.id == identity


def with_id(identity: int) -> Condition:
    return lambda event: event.judgement.id == identity


# -- the fit ---------------------------------------------------------------------------------------


def frames_of(protocol: Protocol, chance: Random, number: int) -> list[Sent]:
    """Frames of all kinds that their ID tells, and bad data of others' IDs."""
    valid = [Sent(name, spec.id) for name, spec in protocol.by_name.items()]
    faulty = [Sent(FrameClass.BAD_DATA, one.identity) for one in valid]
    unused = [Sent(FrameClass.UNUSED_ID, identity) for identity in protocol.unused_ids]
    return chance.choices([*valid, *faulty, *unused], k=number)


@pytest.mark.parametrize("period", [64, 100, 256, 1000])
@pytest.mark.parametrize("width", [1, 6])
def test_equal_distances_are_found(protocol: Protocol, period: int, width: int) -> None:
    chance = Random(period)
    sent = frames_of(protocol, chance, 30 * period)
    places = []
    for number in sorted(chance.sample(range(2, 28), 8)):
        first = number * period + 13 - chance.randrange(width)
        places.append(Place(first, first + width - 1))

    assert fit(protocol, sent, places)[0] == Rhythm(FRAME, period)


@pytest.mark.parametrize("way", ["faulty", "valid", "of a kind", "with an ID"])
def test_distances_are_counted_in_frames_of_an_outcome_a_kind_or_an_id(
    protocol: Protocol, way: str
) -> None:
    spec = next(iter(protocol.by_name.values()))
    counter, counted = {
        "faulty": (FAULT, lambda one: one.kind not in protocol.by_name),
        "valid": (VALID, lambda one: one.kind in protocol.by_name),
        "of a kind": (f"{spec.name} frame", lambda one: one.kind == spec.name),
        "with an ID": (f"frame with ID {spec.id}", lambda one: one.identity == spec.id),
    }[way]
    sent = frames_of(protocol, Random(1), 30_000)
    mine = [number for number, one in enumerate(sent, 1) if counted(one)]

    found = fit(protocol, sent, [Place(at, at) for at in mine[63::64]])

    assert found[0] == Rhythm(counter, 64)
    # A multiple of a period is no other guess.
    assert len({rhythm.counter for rhythm in found}) == len(found)


@pytest.mark.slow
def test_random_places_confirm_no_prediction(protocol: Protocol) -> None:
    """Noise at 1e-4 a byte over 50,000 frames: whatever is fitted does not hold twice."""
    guessed = 0
    for seed in range(6):
        chance = Random(seed)
        sent = frames_of(protocol, chance, 50_000)
        hurt = {at for at in range(1, 50_001) if chance.random() < 3e-4}
        places = [Place(max(1, at - chance.randrange(4)), at) for at in sorted(hurt)]
        for rhythm in fit(protocol, sent, places)[:2]:
            guessed += 1
            # Where the last mismatch comes again, by the fit, on the same line.
            predicted = [chance.random() < 10 * 3e-4 for _ in range(2)]
            assert not all(predicted)
            assert 2 <= rhythm.period <= LONGEST
    assert guessed < 6  # few of them are worth a try


def test_too_few_places_fit_nothing(protocol: Protocol) -> None:
    sent = frames_of(protocol, Random(1), 1000)
    assert fit(protocol, sent, [Place(100, 100), Place(200, 200)]) == []


# -- the tally -------------------------------------------------------------------------------------


def test_frames_are_counted_however_they_are_sent(protocol: Protocol) -> None:
    run = Run(RunConfig(protocol, Timers(), ALL_SEEING, power=True))

    def script() -> Procedure[None]:
        yield from send(b"\x11")
        yield from listen(None, 2 * MS)
        yield from send(b"\x50\x20\x20\x92\x00")
        yield from listen(None, 200 * MS)
        yield from send(b"\x81\x08")

    drive(followed(script(), run.tally), CountingLink(Simulator(protocol)), lambda: False)

    names = [protocol.by_id[identity].name for identity in (1, 2, 2)]
    assert run.tally.sent == [
        *(Sent(name, identity) for name, identity in zip(names, (1, 2, 2), strict=True)),
        Sent(FrameClass.TRUNCATED, 9),
        Sent(FrameClass.BAD_DATA, 8),
    ]
    assert (run.tally.count(FAULT), run.tally.count(VALID)) == (2, 3)
    assert run.tally.count("frame with ID 2") == 2
    assert run.tally.count(FRAME, 2) == 2


def test_a_power_cycle_begins_anew(protocol: Protocol) -> None:
    tally: Tally = Run(RunConfig(protocol, Timers(), ALL_SEEING, power=True)).tally

    def script() -> Procedure[None]:
        yield from send(b"\x20\x20")
        yield from power_cycle()
        yield from send(b"\x20")

    drive(followed(script(), tally), CountingLink(Simulator(protocol)), lambda: False)

    assert (tally.frames, tally.cycles) == (1, 1)


# -- runs ------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("period", [64, 256])
@pytest.mark.parametrize("change", [twice, silent, wrong])
def test_a_rhythm_of_frames_fails(protocol: Protocol, period: int, change: React) -> None:
    assert over_a_line(protocol, when(every_nth("frames", period), change)).exit == 1


@pytest.mark.sample(0)
@pytest.mark.slow
@pytest.mark.parametrize("change", [twice, silent, wrong])
def test_every_1000th_frame_fails_at_standard(protocol: Protocol, change: React) -> None:
    react = when(every_nth("frames", 1000), change)

    assert over_a_line(protocol, react, "standard").exit == 1


@pytest.mark.slow
@pytest.mark.parametrize("change", [twice, wrong])
def test_a_failure_says_its_rhythm(protocol: Protocol, change: React) -> None:
    report = over_a_line(protocol, when(every_nth("frames", 256), change))

    assert any(reason.startswith("every 256th frame: ") for reason in reasons(report))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("react", "words"),
    [
        (when(every(every_nth("frames", 96), steered_to(-1)), twice), "every 96th frame: "),
        (when(every(every_nth("frames", 64), faulty), silent), "every 64th frame: "),
        (when(every(every_nth("faults", 64), faulty), wrong), "every 64th faulty frame: "),
        (each(20, of_kind(1), twice), "every 20th Speed frame: "),
        (each(30, with_id(8), twice), "every 30th frame with ID 8: "),
    ],
)
def test_a_rhythm_under_a_condition_fails(protocol: Protocol, react: React, words: str) -> None:
    assert any(reason.startswith(words) for reason in reasons(over_a_line(protocol, react)))


@pytest.mark.slow
def test_a_rhythm_in_another_grammar_fails(each_protocol: Protocol) -> None:
    report = over_a_line(each_protocol, when(every_nth("frames", 100), wrong))

    assert report.exit == 1


def test_a_rhythm_is_named_on_a_line_that_loses_nothing_too(protocol: Protocol) -> None:
    robot = Simulator(protocol, Fault("x", "test", "", react=when(every_nth("frames", 256), wrong)))

    report = conform(robot, grammar=protocol, options=Options(level="smoke"), logged=False)

    assert any(reason.startswith("every 256th frame: ") for reason in reasons(report))


def test_a_mismatch_before_the_first_burst_is_in_the_set_up(protocol: Protocol) -> None:
    robot = Simulator(protocol, Fault("x", "test", "", react=when(every_nth("frames", 7), silent)))

    report = conform(robot, grammar=protocol, options=Options(level="smoke"), logged=False)

    told = "\n".join(reasons(report))
    assert "set-up, frame " in told
    assert "burst 0" not in told
    assert "burst -" not in told
