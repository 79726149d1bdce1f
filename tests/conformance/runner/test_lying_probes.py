"""A probe that lies: it fails no good robot, and no faulty one passes by it."""

from __future__ import annotations

from random import Random

import msgspec
import pytest

from bilprov.captures.schemas import Look
from bilprov.conformance.mutation.catalogue import find_fault, find_variant
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.protocol import Protocol
from tests.support.lying_probes import LIES, Lie, LyingProbe, honest, seen_through

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


@pytest.mark.slow
@pytest.mark.sample(5)
@pytest.mark.parametrize("brief", [False, True], ids=["all facets", "moving only"])
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("lie", LIES)
def test_no_good_robot_fails(protocol: Protocol, lie: str, name: str, seed: int, brief: bool):
    robot = find_variant(protocol, name) if name else None

    report = seen_through(protocol, robot, LIES[lie], seed, brief=brief)

    assert [r for r in report.results if r.verdict is Verdict.FAIL] == []
    assert report.exit in (0, 3)


@pytest.mark.slow
@pytest.mark.sample(5)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", FAULTY)
@pytest.mark.parametrize("lie", LIES)
def test_no_faulty_robot_passes(protocol: Protocol, lie: str, name: str, seed: int):
    assert seen_through(protocol, find_fault(protocol, name), LIES[lie], seed).exit in (1, 3)


@pytest.mark.slow
@pytest.mark.sample(2)
@pytest.mark.parametrize("name", FAULTY)
def test_through_an_honest_probe_rare_faults_fail_too(protocol: Protocol, name: str):
    assert seen_through(protocol, find_fault(protocol, name), honest).exit == 1


def test_through_an_honest_probe_a_good_robot_passes(protocol: Protocol):
    report = seen_through(protocol, None, honest)

    assert report.exit == 0
    assert "line/probe" not in {result.id for result in report.results}


def test_a_single_odd_look_fails_nothing_and_passes_nothing(protocol: Protocol):
    def once(number: int) -> Lie:
        def lie(probe: LyingProbe, random: Random) -> Look:
            seen = probe.looks[-1]
            odd = len(probe.looks) == number
            return msgspec.structs.replace(seen, moving=seen.moving is not odd)

        return lie

    for number in (1, 400, 900, 1300):
        report = seen_through(protocol, None, once(number))
        odd = [(r.id, r.reason) for r in report.results if r.verdict >= Verdict.INCONCLUSIVE]
        assert report.exit == 3
        assert [ident for ident, _ in odd] == ["line/probe"]
        assert odd[0][1].startswith("the probe contradicts itself: 1 of ")
