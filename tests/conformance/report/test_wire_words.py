"""Wire log entries in words: frames split as a device splits them, answers by their codes."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from bilprov.conformance.oracle.profile import Figures
from bilprov.conformance.oracle.verdicts import WireEvent
from bilprov.conformance.report.html.cases import WireWords
from bilprov.conformance.report.run_report import Grammar
from bilprov.spec.protocol import Protocol
from tests.support.reports import every_verdict


def sent(hex: str, t: int = 0) -> WireEvent:
    return WireEvent(t / 1e3, "sent", hex)


def words(protocol: Protocol, *log: WireEvent, **profile: float) -> list[str]:
    report = replace(every_verdict(protocol), profile=Figures(**profile))
    return list(WireWords(protocol, report).of(log))


def test_a_frame_that_comes_in_parts_is_one_frame(protocol: Protocol) -> None:
    assert words(protocol, sent("11"), sent("05", 49), sent("20", 50)) == [
        "Speed, 0 of 1 data byte so far",
        "(goes on), Speed speed=5",
        "Forward",
    ]


def test_after_the_time_out_a_byte_is_a_header_again(protocol: Protocol) -> None:
    log = (sent("11"), sent("20", 30))

    assert words(protocol, *log)[1] == "(goes on), Speed speed=32"
    assert words(protocol, *log, truncation_timeout_ms=25.0)[1] == "Forward"
    assert words(protocol, sent("11"), sent("20", 60))[1] == "Forward"


@pytest.mark.slow
@pytest.mark.parametrize("odd", [None, 0])
def test_a_measured_time_out_that_is_none_is_passed_over(protocol: Protocol, odd: object) -> None:
    log = (sent("11"), sent("20", 30))

    assert words(protocol, *log, truncation_timeout_ms=odd)[1] == "(goes on), Speed speed=32"


def test_answers_looks_and_gaps_are_told(protocol: Protocol) -> None:
    log = (
        WireEvent(0, "received", "00 00 04 2a"),
        WireEvent(1e-9, "look", look="moving forward"),
        WireEvent(2e-9, "clipped", look="7 entries are left out here"),
    )

    assert words(protocol, *log) == [
        "2 × 00 OK, 04 TOO_FEW_DATA, 2a unused",
        "moving forward",
        "7 entries are left out here",
    ]


def test_another_grammar_has_its_own_words_and_foreign_bytes_have_none(
    protocol: Protocol, horn: Protocol
) -> None:
    report = replace(every_verdict(protocol), grammar=Grammar("horn", "1", horn.sha256, ""))

    assert list(WireWords(horn, report).of([sent("91 02")])) == ["Horn sound=2"]
    assert list(WireWords(protocol, report).of([sent("91 02")])) == [""]
