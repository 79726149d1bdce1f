"""Which cases a run has, how long it takes, what it covers, and how it drives."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.noisy_device import NoisyDevice
from bilprov.analyzer.taps.relay import Noise
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.conformance.api import Options, conform, estimated, run_suite, select_cases
from bilprov.conformance.cases.budget import Pace, before_the_cases, run_movement, seconds
from bilprov.conformance.cases.levels import BAD, COMBINED, VALID, covered, level_cases
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.by_effect import Movement
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol, load
from tests.support.commands import command
from tests.support.grammars import undeclared
from tests.support.robots import (
    BYTE_TIME,
    MS,
    Blind,
    OnLine,
    SlowProbe,
    sentence,
    served_here,
    simulated,
)

OPENING = ("power-on/", "link/", "timing/", "reading/")  # what every run has


def test_the_cases_take_longer_on_a_slower_line(protocol: Protocol) -> None:
    options = Options(level="smoke")
    cases = select_cases(protocol, options)

    def told(*line: Any) -> float:
        pace = Pace(protocol.timing.truncation_timeout / 1000, LineSettings(*line).byte_time / 1e9)
        return sum(seconds(protocol, case, pace) for case in cases)

    assert told(9600, "E", 2) > told(9600, "N", 1) > told(115_200, "N", 1)
    # What is not wire takes the same everywhere.
    halved = told(2400, "N", 1) - told(4800, "N", 1)
    assert halved == pytest.approx(2 * (told(4800, "N", 1) - told(9600, "N", 1)))


@pytest.mark.waits
def test_the_line_that_is_given_is_announced_and_its_cases_are_listed(protocol: Protocol) -> None:
    options = Options(level="smoke")
    cases = select_cases(protocol, options)
    given = ("--level", "smoke", *("--baud", "2400", "--parity", "E"))

    with served_here(Simulator(protocol), pty=True) as (port, _):
        refused = command("conform", port, *given, "--stopbits", "2")
    listed = command("conform", "/dev/nowhere", *given, "--stopbits", "2", "--list")

    # On a pty no byte takes time.
    pace = Pace(protocol.timing.truncation_timeout / 1000, few_looks=True)
    said = before_the_cases(pace) + sum(seconds(protocol, case, pace) for case in cases)
    assert f"for about {said:.0f} s" in sentence(refused)
    ids = [row.split()[0] for row in listed.stdout.decode().splitlines()]
    assert [ident for ident in ids if not ident.startswith(OPENING)] == [c.id for c in cases]


@pytest.mark.slow
@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("byte_time", "held", "look", "few"),
    [
        pytest.param(0, 0, 0, False, id="at once"),
        pytest.param(12 * BYTE_TIME, 0, 0, False, id="9600"),
        pytest.param(BYTE_TIME, 16 * MS, 0, False, id="115200, 16 ms late"),
        pytest.param(BYTE_TIME, 0, 100 * MS, False, id="looks of 100 ms"),
        pytest.param(BYTE_TIME, 0, 500 * MS, True, id="a command as probe"),
    ],
)
def test_a_run_takes_as_long_as_was_said(
    protocol: Protocol, byte_time: int, held: int, look: int, few: bool
) -> None:
    """A line that is run in virtual time with the timers of a real one: all but the host's work."""
    device = NoisyDevice(Simulator(protocol), Noise(), 1, held // 2)
    line = OnLine(
        protocol,
        lambda tap: SlowProbe(device, byte_time, tap, look),
        costly=few,
        byte_ns=byte_time,
        latency_ns=held,
        look_ns=look,
    )
    options = Options(level="smoke")

    said = estimated(line.target, options, select_cases(protocol, options))
    report = run_suite(line.target, options)

    assert report.exit == (3 if few else 0)
    assert 0.8 < said / (line.link.now / 1e9) < 1.2


SPEED = '"speed" / Ranged(Byte, 0, 255)'


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("level", ["smoke", "standard"])
def test_no_more_is_covered_than_there_is(each_protocol: Protocol, level: str) -> None:
    for name, (done, of) in covered(each_protocol, level_cases(each_protocol, level, 1)).items():
        assert 0 < done <= of, name


@pytest.mark.slow
def test_frames_whose_value_has_two_bytes_are_counted_out_of_all_there_are(
    grammar_text: str,
) -> None:
    low, high = 10, 60000
    text = undeclared(grammar_text).replace(SPEED, f'"speed" / Ranged(Int16ub, {low}, {high})')
    grammar = load(text.replace("BitStruct, Byte,", "BitStruct, Byte, Int16ub,"))
    values = high - low + 1

    counts = covered(grammar, level_cases(grammar, "smoke", 1))

    # Speed, the two steerings, the LED's eight, and the five without data.
    assert counts[VALID][1] == values + 2 * 256 + 8 + 5
    assert counts[BAD][1] == 65536 - values + 248
    assert all(0 < done <= of for done, of in counts.values())


@pytest.mark.slow
def test_a_sequence_that_was_not_run_covers_nothing(protocol: Protocol) -> None:
    options = Options(only=("combined/waited/*", "valid/Stop"), fail_fast=True)
    report = conform(simulated(protocol, "always-1"), options=options)

    unrun = [r for r in report.results if r.id.startswith("combined/waited/")]
    assert unrun
    assert {result.verdict for result in unrun} == {Verdict.SKIPPED}
    assert not any(result.counted for result in unrun)
    combined = [report.coverage.get(name) for name in COMBINED.values()]
    assert not any(covered and covered.done for covered in combined)


class Driven(Simulator):
    """A robot that notes in which motions, and how fast at most, it was told to drive."""

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol, Fault("noting", "test", "", react=self._note))
        self.done = Movement(frozenset(), None)

    def _note(self, device: object, event: Event, reaction: Reaction) -> Reaction:
        after = reaction.state
        if after.motion != Motion.STOPPED:
            motions, speed = self.done
            self.done = Movement(motions | {after.motion}, max(speed or 0, after.speed))
        return reaction


@pytest.mark.parametrize(
    ("options", "looks"),
    [
        (Options(only=("valid/Stop",)), False),
        (Options(only=("valid/Speed/*",)), True),
        (Options(only=("split/*",)), False),
        pytest.param(Options(level="smoke"), True, marks=pytest.mark.slow),
        pytest.param(Options(soak=50, level="smoke"), False, marks=pytest.mark.slow),
    ],
)
def test_a_run_drives_as_it_said(protocol: Protocol, options: Options, looks: bool) -> None:
    said = run_movement(protocol, select_cases(protocol, options), looks=looks)
    robot = Driven(protocol)

    report = conform(robot if looks else Blind(robot), grammar=protocol, options=options)

    assert report.exit in (0, 3)
    assert robot.done == said
