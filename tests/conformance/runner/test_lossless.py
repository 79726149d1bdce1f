"""A line that loses nothing: one unexplained mismatch is a failure."""

from __future__ import annotations

from pathlib import Path

import pytest

from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Fault, Simulator
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.recheck import recheck
from bilprov.spec.protocol import Protocol
from tests.support.faults import at_count, every, faulty, twice, when
from tests.support.recordings import recorded
from tests.support.robots import Hidden

ONCE = "on a line that loses nothing: "


def once(number: int) -> Fault:
    return Fault("x", "test", "", react=when(every(faulty, at_count("faults", number)), twice))


@pytest.mark.slow
def test_what_is_met_once_fails_and_says_so(protocol: Protocol) -> None:
    report = conform(Simulator(protocol, once(60)), options=Options(level="smoke"))

    (failed,) = [r for r in report.results if r.verdict is Verdict.FAIL]
    assert "met once in " in failed.reason
    assert ONCE in failed.reason
    assert "flaky" not in failed.reason


@pytest.mark.slow
@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("declared", "code"), [(None, 3), (False, 3), ("yes", 3), (1, 3), (True, 1)]
)
def test_a_device_object_must_declare_it(protocol: Protocol, declared: object, code: int) -> None:
    device = Hidden(Simulator(protocol, once(60)))
    if declared is not None:
        device.lossless = declared  # type: ignore[attr-defined]

    assert conform(device, options=Options(level="smoke")).exit == code


@pytest.mark.slow
def test_a_recording_is_judged_by_what_its_link_declared(
    tmp_path: Path, protocol: Protocol
) -> None:
    for device, code in (
        (Simulator(protocol, once(60)), 1),
        (Hidden(Simulator(protocol, once(60))), 3),
    ):
        path = tmp_path / f"{code}.mcap"
        few = Options(level="smoke", only=("sequence/faults-*",))
        report = recorded(path, protocol, device=device, options=few)

        assert report.exit == code
        assert recheck(str(path)).exit == 0
