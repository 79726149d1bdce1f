"""A probe that lies: it fails no good robot, and no faulty one passes by it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from random import Random

import msgspec
import pytest

from bilprov.captures.schemas import MS, Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.dut.simulator import Fault, Simulator
from bilprov.conformance.dut.target import Target, device_target
from bilprov.conformance.mutation.catalogue import find_fault, find_variant
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol

pytestmark = pytest.mark.slow


class LyingProbe:
    """A simulator whose looks pass through a lie. `true` holds (time in ns, look) up to now."""

    def __init__(self, robot: Simulator, lie: Lie, seed: int, *, brief: bool) -> None:
        self._robot = robot
        self._lie = lie
        self._random = Random(seed)
        self._brief = brief
        self.deadline = robot.deadline
        self.power_cycle = robot.power_cycle
        self.looks: list[Look] = []
        self.true: list[Look] = []

    def receive(self, data: bytes, now: int) -> None:
        self._follow(now)
        self._robot.receive(data, now)
        self._follow(now)

    def advance(self, now: int) -> bytes:
        data = self._robot.advance(now)
        self._follow(now)
        return data

    def look(self, now: int) -> Look:
        self._follow(now)
        self.looks.append(self._robot.look(now))
        seen = self._lie(self, self._random)
        return CarLook(now, seen.moving) if self._brief else msgspec.structs.replace(seen, t=now)

    def ago(self, time: int) -> Look:
        """What the robot did `time` ns ago."""
        until = self.true[-1].t - time
        while len(self.true) > 1 and self.true[1].t <= until:
            self.true.pop(0)
        return self.true[0]

    def _follow(self, now: int) -> None:
        self.true.append(self._robot.look(now))
        if self._lie not in LAGS:
            self.true.clear()


Lie = Callable[[LyingProbe, Random], Look]


def flips(share: float) -> Lie:
    """Each look says with this chance that the robot moves where it stands, and the reverse."""

    def lie(probe: LyingProbe, random: Random) -> Look:
        seen = probe.looks[-1]
        wrong = random.random() < share
        return msgspec.structs.replace(seen, moving=seen.moving is not wrong)

    return lie


def lags(time: int) -> Lie:
    """Each look is `time` ns old."""
    return lambda probe, random: probe.ago(time)


def last_three_in_any_order(probe: LyingProbe, random: Random) -> Look:
    return random.choice(probe.looks[-3:])


def the_look_before(probe: LyingProbe, random: Random) -> Look:
    return probe.looks[-2:][0]


LAGS = (lags(100 * MS), lags(200 * MS))


def forgets(probe: LyingProbe, random: Random) -> Look:
    """From some moment on nothing is known."""
    known = probe.looks[-1].moving if len(probe.looks) < 300 else None
    return CarLook(probe.looks[-1].t, known)


LIES: dict[str, Lie] = {
    "late 100 ms": LAGS[0],
    "late 200 ms": LAGS[1],
    "flips 1 %": flips(0.01),
    "flips 20 %": flips(0.2),
    "last three in any order": last_three_in_any_order,
    "the look before": the_look_before,
    "forgets": forgets,
}
"""The ways in which a probe lies, by name."""


def honest(probe: LyingProbe, random: Random) -> Look:
    return probe.looks[-1]


def seen_through(
    protocol: Protocol, fault: Fault | None, lie: Lie, seed: int = 1, *, brief: bool = False
) -> Report:
    """A run of `smoke` on a robot at a port of which nothing is known, through this probe.

    With `brief` the probe tells only whether the robot moves.
    """
    robot = LyingProbe(Simulator(protocol, fault), lie, seed, brief=brief)
    return run_suite(foreign(device_target(protocol, robot)), Options(level="smoke"), logged=False)


def foreign(target: Target) -> Target:
    """The target, seen through a probe that is not the kit's own."""
    environment = target.environment
    sees = msgspec.structs.replace(environment.observability, foreign=True)
    environment = msgspec.structs.replace(environment, observability=sees)
    return replace(target, environment=environment)


GOOD = (
    *("", "R-stop-latency=50-ms", "R-watchdog=stops", "R-fault-state=both", "R-stop-speed=zeroed"),
    *("R-truncated-known=silent", "R-truncation-timeout=1500-ms", "R-answer-deadline=150-ms"),
    *("R-rotate-steering=reset", "R-drive-steering=straight", "R-pipelining=lost-after-a-fault"),
)
FAULTY = (
    *("no-stop-after-100-faults", "no-stop-after-200-faults", "every-100th-fault-missed"),
    *("jerks-after-a-fault", "restarts-after-200-ms", "every-5th-cut-missed", "code-in-ascii"),
    *("no-stop-at-the-fault-after-a-truncation", "led-sticks-after-255-frames"),
    *("speed-starts-it", "restarts-after-a-truncation"),
)


@pytest.mark.sample(2)
@pytest.mark.parametrize("brief", [False, True], ids=["all facets", "moving only"])
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("lie", LIES)
def test_no_good_robot_fails(protocol: Protocol, lie: str, name: str, seed: int, brief: bool):
    robot = find_variant(protocol, name) if name else None

    report = seen_through(protocol, robot, LIES[lie], seed, brief=brief)

    assert [r for r in report.results if r.verdict is Verdict.FAIL] == []
    assert report.exit in (0, 3)


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", FAULTY)
@pytest.mark.parametrize("lie", LIES)
def test_no_faulty_robot_passes(protocol: Protocol, lie: str, name: str, seed: int):
    assert seen_through(protocol, find_fault(protocol, name), LIES[lie], seed).exit in (1, 3)


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", FAULTY)
def test_through_an_honest_probe_rare_faults_fail_too(protocol: Protocol, name: str):
    assert seen_through(protocol, find_fault(protocol, name), honest).exit == 1


def test_through_an_honest_probe_a_good_robot_passes(protocol: Protocol):
    report = seen_through(protocol, None, honest)

    assert report.exit == 0
    assert "line/probe" not in {result.id for result in report.results}


def test_where_no_fault_is_seen_to_stop_the_robot_the_report_asks_about_the_probe(
    protocol: Protocol,
):
    robot = Simulator(protocol)

    def commanded(probe: LyingProbe, random: Random) -> Look:
        """What the last look showed to which no fault had come."""
        if robot.previous is not None and not robot.previous.valid:
            probe.looks[-1] = probe.looks[-2]
        return probe.looks[-1]

    target = device_target(protocol, LyingProbe(robot, commanded, 1, brief=False))
    report = run_suite(foreign(target), Options(level="smoke"), logged=False)

    assert report.exit == 1
    assert ["not what was commanded" in notice for notice in report.notices] == [True]


def test_a_single_odd_look_fails_nothing_and_passes_nothing(protocol: Protocol):
    def once(number: int) -> Lie:
        def lie(probe: LyingProbe, random: Random) -> Look:
            seen = probe.looks[-1]
            odd = len(probe.looks) == number
            return msgspec.structs.replace(seen, moving=seen.moving is not odd)

        return lie

    for number in (1, 714):
        report = seen_through(protocol, None, once(number))
        odd = [(r.id, r.reason) for r in report.results if r.verdict >= Verdict.INCONCLUSIVE]
        assert report.exit == 3
        assert [ident for ident, _ in odd] == ["line/probe"]
        assert odd[0][1].startswith("the probe contradicts itself: 1 of ")
