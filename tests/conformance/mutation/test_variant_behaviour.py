"""Behaviour of legal variants, on the simulator alone."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.variant_behaviour import always, at_the_header
from bilprov.spec.protocol import Protocol

STOP_AND_TWO, FORWARD = 0x02, 0x20  # headers: the first announces two data bytes too many


@pytest.mark.parametrize(
    ("timeouts", "pause"),
    [
        # The pause counts by the header, whatever the data would be as one.
        (lambda header: 500 * MS if header == STOP_AND_TWO else MS, 100 * MS),
        (lambda header: None, 10_000 * MS),  # never over
    ],
)
def test_data_behind_an_answer_at_the_header_are_dropped_until_its_own_pause_is_over(
    timeouts: Callable[[int], int | None], pause: int, protocol: Protocol
) -> None:
    fault = Fault("x", "test", "", hear=at_the_header(always), timeouts=timeouts)
    robot = Simulator(protocol, fault)

    robot.receive(bytes([STOP_AND_TWO]), 0)
    assert robot.advance(0) == b"\3"
    for turn in (1, 2):
        robot.receive(bytes([FORWARD]), turn * pause)
        assert robot.advance(turn * pause) == b""

    robot.receive(bytes([FORWARD]), 2 * pause)
    assert robot.advance(2 * pause) == b"\0"


def test_a_pause_that_truncates_a_frame_ends_its_data(protocol: Protocol) -> None:
    robot = Simulator(protocol, Fault("x", "test", "", hear=at_the_header(always), timeout=50 * MS))

    robot.receive(bytes([STOP_AND_TWO]), 0)
    robot.receive(bytes([FORWARD]), 60 * MS)

    assert robot.advance(60 * MS) == b"\3\0"
