"""Stray answers: bytes outside any test case that are unexpected or missing."""

from __future__ import annotations

import pytest

from bilprov.conformance.cases.case import Case
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.run import StrayAnswers
from bilprov.spec.protocol import Protocol

FAIL, INCONCLUSIVE = Verdict.FAIL, Verdict.INCONCLUSIVE


class Told:
    """Stray answers, and what was published of them: ids, verdicts and reasons."""

    def __init__(self, protocol: Protocol) -> None:
        self.results: list[tuple[str, Verdict]] = []
        self.reasons: list[str] = []
        self.state = StrayAnswers(protocol, self._conclude)

    def _conclude(self, case: Case, axes: dict[str, Axis], *_: object, **__: object) -> None:
        self.results.append((case.id, axes["answer"].verdict))
        self.reasons.append(axes["answer"].reason)


@pytest.fixture
def told(protocol: Protocol) -> Told:
    return Told(protocol)


def test_nothing_happened_and_nothing_is_told(told: Told) -> None:
    told.state.close(keeps_all=True)

    assert told.results == []


@pytest.mark.parametrize(("times", "words"), [(1, "once"), (2, "2 times")])
def test_a_byte_or_two_may_be_the_lines(told: Told, times: int, words: str) -> None:
    for number in range(times):
        told.state.unexpected([(number, 0)], "came although nothing was sent")
    assert told.results == []  # not before the run is over: more may come

    told.state.close(keeps_all=True)

    assert told.results == [("line/unsolicited", INCONCLUSIVE)]
    assert words in told.reasons[0]


@pytest.mark.parametrize("came", [[1] * 5, [3], [1, 5], [1] * 9])
def test_three_bytes_at_once_or_five_in_all_are_the_devices_and_are_told_once(
    told: Told, came: list[int]
) -> None:
    for count in came:
        told.state.unexpected([(number, 0) for number in range(count)], "came")

    assert told.results == [("line/unsolicited", FAIL)]
    told.state.close(keeps_all=True)
    assert told.results == [("line/unsolicited", FAIL)]


def test_what_was_lost_is_told_of_a_device_that_loses_nothing(told: Told) -> None:
    told.state.missing(1)
    told.state.missing(0)
    told.state.missing(15)

    told.state.close(keeps_all=True)

    assert told.results == [("line/lost", INCONCLUSIVE)]
    assert "16 times" in told.reasons[0]


def test_a_device_that_may_lose_what_follows_a_fault_is_not_blamed(told: Told) -> None:
    told.state.missing(3)

    told.state.close(keeps_all=False)

    assert told.results == []


def test_a_device_that_stopped_answering_fails_and_that_is_all(told: Told) -> None:
    told.state.missing(3)
    told.state.silent("the device stopped answering")
    told.state.close(keeps_all=True)

    assert told.results == [("line/lost", FAIL)]
    assert told.reasons == ["the device stopped answering"]
