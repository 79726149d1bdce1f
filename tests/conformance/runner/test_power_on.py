"""The first bytes of a run, on devices that send more than the answers."""

from __future__ import annotations

import pytest

from bilprov.analyzer.client.operations import drive
from bilprov.captures.schemas import MS
from bilprov.conformance.api import Options, conform, select_cases
from bilprov.conformance.cases.budget import group
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Device
from bilprov.conformance.oracle.profile import Timers
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.runner.executor import Runner
from bilprov.conformance.runner.run import SPARE_ANSWERS
from bilprov.spec.protocol import Protocol
from tests.support.robots import CountingLink, Hidden, cases_of, new_run, simulated

FEW = Options(only=("wrong-length/Stop/*",))


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


@pytest.mark.sample(6)
@pytest.mark.parametrize("count", [1, 3, 10])
@pytest.mark.parametrize("at", [1, 60, 150, 400])
def test_bytes_that_come_before_the_first_case_and_belong_to_none_are_never_a_pass(
    protocol: Protocol, at: int, count: int
) -> None:
    device = Simulator(protocol)
    for number in range(count):
        device.answer(0x21, (at + 60 * number) * MS)

    found = verdicts(Hidden(device), protocol)

    # The line may have made a few of them.
    assert max(found.values()) in (Verdict.FAIL, *([Verdict.INCONCLUSIVE] if count < 10 else []))
    assert found["power-on/Forward"] is Verdict.SKIPPED


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

    options = Options(level="smoke")
    report = conform(Endless(protocol), grammar=protocol, options=options)

    assert report.exit == 1
    assert 0 < report.counts["fail"] < 20
    # Nothing of the suite is judged: what was not run is inconclusive, by name.
    whole = {case.id for case in select_cases(protocol, options)}
    left = {r.id for r in report.results if r.verdict is Verdict.INCONCLUSIVE}
    assert len(whole) > 30
    most = max(len(r.received) - 2 * len(r.sent) for r in report.results)
    assert 0 < most <= 2 * SPARE_ANSWERS  # what it floods does not fill the memory
    assert whole - left == {r.id for r in report.results if r.verdict is Verdict.FAIL} & whole


@pytest.mark.parametrize(
    ("switched", "verdict", "reason"),
    [
        (True, Verdict.FAIL, "loses one of the first instructions after power-on"),
        (False, Verdict.INCONCLUSIVE, "--power would distinguish noise from a fault"),
    ],
)
def test_a_first_instruction_that_was_lost_is_a_fault_where_another_power_on_shows_it(
    protocol: Protocol, switched: bool, verdict: Verdict, reason: str
) -> None:
    device = simulated(protocol, "second-frame-unanswered")

    report = conform(device if switched else Hidden(device), grammar=protocol, options=FEW)

    (lost,) = [result for result in report.results if result.id == "power-on/lost"]
    assert lost.verdict is verdict
    assert lost.reason.endswith(reason)


class Garbled(Simulator):
    """Its first answer after each power-on is another byte, on a line that may lose some."""

    lossless = False
    wrong = bytes.fromhex("21 fe cd ab 3c ee da bf")

    def power_cycle(self, now: int) -> None:
        super().power_cycle(now)
        self.fresh = True

    def answer(self, code: int, at: int) -> None:
        if self.fresh:
            code, self.wrong, self.fresh = self.wrong[0], self.wrong[1:] + self.wrong[:1], False
        super().answer(code, at)


def test_a_first_answer_that_is_wrong_in_another_way_each_time_fails(protocol: Protocol) -> None:
    found = verdicts(Garbled(protocol), protocol)

    assert found["power-on/Speed"] is found["power-on/Forward"] is Verdict.FAIL


class Other(Simulator):
    """Answers with the next bytes of a text instead of its codes: `each` bytes to each answer."""

    def __init__(self, protocol: Protocol, text: bytes, each: int = 1) -> None:
        super().__init__(protocol)
        self._text, self._each, self.said = text, each, 0

    def answer(self, code: int, at: int) -> None:
        for offset in range(self._each):
            super().answer(self._text[self.said % len(self._text)], at + offset * MS // 10)
            self.said += 1


def on_a_port(device: Device, protocol: Protocol) -> Runner:
    """The run of one case on a device that need not be one of this protocol."""
    runner = Runner(new_run(protocol, virtual=False), select_cases(protocol, FEW), discover=False)
    drive(runner.execute(), CountingLink(device), lambda: False)
    return runner


@pytest.mark.parametrize(
    ("text", "each"),
    [(b"0", 1), (b"ets Jun  8 boot: 0x13\r\n", 7), (b"\xff\xfe\xf8\x80", 1), (b"\x05", 2)],
)
def test_what_answers_with_no_code_at_all_is_another_device(
    protocol: Protocol, text: bytes, each: int
) -> None:
    runner = on_a_port(Other(protocol, text, each), protocol)

    assert runner.run.results == []
    assert runner.unusable.startswith("none of the first 40 answers is a code of the grammar")
    assert any(f"({byte:02x} " in runner.unusable for byte in text)
    assert runner.unusable.isprintable()


def test_a_device_that_falls_silent_is_told_by_the_few_answers_that_came(
    protocol: Protocol,
) -> None:
    class Tiring(Other):
        def answer(self, code: int, at: int) -> None:
            if self.said < 9:
                super().answer(code, at)

    runner = on_a_port(Tiring(protocol, b"0"), protocol)

    assert runner.run.results == []
    assert "is no code" in runner.unusable or "answers is a code" in runner.unusable
    assert "none of the first 40" not in runner.unusable


def test_one_code_among_the_first_answers_is_a_device_to_be_judged(protocol: Protocol) -> None:
    runner = on_a_port(Other(protocol, b"\xff" * 39 + b"\x00"), protocol)

    assert runner.unusable == ""
    assert any(result.verdict is Verdict.FAIL for result in runner.run.results)


def test_a_device_object_is_judged_whatever_it_answers(protocol: Protocol) -> None:
    report = conform(Other(protocol, b"0"), grammar=protocol, options=FEW)

    assert (report.exit, report.unusable) == (1, None)


def test_a_slow_device_that_takes_too_long_is_told_so_and_no_group_left_out_passes(
    protocol: Protocol,
) -> None:
    told: list[str] = []
    slow = simulated(protocol, "R-answer-deadline=150-ms")
    run = new_run(protocol, timers=Timers(run_budget=5_000 * MS), note=told.append)
    drive(Runner(run, cases_of(protocol, "*")).execute(), CountingLink(slow), lambda: False)

    (sentence,) = told
    assert sentence.endswith(" s and get 5 s: those that add least are left out")
    left_out = [r for r in run.results if "5 s are too short for every case" in r.reason]
    judged = {group(r.id) for r in run.results if r not in left_out}
    alone = [r for r in left_out if group(r.id) not in judged]
    assert {r.verdict for r in alone} == {Verdict.INCONCLUSIVE}
    assert {r.verdict for r in left_out if r not in alone} == {Verdict.SKIPPED}
