"""Mixtures of two readings: each shows both choices and says when it takes which."""

from __future__ import annotations

import pytest

from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.catalogue import find_fault, find_mixture
from bilprov.conformance.mutation.variants import mixtures, variants
from bilprov.spec.codec import build, raw_frame
from bilprov.spec.protocol import Protocol

MS = 1_000_000


def speeds_after_stops(protocol: Protocol, name: str, *movers: str) -> list[int]:
    """The speed that is left after each Stop: Speed 99, a motion, Stop, and again."""
    device, now, found = Simulator(protocol, find_mixture(protocol, name)), 0, []
    for mover in movers:
        now += 10 * MS
        frames = (build(protocol, "Speed", {"speed": 99}), build(protocol, mover))
        device.receive(b"".join(frames) + build(protocol, "Stop"), now)
        found.append(device.state.speed)
    return found


def test_by_frame_it_chooses_every_second_time(protocol: Protocol) -> None:
    name = "mixture:R-stop-speed=zeroed:by-frame"

    assert speeds_after_stops(protocol, name, *["Forward"] * 4) == [0, 99, 0, 99]


def test_after_so_many_times_it_chooses_otherwise(protocol: Protocol) -> None:
    name = "mixture:R-stop-speed=zeroed:after-12"

    assert speeds_after_stops(protocol, name, *["Forward"] * 15) == [99] * 12 + [0] * 3


def test_by_motion_it_depends_on_how_it_moved(protocol: Protocol) -> None:
    name = "mixture:R-stop-speed=zeroed:by-motion"
    movers = ("Forward", "Backward", "RotateRight", "RotateLeft")

    found = speeds_after_stops(protocol, name, *movers)

    assert set(found) == {0, 99}
    assert found == speeds_after_stops(protocol, name, *movers)


def test_by_id_it_depends_on_the_instruction(protocol: Protocol) -> None:
    name = "mixture:R-unused-length=too-many:by-id"
    codes = []
    for identity in protocol.unused_ids:
        device = Simulator(protocol, find_mixture(protocol, name))
        device.receive(raw_frame(protocol, identity, 1, b"\0"), 0)
        codes.append(device.advance(0)[0])

    assert codes == [3, 1, 3, 1, 3, 1, 3]


def test_a_point_that_one_id_alone_can_show_is_not_mixed_by_id(protocol: Protocol) -> None:
    names = set(mixtures(protocol))

    assert "mixture:R-stop-speed=zeroed:by-frame" in names
    assert "mixture:R-stop-speed=zeroed:by-id" not in names
    assert "mixture:R-speed-moving=next-motion:by-id" not in names
    assert "mixture:R-competing-errors=bad-data:by-id" not in names
    assert "mixture:R-drive-steering=straight:by-id" in names
    assert "mixture:R-rotate-steering=reset:by-id" in names


def test_every_choice_that_is_no_measured_time_is_mixed(protocol: Protocol) -> None:
    mixed = {name.split(":")[1] for name in mixtures(protocol)}

    assert mixed == {variant.name for variant in variants(protocol).values() if variant.mixes}
    times = ("R-truncation-timeout", "R-answer-deadline", "R-stop-latency", "R-stop-point")
    assert not any(name.startswith(times) for name in mixed)
    assert len(mixtures(protocol)) > 60


@pytest.mark.slow
def test_each_says_what_it_does(protocol: Protocol, horn: Protocol) -> None:
    for grammar in (protocol, horn):
        docs = {fault.doc for fault in mixtures(grammar).values()}
        assert len(docs) == len(mixtures(grammar))
        assert all("but only" in doc for doc in docs)


def test_a_mixture_has_a_name_wherever_a_fault_has(protocol: Protocol) -> None:
    for name in list(mixtures(protocol))[::7]:
        assert find_fault(protocol, name).name == name


@pytest.mark.parametrize(
    "name", ["mixture:", "mixture:R-stop-speed=zeroed:by-id", "mixture:x:by-frame"]
)
def test_a_mixture_that_is_none_is_refused(protocol: Protocol, name: str) -> None:
    with pytest.raises(ValueError, match="there is no mixture"):
        find_fault(protocol, name)
