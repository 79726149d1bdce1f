"""A run that takes much longer than was announced ends in order, and says where the time went."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from bilprov.analyzer.client.operations import (
    Ended,
    Listen,
    Operation,
    PowerCycle,
    Received,
    Reply,
    Send,
)
from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.recheck import recheck
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.conformance.runner.listeners.recorder import RunRecorder
from bilprov.conformance.runner.waiting import TimeLimit
from bilprov.spec.protocol import Protocol
from tests.support.robots import BYTE_TIME, MS, Notes, OnLine, SlowProbe, simulated

SECOND = 1000 * MS
SMOKE = Options(level="smoke")


class Robot(OnLine):
    """A simulated robot at a line as slow as it is told to be, announced as a run of 5 s."""

    def __init__(
        self,
        protocol: Protocol,
        *,
        look: int = 0,
        announced: float | None = 5.0,
        fault: str = "",
    ) -> None:
        self.simulator: Any = simulated(protocol, fault)
        super().__init__(
            protocol,
            lambda tap: SlowProbe(self.simulator, BYTE_TIME, tap, look),
            announced=announced,
        )

    def judged(self) -> Report:
        return run_suite(self.target, SMOKE)


@pytest.mark.slow
def test_a_run_over_a_probe_that_became_slow_ends_in_order(protocol: Protocol) -> None:
    robot = Robot(protocol, look=200 * MS)

    report = robot.judged()

    assert (report.exit, report.ended_by) == (3, "time")
    told = re.fullmatch(
        r"about 6 s were announced and (\d+) s have passed; "
        "--patient continues however long it takes",
        report.ended,
    )
    assert told, report.ended
    assert 65 < int(told[1]) < 75  # a case longer, at most
    assert report.counts["inconclusive"] > 10
    assert report.counts["fail"] == 0
    assert robot.simulator.look(robot.link.now).moving is False


@pytest.mark.slow
def test_slow_answers_are_announced_anew_and_then_no_surprise(protocol: Protocol) -> None:
    """They are measured before the cases: the run was said to take 100 s then."""
    robot = Robot(protocol, fault="R-answer-deadline=150-ms")

    report = robot.judged()

    assert robot.link.now > 65 * SECOND
    assert (report.exit, report.ended) == (0, None)


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("never-times-out", "never gives up a frame that was cut short"),
        ("R-truncation-timeout=1500-ms", "ends a frame that was cut short only after 1500 ms"),
        ("R-drain-known=flushed-after-any", "discards what follows a fault until the line is idle"),
    ],
)
def test_what_a_device_turns_out_to_take_is_announced_once_and_moves_the_limit(
    protocol: Protocol, name: str, words: str
) -> None:
    robot, notes = Robot(protocol, announced=0.01, fault=name), []

    class Noting(RunListener):
        def note(self, sentence: str) -> None:
            notes.append((robot.link.now / 1e9, sentence))

    report = run_suite(robot.target, SMOKE, [Noting()])

    assert not report.ended
    ((at, sentence),) = notes
    told = re.fullmatch(rf"this device {words}: the run takes about (\d+) s more", sentence)
    assert told, sentence
    took = robot.link.now / 1e9
    assert 0.4 * took < at + int(told[1]) < 1.6 * took


@pytest.mark.parametrize("name", ["R-truncated-known=silent", "R-led-state=off"])
def test_a_device_that_takes_no_longer_is_not_announced_anew(protocol: Protocol, name: str) -> None:
    robot, notes = Robot(protocol, fault=name), Notes()

    run_suite(robot.target, SMOKE, [notes])

    assert notes.told == []


@pytest.mark.slow
def test_a_run_that_took_too_long_is_judged_again_as_it_was(
    protocol: Protocol, tmp_path: Path
) -> None:
    path = str(tmp_path / "run.mcap")
    target = Robot(protocol, look=200 * MS).target
    with RunRecorder(path, target) as recorder:
        report = run_suite(target, SMOKE, [recorder])

    again = recheck(path)

    assert again.differences == ()
    assert again.report is not None
    assert (again.report.ended, again.report.exit) == (report.ended, 3)


def followed(limit: TimeLimit, *done: tuple[Operation, Reply]) -> str:
    """What the limit says after these operations, "" if it lets the run go on."""
    for operation, reply in done:
        limit.did(operation, reply)
    try:
        limit.require()
    except Ended as ended:
        return f"{ended.by}: {ended}"
    return ""


def heard(now: int) -> Received:
    return Received((), now * SECOND)


@pytest.mark.parametrize(
    ("announced", "taken", "ends"),
    [(10.0, 70, False), (10.0, 71, True), (100.0, 300, False), (100.0, 301, True)],
)
def test_the_limit_is_three_times_what_was_said_and_a_minute_more_at_least(
    announced: float, taken: int, *, ends: bool
) -> None:
    done = ((Send(b""), 0), (Listen(1, SECOND), heard(taken)))

    assert bool(followed(TimeLimit(announced), *done)) is ends
    assert followed(TimeLimit(None), *done) == ""


def test_switching_the_power_is_not_counted_and_a_later_announcement_holds() -> None:
    limit = TimeLimit(10.0)

    assert followed(limit, (Send(b""), 0), (PowerCycle(), 90 * SECOND)) == ""
    assert followed(limit, (Listen(1, SECOND), heard(150))) == ""
    limit.announce(100.0)
    assert followed(limit, (Listen(1, SECOND), heard(500))) == ""
    assert "about 160 s were announced" in followed(limit, (Listen(1, SECOND), heard(580)))
