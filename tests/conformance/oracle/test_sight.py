"""What was not seen is never a pass, and never a failure: a probe that stops telling a facet."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import msgspec
import pytest

from bilprov.analyzer.client.operations import Observation, Observe
from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.catalogue import find_fault
from bilprov.conformance.oracle.profile import Choices
from bilprov.conformance.oracle.sight import Sight, facets_set, untold
from bilprov.conformance.oracle.state_model import FAULT, ExpectedState, FrameEffect, Model
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
from tests.support.car import car_state
from tests.support.reports import with_axes

PASS, NON_STRICT, FAIL = Verdict.PASS, Verdict.NON_STRICT, Verdict.FAIL
INCONCLUSIVE, SKIPPED = Verdict.INCONCLUSIVE, Verdict.SKIPPED

EVERY = ("moving", "motion", "speed", "steering", "led", "left", "right")
FACETS = {**{name: (name,) for name in EVERY[:5]}, "wheels": ("left", "right"), "every": EVERY}
PARTS = {"first": 1 / 6, "middle": 1 / 2, "last": 5 / 6}  # of the looks of a good robot's run
FAULTS = (
    *("no-stop-after-100-faults", "no-stop-after-200-faults", "every-100th-fault-missed"),
    *("fault-changes-speed", "speed-bit-0-lost", "right-bit-0-lost", "stop-takes-its-time"),
    *("stop-keeps-steering-to-the-left", "led-b-stuck-off", "fault-changes-led", "led-latches"),
    *("rotateright-rotateleft-swapped", "restarts-by-itself", "double-answer-to-faults"),
)
GOOD = (
    *("conforming", "R-watchdog=stops", "R-led-state=off", "R-speed-moving=next-motion"),
    *("R-drive-steering=straight", "R-fault-state=both", "R-answer-deadline=one-at-a-time"),
)


class LosingSight(Simulator):
    """Its probe does not tell some facets from one look on, for so many looks."""

    def __init__(
        self,
        protocol: Protocol,
        name: str,
        facets: tuple[str, ...],
        begin: int,
        looks: int = 1 << 30,
    ) -> None:
        super().__init__(protocol, None if name == "conforming" else find_fault(protocol, name))
        self.looks = 0
        self._lost = dict.fromkeys(facets)
        self._when = range(begin, begin + looks)

    def look(self, now: int) -> Look:
        self.looks += 1
        seen = super().look(now)
        return msgspec.structs.replace(seen, **self._lost) if self.looks in self._when else seen


def judged(device: Simulator, **options: Any) -> Report:
    options.setdefault("level", "smoke")
    return conform(device, grammar=device.protocol, options=Options(**options), logged=False)


@cache
def looks_of(protocol: Protocol) -> int:
    """How many looks a good robot's run has."""
    device = LosingSight(protocol, "conforming", (), 1)
    assert judged(device).exit == 0
    return device.looks


ROWS = [(name, facets, part) for name in (*FAULTS, *GOOD) for facets in FACETS for part in PARTS]


@pytest.mark.sample(2)
@pytest.mark.slow
@pytest.mark.parametrize(("name", "facets", "part"), ROWS)
def test_what_the_probe_no_longer_tells_neither_passes_nor_fails(
    protocol: Protocol, name: str, facets: str, part: str
) -> None:
    begin = int(PARTS[part] * looks_of(protocol))
    report = judged(LosingSight(protocol, name, FACETS[facets], begin))

    failed = [(r.id, r.reason) for r in report.results if r.verdict is FAIL]
    assert report.exit in ((3,) if name in GOOD else (1, 3)), failed
    told = any(f"observation {begin:,}" in sentence for sentence in report.unseen)
    assert told or report.exit == 1


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("begin", range(2, 170, 8))
def test_a_few_looks_in_the_dark_are_no_fault_while_the_choices_are_found_out(
    protocol: Protocol, name: str, begin: int
) -> None:
    report = judged(LosingSight(protocol, name, EVERY, begin, 5))

    assert report.exit == 3, [(r.id, r.reason) for r in report.results if r.verdict is FAIL]
    assert "In 5 of" in report.unseen[0]
    assert f"observation {begin:,})" in report.unseen[0]


def test_looks_in_the_dark_do_not_count_as_expected(protocol: Protocol) -> None:
    only = ("sequence/tour/001",)
    whole = judged(LosingSight(protocol, "conforming", (), 1), only=only)
    half = judged(LosingSight(protocol, "conforming", ("led",), 80), only=only)

    counts = [int(r.results[-1].axes["state"].actual.split()[0]) for r in (whole, half)]
    assert 0 < counts[1] < counts[0]
    assert re.search(r"\(first in case [a-z-]+/.*, observation 80\)", half.unseen[0])


def test_a_robot_of_which_the_last_look_tells_nothing_may_still_move(protocol: Protocol) -> None:
    last = looks_of(protocol)
    report = judged(LosingSight(protocol, "conforming", ("moving",), last))

    assert report.exit == 3
    assert report.results[-1].id == "leave/stopped"
    assert report.results[-1].verdict is INCONCLUSIVE


def test_a_probe_that_tells_the_direction_only_of_a_moving_robot_is_enough(
    protocol: Protocol,
) -> None:
    class Sparing(Simulator):
        def look(self, now: int) -> Look:
            seen = super().look(now)
            if seen.moving:
                return seen
            return msgspec.structs.replace(seen, motion=None, left=None, right=None)

    report = judged(Sparing(protocol))

    assert (report.exit, report.unseen) == (0, ())


