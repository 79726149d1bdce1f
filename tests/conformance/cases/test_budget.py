"""The time that is said before a run is the time that it takes, whatever the line."""

from __future__ import annotations

import pytest

from benchmarks.noisy_device import NoisyDevice
from bilprov.analyzer.client.operations import Link, LinkListener
from bilprov.analyzer.taps.relay import Noise
from bilprov.conformance.api import Options, estimated, run_suite, select_cases
from bilprov.conformance.dut.link import Environment, Observability
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Target
from bilprov.conformance.dut.virtual_link import VirtualLink
from bilprov.spec.protocol import Protocol
from tests.support.robots import BYTE_TIME, MS, SlowProbe


@pytest.mark.slow
@pytest.mark.parametrize(
    ("byte_time", "held", "look", "few"),
    [
        pytest.param(0, 0, 0, False, id="at once"),
        pytest.param(BYTE_TIME, 0, 0, False, id="115200"),
        pytest.param(12 * BYTE_TIME, 0, 0, False, id="9600"),
        pytest.param(0, 16 * MS, 0, False, id="16 ms late"),
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
    links: list[VirtualLink] = []

    def connect(listener: LinkListener | None) -> Link:
        links.append(SlowProbe(device, byte_time, listener, look))
        return links[0]

    about = {"kind": "port", "byte_ns": byte_time, "latency_ns": held, "look_ns": look}
    seen = Observability(available=True, costly=few)
    target = Target(protocol, Environment(False, seen, False, "a line", about), connect)
    options = Options(level="smoke")

    said = estimated(target, options, select_cases(protocol, options))
    report = run_suite(target, options)

    assert report.exit == (3 if few else 0)
    assert 0.8 < said / (links[0].now / 1e9) < 1.2
