"""A run whose port is unplugged and comes back goes on, and judges nothing by the gap."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from benchmarks.adapter import Adapter
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Line
from bilprov.conformance.recheck import recheck
from bilprov.spec.protocol import Protocol
from tests.support.commands import process
from tests.support.robots import served_here, simulated

pytestmark = pytest.mark.waits

# Bytes of the host until a run is in its opening, and until it is in its cases.
OPENING, CASES = 5, 1500


@dataclass(frozen=True)
class Judged:
    """How a run ended, what it said, its report, and whether the robot moved at its end."""

    code: int
    said: str
    report: dict[str, Any]
    moving: object
    events: tuple[str, ...]

    @property
    def doubts(self) -> list[str]:
        """Why axes of cases failed or are inconclusive, in order."""
        return [reason for case in self.report["cases"] for reason in reasons(case)]


def reasons(case: dict[str, Any]) -> list[str]:
    """Why axes of a case failed or are inconclusive."""
    axes = case["axes"].values()
    return [axis["reason"] for axis in axes if axis["verdict"] in ("fail", "inconclusive")]


Judge = Callable[..., Judged]


@pytest.fixture
def judge_unplugged(tmp_path: Path, protocol: Protocol) -> Judge:
    """Judge a robot whose adapter is unplugged after so many bytes each."""

    def judged(*words: str, after: list[int], away: float | None = 0.5, fault: str = "") -> Judged:
        robot = simulated(protocol, fault)
        record, report = tmp_path / "run.mcap", tmp_path / "report.json"
        with (
            served_here(robot, pty=True) as (line, probe),
            Adapter(tmp_path / "port", line, after, away),
        ):
            result = process(
                *("conform", str(tmp_path / "port"), "--probe", probe, "--yes"),
                *("--level", "smoke", "--json", str(report), "--record", str(record), *words),
                *("--truncation-timeout", "50"),
            )
            moving = json.loads(robot.probe(0))["moving"]
        events = tuple(event.event for event in open_capture(record) if isinstance(event, Line))
        told = json.loads(report.read_bytes())
        again = recheck(str(record))
        assert again.differences == ()
        return Judged(result.returncode, result.stderr.decode(), told, moving, events)

    return judged


def test_a_run_goes_on_at_a_port_that_comes_back(judge_unplugged: Judge) -> None:
    run = judge_unplugged("--reconnect", "30", after=[CASES, 500])

    assert run.code == 3, run.said
    assert run.report["ended"] is None
    assert run.report["counts"]["fail"] == 0
    gaps = [reason for reason in run.doubts if "it was there again after 0." in reason]
    assert 1 <= len(gaps) <= 2, run.doubts
    # On a busy machine the probe may once be late besides, which is never a failure.
    assert all("flaky" in reason for reason in run.doubts if reason not in gaps), run.doubts
    assert run.said.count(": inconclusive, and the run goes on") == 2
    assert run.events.count("unplugged") == run.events.count("reconnected") == 2
    assert run.moving is False


@pytest.mark.sample(1)
@pytest.mark.parametrize("at", [OPENING, CASES])
def test_a_port_that_does_not_come_back_ends_the_run(judge_unplugged: Judge, at: int) -> None:
    run = judge_unplugged("--reconnect", "0.5", after=[at], away=None)

    assert run.code == 2
    assert run.report["ended"].endswith(", and it was not there again in 0.5 s (--reconnect)")
    assert run.report["ended_by"] == "error"


def test_without_the_option_a_port_that_comes_back_is_lost_all_the_same(
    judge_unplugged: Judge,
) -> None:
    run = judge_unplugged(after=[CASES], away=0.0)

    assert (run.code, run.report["ended_by"]) == (2, "error")


def test_nothing_goes_on_before_the_first_case(judge_unplugged: Judge) -> None:
    """What is known of the device by then is not enough; but it is stopped."""
    run = judge_unplugged("--reconnect", "30", after=[OPENING])

    assert (run.code, run.report["ended_by"]) == (2, "error")
    assert run.moving is False