def test_a_sequence_is_no_pass_where_the_probe_tells_only_whether_it_moves(
    protocol: Protocol,
) -> None:
    device = LosingSight(protocol, "led-b-stuck-off", EVERY[1:], 1)
    report = judged(device, only=("sequence/tour/*",))

    tours = [r for r in report.results if r.id.startswith("sequence/")]
    assert report.exit == 3
    assert {r.verdict for r in tours} == {INCONCLUSIVE}
    for tour in tours:
        assert tour.axes["state"].reason.startswith(
            "not observable: the probe does not report motion"
        )
    (sentence,) = report.unseen
    assert sentence.endswith(
        "observations did the probe report the direction, the speed, the steering, the LED"
    )


# -- the rule by itself ---------------------------------------------------------------------------


def seen(sight: Sight, *looks: Look) -> Sight:
    for look in looks:
        sight.did(Observe(), Observation(0, 0, look))
    return sight


def result(ident: str, **axes: Verdict) -> CaseResult:
    told = {name: Axis(verdict, "expected", "seen") for name, verdict in axes.items()}
    return with_axes(ident, told)


DARK = CarLook(0, None)
LIT = CarLook(0, True, "forward", 9, 0, 7, 9, 9)


@pytest.mark.parametrize(
    ("axes", "verdict"),
    [
        ({"answer": PASS}, INCONCLUSIVE),
        ({"answer": PASS, "state": PASS}, INCONCLUSIVE),
        ({"answer": PASS, "stop": NON_STRICT, "state": PASS}, INCONCLUSIVE),
        ({"state": SKIPPED}, INCONCLUSIVE),
        ({"answer": FAIL, "state": PASS}, FAIL),
        ({"answer": PASS, "stop": FAIL}, FAIL),
    ],
)
def test_a_case_with_a_look_in_the_dark_is_at_best_inconclusive(
    protocol: Protocol, axes: dict[str, Verdict], verdict: Verdict
) -> None:
    sight = Sight(protocol)
    sight.begin("one")
    seen(sight, LIT, DARK)
    found = sight.judged(result("one", **axes))

    assert found.verdict is verdict
    assert PASS not in {found.axes[name].verdict for name in ("stop", "state") if name in axes}
    sight.begin("two")
    seen(sight, LIT)
    assert sight.judged(result("two", state=PASS)).verdict is PASS


@pytest.mark.parametrize("facet", ["motion", "speed", "steering", "led", "left"])
def test_a_facet_is_missed_once_it_was_shown(protocol: Protocol, facet: str) -> None:
    without = msgspec.structs.replace(LIT, **{facet: None})
    for looks, verdict in (((without, without), PASS), ((without, LIT, without), INCONCLUSIVE)):
        sight = Sight(protocol)
        sight.begin("one")
        assert seen(sight, *looks)
        assert sight.judged(result("one", state=PASS)).verdict is verdict


def test_a_result_is_uncertain_on_the_axes_that_failed_and_are_doubted() -> None:
    doubted = result("one", answer=FAIL, stop=PASS, state=FAIL).uncertain(only=("stop", "state"))

    verdicts = {name: axis.verdict for name, axis in doubted.axes.items()}
    assert verdicts == {"answer": FAIL, "stop": PASS, "state": INCONCLUSIVE}
    assert result("two", state=FAIL).uncertain().verdict is INCONCLUSIVE


def test_a_look_between_two_cases_counts_for_the_next_one(protocol: Protocol) -> None:
    sight = Sight(protocol)
    sight.begin("one")
    assert sight.judged(result("one", state=PASS)).verdict is PASS
    seen(sight, DARK)
    assert sight.judged(result("aside", answer=PASS)).verdict is PASS
    sight.begin("two")
    assert sight.judged(result("two", state=PASS)).verdict is INCONCLUSIVE


def test_what_the_wheels_show_needs_no_other_facet(protocol: Protocol) -> None:
    spec = protocol.by_name
    forward = FrameEffect(spec["Forward"].effect)
    led = FrameEffect(spec["LED"].effect, {"rgb": 1})

    assert facets_set(protocol, [FAULT, forward, led]) == ["motion", "led"]
    assert facets_set(protocol, [FAULT, FrameEffect(spec["Stop"].effect)]) == ["steering"]
    assert (
        untold(protocol, ["motion", "led"], {"moving"}) == "the probe does not report motion, led"
    )
    assert untold(protocol, ["motion", "steering"], {"wheels"}) == ""
    assert untold(protocol, ["led"], {"wheels"}) == "the probe does not report led"


def test_what_rests_on_a_choice_that_was_not_seen_is_not_known(protocol: Protocol) -> None:
    driving = ExpectedState(car_state(Motion.FORWARD, 200, 40, 5))
    turning = ExpectedState(car_state(Motion.ROTATE_LEFT, 200, 0, 5))
    hidden = {"R-led-state fault", "R-speed-moving", "R-steer-rotating"}
    model = Model(protocol, Choices(hidden=hidden))
    shown = Model(protocol, Choices(shown=dict.fromkeys(hidden, ("", "x")), hidden=hidden))
    spec = protocol.by_name
    slower = FrameEffect(spec["Speed"].effect, {"speed": 9})
    right = FrameEffect(spec["Right"].effect, {"strength": 9})

    assert model.after(driving, FAULT).unknown == {"led"}
    assert model.after(driving, slower).unknown == {"speed"}
    again = model.after(model.after(driving, slower), FrameEffect(spec["Backward"].effect))
    assert (again.unknown, again.state.speed) == (frozenset(), 9)
    assert model.after(turning, right).unknown == {"motion", "curve"}
    for effect in (FAULT, slower, right):
        assert shown.after(driving, effect).unknown == frozenset()
