"""The first bytes of a run, on devices that send more than the answers."""

from __future__ import annotations

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.api import Options, conform, select_cases
from bilprov.conformance.dut.link import Device
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.protocol import Protocol

FEW = Options(only=("wrong-length/Stop/*",))


class WithoutPowerSwitch:
    """A device object with the four methods that the suite needs, and no more."""

    def __init__(self, device: Simulator) -> None:
        self.receive = device.receive
        self.advance = device.advance
        self.deadline = device.deadline
        self.look = device.look


def verdicts(device: Device, protocol: Protocol) -> dict[str, Verdict]:
    report = conform(device, grammar=protocol, options=FEW)
    return {result.id: result.verdict for result in report.results}


class Introducing(Simulator):
    """Sends a line of text when the first byte has woken it, and answers from then on."""

    awake = False

    def receive(self, data: bytes, now: int) -> None:
        if self.awake:
            super().receive(data, now)
            return
        self.awake = True
        for offset, byte in enumerate(b"robot v1\r\n"):
            self.answer(byte, now + offset * MS // 10)


def test_a_banner_instead_of_the_first_answer_is_informational(protocol: Protocol) -> None:
    found = verdicts(Introducing(protocol), protocol)

    assert found["power-on/at-rest"] is Verdict.INFORMATIONAL
    assert found["power-on/Speed"] is Verdict.PASS
    assert max(found.values()) is Verdict.INFORMATIONAL


def test_bytes_before_the_first_instruction_are_informational(protocol: Protocol) -> None:
    device = Simulator(protocol)
    device.answer(ord("!"), 0)

    assert verdicts(device, protocol)["power-on/at-rest"] is Verdict.INFORMATIONAL


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("at", [1, 30, 60, 100, 150, 400])
def test_bytes_that_come_before_the_first_case_and_belong_to_none_are_never_a_pass(
    protocol: Protocol, at: int, count: int
) -> None:
    device = Simulator(protocol)
    for number in range(count):
        device.answer(0x21, (at + 60 * number) * MS)

    found = verdicts(WithoutPowerSwitch(device), protocol)

    assert max(found.values()) in (Verdict.INCONCLUSIVE, Verdict.FAIL)  # the line may have made it
    assert found["power-on/Forward"] is Verdict.SKIPPED


@pytest.mark.parametrize("at", [1, 30, 60, 100, 150, 400])
def test_bytes_that_come_again_and_again_and_belong_to_no_case_fail(
    protocol: Protocol, at: int
) -> None:
    device = Simulator(protocol)
    for number in range(10):
        device.answer(0x21, (at + 60 * number) * MS)

    assert Verdict.FAIL in verdicts(WithoutPowerSwitch(device), protocol).values()


def test_a_device_that_has_been_driven_before_is_not_blamed_for_how_it_was_found(
    protocol: Protocol,
) -> None:
    device = Simulator(protocol)
    conform(device, grammar=protocol, options=FEW)
    assert device.state != protocol.power_on

    found = verdicts(device, protocol)
    assert found["power-on/at-rest"] in (Verdict.PASS, Verdict.INFORMATIONAL)
    assert max(found.values()) <= Verdict.INFORMATIONAL


def test_a_device_object_that_never_stops_sending_ends_the_run(protocol: Protocol) -> None:
    class Endless(Simulator):
        def advance(self, now: int) -> bytes:
            return super().advance(now) + bytes(1000)

    report = conform(Endless(protocol), grammar=protocol)

    assert report.exit == 1
    assert 0 < report.counts["fail"] < 20
    # Nothing of the suite is judged: what was not run is inconclusive, by name.
    whole = {case.id for case in select_cases(protocol, Options())}
    left = {r.id for r in report.results if r.verdict is Verdict.INCONCLUSIVE}
    assert len(whole) > 1500
    assert whole - left == {r.id for r in report.results if r.verdict is Verdict.FAIL} & whole


@pytest.mark.parametrize(
    ("switched", "verdict", "reason"),
    [
        (True, Verdict.FAIL, "loses one of the first instructions after power-on"),
        (False, Verdict.INCONCLUSIVE, "it takes --power to tell noise from a fault"),
    ],
)
def test_a_first_instruction_that_was_lost_is_a_fault_where_another_power_on_shows_it(
    protocol: Protocol, switched: bool, verdict: Verdict, reason: str
) -> None:
    device = Simulator(protocol, fault_bank(protocol)["second-frame-unanswered"])

    report = conform(
        device if switched else WithoutPowerSwitch(device), grammar=protocol, options=FEW
    )

    (lost,) = [result for result in report.results if result.id == "power-on/lost"]
    assert lost.verdict is verdict
    assert lost.reason.endswith(reason)
