"""Robots in virtual time that are seen through a probe which lies, in each of several ways."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from random import Random

import msgspec

from bilprov.captures.schemas import MS, Look
from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Target, device_target
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol


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
        return Look(now, seen.moving) if self._brief else msgspec.structs.replace(seen, t=now)

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
LIES = {
    "late 100 ms": LAGS[0],
    "late 200 ms": LAGS[1],
    "flips 1 %": flips(0.01),
    "flips 20 %": flips(0.2),
    "last three in any order": last_three_in_any_order,
    "the look before": the_look_before,
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
