"""Lines that jitter or hurt bytes, and devices that stand still now and then, fail no good robot.

A faulty one does not pass over them.
"""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.noisy_device import NoisyDevice
from benchmarks.torture.noise import LINES, Trial, noisy_run
from bilprov.analyzer.client.operations import LinkListener, Observation, Observe, Operation, Reply
from bilprov.analyzer.taps.relay import Noise
from bilprov.captures.schemas import Look
from bilprov.conformance.api import Options, conform, run_suite
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Device, VirtualLink
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.protocol import Protocol
from tests.support.robots import BYTE_TIME, MS, Notes, OnLine, simulated

pytestmark = pytest.mark.slow

JITTERS = (10, 20, 30, 40, 50)  # ms
GOOD = (
    *("", "R-truncation-timeout=3-ms", "R-truncation-timeout=500-ms", "R-answer-point=header"),
    *("R-truncation-timeout=whole-frame", "R-answer-deadline=150-ms-after-faults"),
    *("R-pipelining=lost-after-a-fault", "R-drain-known=flushed", "R-truncated-known=silent"),
    *("R-stop-latency=50-ms", "R-watchdog=stops", "R-unsolicited=banner"),
)
FAULTY = (
    *("ok-to-unknown-id", "no-stop-on-too-many", "never-times-out", "split-fault-does-not-stop"),
    *("sent-ahead-valid-lost", "left-is-signed", "restarts-on-led-after-a-fault"),
    "every-16th-fault-missed",
)


class StoppedDevice:
    """A device whose process stands still for `stop` ns of every `period`: bytes wait meanwhile."""

    def __init__(self, device: Device, stop: int, period: int = 1_000_000_000) -> None:
        self._device = device
        self._stop = stop
        self._period = period
        self._waiting = b""

    def runs_at(self, now: int) -> int:
        """When (ns), from `now` on, it runs."""
        phase = now % self._period
        return now if phase >= self._stop else now - phase + self._stop

    def receive(self, data: bytes, now: int) -> None:
        self._wake(now)
        self._waiting += data
        self._wake(now)

    def advance(self, now: int) -> bytes:
        self._wake(now)
        return b"" if self.runs_at(now) > now else self._device.advance(now)

    def deadline(self) -> int | None:
        due = self._device.deadline()
        if self._waiting:
            return self.runs_at(self._last)
        return None if due is None else self.runs_at(due)

    def look(self, now: int) -> Look:
        self._wake(now)
        return self._device.look(now)

    def _wake(self, now: int) -> None:
        self._last = now
        if self._waiting and self.runs_at(now) == now:
            data, self._waiting = self._waiting, b""
            self._device.receive(data, now)


class StoppedLink(VirtualLink):
    """A link whose probe stands still with its device, as that of one process does."""

    def __init__(self, device: StoppedDevice, tap: LinkListener | None = None) -> None:
        super().__init__(device, BYTE_TIME, tap)
        self._stopped = device

    def do(self, operation: Operation) -> Reply:
        asked = self.now
        if isinstance(operation, Observe):
            self._pass(self._stopped.runs_at(asked))
        reply = super().do(operation)
        return Observation(asked, self.now, reply.look) if isinstance(reply, Observation) else reply


def run_on_line(
    protocol: Protocol, device: Any, *listeners: RunListener, **options: Any
) -> tuple[Report, float]:
    """Judge a device with the timers of a real line: the report, and how long (s) the run took."""

    def link(tap: LinkListener | None) -> VirtualLink:
        stopped = isinstance(device, StoppedDevice)
        return StoppedLink(device, tap) if stopped else VirtualLink(device, BYTE_TIME, tap)

    line = OnLine(protocol, link, latency_ns=0, look_ns=0)
    report = run_suite(line.target, Options(**options), listeners, logged=False)
    return report, line.link.now / 1e9


def jittery(device: Simulator, jitter: int, seed: int, delay: int = 0) -> NoisyDevice:
    """A device behind a line that holds each byte up by `delay` to `delay` + `jitter` ns."""
    return NoisyDevice(device, Noise(), seed, delay, jitter)


