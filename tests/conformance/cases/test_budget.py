"""The time that is said before a run is the time that it takes, whatever the line."""

from __future__ import annotations

import pytest

from benchmarks.noisy_device import NoisyDevice
from bilprov.analyzer.taps.impairment import Noise
from bilprov.conformance.api import Options, run_suite, select_cases
from bilprov.conformance.cli.conform import estimated
from bilprov.conformance.dut.link import Environment, Link, LinkListener, Observability
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Target
from bilprov.conformance.dut.virtual_link import VirtualLink
from bilprov.spec.protocol import Protocol
from tests.support.robots import BYTE_TIME, MS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("byte_time", "held"),
    [(0, 0), (BYTE_TIME, 0), (12 * BYTE_TIME, 0), (0, 16 * MS), (BYTE_TIME, 16 * MS)],
    ids=["at once", "115200", "9600", "16 ms late", "115200, 16 ms late"],
)
def test_a_run_takes_as_long_as_was_said(protocol: Protocol, byte_time: int, held: int) -> None:
    """A line that is run in virtual time with the timers of a real one: all but the host's work."""
    device = NoisyDevice(Simulator(protocol), Noise(), 1, held // 2)
    links: list[VirtualLink] = []

    def connect(listener: LinkListener | None) -> Link:
        links.append(VirtualLink(device, byte_time, listener))
        return links[0]

    about = {"kind": "port", "byte_ns": byte_time, "latency_ns": held}
    seen = Observability(available=True)
    target = Target(protocol, Environment(False, seen, False, "a line", about), connect)
    options = Options(level="smoke")

    said = estimated(target, options, select_cases(protocol, options))
    report = run_suite(target, options)

    assert report.exit == 0
    assert 0.8 < said / (links[0].now / 1e9) < 1.2
