"""Noise on the line: no conforming device fails, and no faulty device passes."""

from __future__ import annotations

import pytest

from benchmarks.noise import LINES, Trial, noisy_run
from benchmarks.noisy_device import NoisyDevice
from bilprov.analyzer.taps.relay import Noise
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.protocol import Protocol

pytestmark = pytest.mark.slow


def test_both_directions_are_noisy_and_counted(protocol: Protocol):
    device = NoisyDevice(Simulator(protocol), Noise(dropped=1.0), 1)
    device.receive(b"\x00", 0)
    assert device.advance(10_000_000) == b""
    assert device.hurt == 1

    class Talker(Simulator):
        def advance(self, now: int) -> bytes:
            return b"\x00"

    device = NoisyDevice(Talker(protocol), Noise(doubled=1.0), 1)
    assert device.advance(0) == b"\x00\x00"
    assert device.hurt == 1


def test_a_delay_holds_each_byte_up_in_both_directions(protocol: Protocol):
    device = NoisyDevice(Simulator(protocol), Noise(), 1, delay=5_000_000)
    device.receive(b"\x11", 0)
    device.receive(b"\x7f", 1_000_000)

    got = []
    while (due := device.deadline()) is not None and due < 40_000_000:
        got += [(due, code) for code in device.advance(due)]

    (only,) = got
    assert only[0] >= 11_000_000  # 5 ms there after the last byte, and 5 ms back
    assert only[1] == 0
    device.receive(b"\x20", 20_000_000)
    assert not device.look(24_999_999).moving
    assert device.look(25_000_001).moving


@pytest.mark.slow
def test_the_same_seed_is_the_same_run(protocol: Protocol):
    def run(seed: int) -> list[tuple[str, Verdict]]:
        device = NoisyDevice(Simulator(protocol), Noise(flipped=1e-3), seed)
        report = conform(device, grammar=protocol, options=Options(level="smoke"))
        assert device.hurt
        return [(result.id, result.verdict) for result in report.results]

    assert run(1) == run(1)
    assert run(1) != run(2)


@pytest.mark.sample(3)
@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("seed", range(3))
def test_noise_never_fails_the_reference(line: str, seed: int):
    code, told = noisy_run(Trial("", line, seed), level="smoke")
    assert code in (0, 3), told


@pytest.mark.sample(3)
@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("fault", ["speed-starts-it", "code-in-ascii", "ok-to-unknown-id"])
def test_noise_never_lets_a_faulty_device_pass(line: str, fault: str):
    code, _ = noisy_run(Trial(fault, line, 1), level="smoke")
    assert code in (1, 3)


@pytest.mark.slow
def test_a_long_row_that_is_spoilt_again_and_again_is_no_failure(protocol: Protocol):
    """Of 1,200 bytes one is often lost: that three tries of 24 go wrong says nothing."""
    only = Options(only=("pipelined/dense",))
    codes = set()
    for seed in range(20):
        device = NoisyDevice(Simulator(protocol), Noise(dropped=2e-4), seed)
        codes.add(conform(device, grammar=protocol, options=only).exit)
    assert codes == {0, 3}