def failed(report: Report) -> list[tuple[str, str]]:
    return [(r.id, r.reason) for r in report.results if r.verdict is Verdict.FAIL]


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("jitter", JITTERS)
@pytest.mark.parametrize("name", GOOD)
def test_jitter_fails_no_good_robot(protocol: Protocol, name: str, jitter: int, seed: int) -> None:
    device = jittery(simulated(protocol, name), jitter * MS, seed)
    report, _ = run_on_line(protocol, device, level="smoke", seed=seed)
    assert failed(report) == []
    assert report.exit in (0, 3)


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(1, 4))
@pytest.mark.parametrize("jitter", JITTERS)
@pytest.mark.parametrize("name", FAULTY)
def test_jitter_lets_no_faulty_robot_pass(
    protocol: Protocol, name: str, jitter: int, seed: int
) -> None:
    device = jittery(simulated(protocol, name), jitter * MS, seed)
    report, _ = run_on_line(protocol, device, level="smoke", seed=seed, fail_fast=True)
    assert report.exit in (1, 3)


@pytest.mark.parametrize("delay", [30, 60, 90])
def test_a_line_that_is_slow_both_ways_fails_no_good_robot(protocol: Protocol, delay: int) -> None:
    """A look inside a time-out comes before the bytes of the stop are there."""
    device = jittery(Simulator(protocol), 0, 2, delay * MS)
    report, _ = run_on_line(protocol, device, level="smoke", seed=2)
    assert failed(report) == []
    assert report.exit == 0


def test_what_a_line_is_too_coarse_for_is_said_once(protocol: Protocol) -> None:
    notes = Notes()
    device = jittery(Simulator(protocol), 150 * MS, 1)
    report, took = run_on_line(protocol, device, notes, level="smoke")
    told = [sentence for sentence in notes.told if "cannot be judged" in sentence]
    assert len(told) == 1
    assert told[0].startswith("the line delays bytes by up to 1")
    assert report.exit == 3
    assert took < 200  # s; each set of cases ends where it cannot be judged


def test_an_answer_that_no_device_gives_fails_over_any_line(protocol: Protocol) -> None:
    device = jittery(simulated(protocol, "unused-code-for-valid"), 50 * MS, 1)
    report, _ = run_on_line(protocol, device, level="smoke", fail_fast=True)
    assert report.exit == 1


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(1, 5))
@pytest.mark.parametrize(
    ("stop", "period"), [(300, 1000), (300, 1013), (200, 977), (100, 700), (50, 1000), (50, 333)]
)
def test_a_device_that_stands_still_now_and_then_does_not_fail(
    protocol: Protocol, stop: int, period: int, seed: int
) -> None:
    device = StoppedDevice(Simulator(protocol), stop * MS, period * MS)
    report, _ = run_on_line(protocol, device, level="smoke", seed=seed)
    assert failed(report) == []
    assert report.exit in (0, 3)


# -- bytes that are changed, lost or doubled -------------------------------------------------------


def test_the_same_seed_is_the_same_run(protocol: Protocol) -> None:
    def run(seed: int) -> list[tuple[str, Verdict]]:
        device = NoisyDevice(Simulator(protocol), Noise(flipped=1e-3), seed)
        few = Options(level="smoke", only=("sequence/tour/*",))
        report = conform(device, grammar=protocol, options=few)
        assert device.hurt
        return [(result.id, result.verdict) for result in report.results]

    assert run(1) == run(1)
    assert run(1) != run(2)


@pytest.mark.sample(2)
@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("seed", range(3))
def test_noise_never_fails_the_reference(line: str, seed: int) -> None:
    code, told = noisy_run(Trial("", line, seed), level="smoke")
    assert code in (0, 3), told


@pytest.mark.sample(3)
@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("fault", ["speed-starts-it", "code-in-ascii", "ok-to-unknown-id"])
def test_noise_never_lets_a_faulty_device_pass(line: str, fault: str) -> None:
    code, _ = noisy_run(Trial(fault, line, 1), level="smoke")
    assert code in (1, 3)


def test_a_long_row_that_is_spoilt_again_and_again_is_no_failure(protocol: Protocol) -> None:
    """Of 1,200 bytes one is often lost: that three tries of 24 go wrong says nothing."""
    only = Options(only=("pipelined/dense",))
    codes = set()
    for seed in range(20):
        device = NoisyDevice(Simulator(protocol), Noise(dropped=2e-4), seed)
        codes.add(conform(device, grammar=protocol, options=only).exit)
    assert codes == {0, 3}
