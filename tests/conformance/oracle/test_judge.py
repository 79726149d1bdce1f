"""Judging: a choice where the document is silent gets the verdict that its reading names.

Single axes are judged from hand-made answers and looks, and in some whole runs.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.client.operations import Received
from bilprov.captures.schemas import MS, Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.single_frames import all_cases
from bilprov.conformance.dut.simulator import Fault, Simulator
from bilprov.conformance.oracle.judge import contradiction, judge_answers, judge_state, lost
from bilprov.conformance.oracle.profile import Timers
from bilprov.conformance.oracle.state_model import FAULT, ExpectedState
from bilprov.conformance.oracle.verdicts import Axis, Verdict, exit_code, worst
from bilprov.spec.motion import Motion, visible_motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import STATE_POINTS
from bilprov.spec.state import State
from tests.conformance.oracle.test_state_model import DRIVING, TURNING
from tests.support.car import frame_effect, model_of
from tests.support.robots import Blind, simulated

PASS, INFORMATIONAL, NON_STRICT = Verdict.PASS, Verdict.INFORMATIONAL, Verdict.NON_STRICT
INCONCLUSIVE, FAIL = Verdict.INCONCLUSIVE, Verdict.FAIL
ERROR, SKIPPED = Verdict.ERROR, Verdict.SKIPPED


@pytest.fixture(scope="module")
def cases(protocol: Protocol) -> dict[str, Case]:
    return {case.id: case for case in all_cases(protocol, 1, every_cut=True)}


# -- the answer axis ------------------------------------------------------------------------------


def judged(
    protocol: Protocol, case: Case, *heard: tuple[int, int], timed: bool = True, **more: Timers
) -> Axis:
    """The answer axis of a case after which these answers came, each as (ns, code)."""
    limits = more.get("timers", Timers())
    received = Received(heard, 2000 * MS)
    return judge_answers(protocol, case.accepted, received, 0, timed=timed, timers=limits)


@pytest.mark.parametrize(
    ("ident", "codes", "verdict", "reading"),
    [
        ("valid/Speed/255", [0], PASS, ""),
        ("valid/Speed/255", [1], FAIL, ""),
        ("valid/Speed/255", [], FAIL, ""),
        ("unused-id/9/0", [1], PASS, ""),
        ("unused-id/9/0", [3], FAIL, ""),  # nothing is too many where nothing is announced
        ("unused-id/9/0", [4], FAIL, ""),
        ("unused-id/9/4", [1], PASS, ""),
        ("unused-id/9/4", [3], NON_STRICT, "R-unused-length"),
        ("unused-id/9/4", [4], NON_STRICT, "R-unused-length"),
        ("unused-id/9/4", [2], FAIL, ""),
        ("unused-id/9/4", [0], FAIL, ""),
        ("unused-id/9/4", [], FAIL, ""),
        ("wrong-length/Speed/3", [3], PASS, ""),
        ("wrong-length/Speed/3", [1], FAIL, ""),  # R-known-length
        ("wrong-length/Speed/3", [4], FAIL, ""),
        ("wrong-length/Speed/3", [2], FAIL, ""),
        ("wrong-length/Speed/0", [4], PASS, ""),
        ("wrong-length/Speed/0", [1], FAIL, ""),
        ("wrong-length/Speed/0", [3], FAIL, ""),
        ("bad-data/LED/8", [2], PASS, ""),
        ("bad-data/LED/8", [0], FAIL, ""),
        ("truncated/Right/0", [4], PASS, ""),
        ("truncated/Right/0", [], NON_STRICT, "R-truncated-known"),
        ("truncated/Right/0", [3], FAIL, ""),
        ("truncated/Right/0", [0], FAIL, ""),
        ("truncated/9/4/2", [1], PASS, ""),
        ("truncated/9/4/2", [4], NON_STRICT, "R-truncated-unused"),
        ("truncated/9/4/2", [3], NON_STRICT, "R-truncated-unused"),
        ("truncated/9/4/2", [2], FAIL, ""),
        ("truncated/Stop/4/2", [4], PASS, ""),
        ("truncated/Stop/4/2", [3], NON_STRICT, "R-truncated-long"),
        ("truncated/Stop/4/2", [1], FAIL, ""),
        ("valid/Stop", [0, 0], FAIL, ""),
        ("unused-id/9/4", [1, 1], FAIL, ""),
        ("bad-data/LED/8", [2, 0], FAIL, ""),
        ("valid/Stop", [5], FAIL, ""),
        ("bad-data/LED/8", [255], FAIL, ""),
        ("truncated/Right/0", [4, 200], FAIL, ""),
    ],
)
def test_a_list_of_answers_gets_the_verdict_of_its_reading(
    protocol: Protocol,
    cases: dict[str, Case],
    ident: str,
    codes: list[int],
    verdict: Verdict,
    reading: str,
) -> None:
    axis = judged(protocol, cases[ident], *((i * MS, code) for i, code in enumerate(codes)))

    assert (axis.verdict, axis.reading or "") == (verdict, reading)
    assert bool(axis.reason) is (verdict is not PASS)


@pytest.mark.parametrize("ident", ["valid/Stop", "unused-id/9/1", "truncated/Right/0"])
def test_an_unused_code_is_never_right(
    protocol: Protocol, cases: dict[str, Case], ident: str
) -> None:
    for code in range(5, 256):
        axis = judged(protocol, cases[ident], (0, code))
        assert axis.verdict is FAIL
        assert f"{code:02x} unused" in axis.reason


@pytest.mark.parametrize(
    ("deadline", "late", "verdict", "reason"),
    [
        (100, 100, PASS, ""),
        (100, 101, NON_STRICT, "slow: answered after 101 ms, expected within 100 ms"),
        (100, 1000, NON_STRICT, "slow: answered after 1000 ms, expected within 100 ms"),
        (100, 1001, FAIL, "answered after 1001 ms, at most 1000 ms are allowed"),
        (1500, 1400, PASS, ""),
        (1500, 1501, FAIL, "answered after 1501 ms, at most 1500 ms are allowed"),
    ],
)
def test_the_deadline_of_the_run_decides_whether_an_answer_is_slow(
    protocol: Protocol,
    cases: dict[str, Case],
    deadline: int,
    late: int,
    verdict: Verdict,
    reason: str,
) -> None:
    limits = Timers().due_within(deadline * MS)

    axis = judged(protocol, cases["valid/Stop"], (late * MS, 0), timers=limits)

    assert (axis.verdict, axis.reason) == (verdict, reason)
    assert (axis.reading == "R-answer-deadline") is (verdict is not PASS)


def test_a_right_answer_is_not_slow_where_a_time_out_comes_first(
    protocol: Protocol, cases: dict[str, Case]
) -> None:
    axis = judged(protocol, cases["truncated/Right/0"], (700 * MS, 4), timed=False)

    assert axis.verdict is PASS


def test_a_slow_answer_of_another_reading_keeps_the_readings_name(
    protocol: Protocol, cases: dict[str, Case]
) -> None:
    axis = judged(protocol, cases["unused-id/9/4"], (500 * MS, 3))

    assert (axis.verdict, axis.reading) == (NON_STRICT, "R-unused-length")


def test_an_instruction_that_was_lost_keeps_a_verdict_that_is_as_bad_already() -> None:
    slow = Axis(NON_STRICT, "00 OK", "00 OK", "slow", "R-answer-deadline")

    assert lost(slow) is slow
    assert lost(Axis(FAIL, "", "", "wrong")).reason == "wrong"
    told = lost(Axis(PASS, "00 OK", "00 OK"))
    assert (told.verdict, told.reading) == (NON_STRICT, "R-drain-known")


# -- the state axis -------------------------------------------------------------------------------

RESTED = DRIVING.but(motion=Motion.STOPPED, steering=0)


def told(state: State, **other: Any) -> Look:
    """A look that tells this state, or something else."""
    facets = {
        "t": 0,
        "moving": state.moving,
        "motion": str(visible_motion(state)),
        "speed": state.speed,
        "steering": state.steering,
        "led": state.led,
    }
    return CarLook(**(facets | other))


ZEROED = {"R-fault-state speed": "zeroed"}
KEPT = {"R-fault-state steering": "kept"}
OFF = {"R-led-state fault": "off"}
STOP_ZEROED = {"R-stop-speed": "zeroed"}
STOP_KEPT = {"R-stop-steering": "kept"}
STOP_OFF = {"R-led-state stop": "off"}
STRAIGHTENED = {"R-drive-steering": "straight"}
RESET = {"R-rotate-steering": "reset"}
NEXT = {"R-speed-moving": "next-motion"}
CURVE = {"R-steer-rotating": "curve"}

# What was done, from where; the device's choices; what is seen; the verdict and its reading.
STATES = [
    ("fault", DRIVING, {}, told(RESTED), PASS, ""),
    ("fault", DRIVING, ZEROED, told(RESTED, speed=0), INFORMATIONAL, "R-fault-state"),
    ("fault", DRIVING, KEPT, told(RESTED, steering=40), INFORMATIONAL, "R-fault-state"),
    ("fault", DRIVING, OFF, told(RESTED, led=0), INFORMATIONAL, "R-led-state"),
    ("fault", DRIVING, ZEROED, told(RESTED, speed=100), FAIL, ""),
    ("fault", DRIVING, KEPT, told(RESTED, steering=39), FAIL, ""),
    ("fault", DRIVING, OFF, told(RESTED, led=2), FAIL, ""),
    ("fault", DRIVING, ZEROED, told(RESTED, speed=0, led=2), FAIL, ""),
    ("Stop", DRIVING, STOP_ZEROED, told(RESTED, speed=0), NON_STRICT, "R-stop-speed"),
    ("Stop", DRIVING, STOP_KEPT, told(RESTED, steering=40), NON_STRICT, "R-stop-steering"),
    ("Stop", DRIVING, STOP_OFF, told(RESTED, led=0), INFORMATIONAL, "R-led-state"),
    ("Stop", DRIVING, STOP_ZEROED | STOP_OFF, told(RESTED, speed=0, led=0),
     NON_STRICT, "R-stop-speed"),
    ("Stop", DRIVING, STOP_ZEROED, told(RESTED, speed=7), FAIL, ""),
    ("Stop", DRIVING, STOP_OFF, told(RESTED, led=7), FAIL, ""),
    # A stop is no fault: a choice that was shown for the one says nothing of the other.
    ("Stop", DRIVING, ZEROED | KEPT | OFF, told(RESTED), PASS, ""),
    ("fault", DRIVING, STOP_ZEROED | STOP_KEPT | STOP_OFF, told(RESTED), PASS, ""),
    ("RotateLeft", DRIVING, {}, told(TURNING), PASS, ""),
    ("RotateLeft", DRIVING, RESET, told(TURNING, steering=0), INFORMATIONAL, "R-rotate-steering"),
    ("RotateLeft", DRIVING, RESET, told(TURNING, steering=-40), FAIL, ""),
    # Neither choice says anything of the other.
    ("RotateLeft", DRIVING, STRAIGHTENED, told(TURNING), PASS, ""),
    ("RotateLeft", DRIVING, STRAIGHTENED, told(TURNING, steering=0), FAIL, ""),
    ("RotateLeft", DRIVING, {}, told(TURNING, speed=0), FAIL, ""),
    ("RotateLeft", DRIVING, {}, told(DRIVING), FAIL, ""),
    ("Speed 90", DRIVING, NEXT, told(DRIVING), NON_STRICT, "R-speed-moving"),
    # A probe may tell the speed that is set, or the one that the wheels turn with.
    ("Speed 90", DRIVING, NEXT, told(DRIVING, speed=90), NON_STRICT, "R-speed-moving"),
    ("Speed 90", DRIVING, NEXT, told(DRIVING, speed=91), FAIL, ""),
    ("LED 2", DRIVING, {}, told(DRIVING), FAIL, ""),
    ("Right 9", DRIVING, {}, told(DRIVING), FAIL, ""),
    ("Left 9", TURNING, CURVE, told(TURNING, motion="forward", steering=-9),
     INFORMATIONAL, "R-steer-rotating"),
    ("Left 9", TURNING, CURVE, told(TURNING, motion="stopped", moving=False, steering=-9),
     FAIL, ""),
    ("Left 9", TURNING, CURVE, told(TURNING, steering=-9, left=0, right=100),
     INFORMATIONAL, "R-steer-rotating"),
    ("Left 9", TURNING, CURVE, told(TURNING, steering=-9, left=-1, right=100), FAIL, ""),
    ("Right 9", RESTED, {}, told(DRIVING, steering=9), FAIL, ""),
    # R-speed-zero: a probe may name the direction that is set although the wheels stand still.
    ("Speed 0", DRIVING, {}, told(DRIVING, speed=0, moving=False), PASS, ""),
]  # fmt: skip


def test_every_point_about_the_state_is_held_here() -> None:
    assert {point for row in STATES for point in row[2]} == set(STATE_POINTS)


@pytest.mark.parametrize(("what", "before", "shown", "look", "verdict", "reading"), STATES)
def test_a_state_gets_the_verdict_of_the_choice_that_the_device_has_shown(
    protocol: Protocol,
    what: str,
    before: State,
    shown: dict[str, str],
    look: Look,
    verdict: Verdict,
    reading: str,
) -> None:
    name, *values = what.split()
    model = model_of(protocol, shown)

    expected_state = model.after(
        ExpectedState(before), frame_effect(protocol, name, *map(int, values))
    )

    axis = judge_state(model, expected_state, look)
    assert (axis.verdict, axis.reading or "") == (verdict, reading)
    assert bool(axis.reason) is (verdict is not PASS)


def test_what_no_choice_would_show_contradicts_none(protocol: Protocol) -> None:
    model = model_of(protocol)

    for look in (told(RESTED, speed=100), told(RESTED, led=2), told(DRIVING)):
        assert contradiction(model, ExpectedState(DRIVING), FAULT, look) == ("", "")


def test_what_is_judged_elsewhere_is_not_judged_again(protocol: Protocol) -> None:
    model = model_of(protocol)
    look = told(RESTED, moving=True)

    assert judge_state(model, ExpectedState(RESTED), look).verdict is FAIL
    assert judge_state(model, ExpectedState(RESTED), look, ("moving", "motion")).verdict is PASS


@pytest.mark.parametrize("facet", ["speed", "steering", "led"])
def test_what_nobody_knows_is_not_held_against_the_device(protocol: Protocol, facet: str) -> None:
    model = model_of(protocol)
    look = told(RESTED, **{facet: 3})

    assert judge_state(model, ExpectedState(RESTED), look).verdict is FAIL
    assert judge_state(model, ExpectedState(RESTED, frozenset({facet})), look).verdict is PASS


STRAIGHT = DRIVING.but(steering=0)


@pytest.mark.parametrize(
    ("state", "left", "right", "verdict"),
    [
        (STRAIGHT, 100, 100, PASS),
        (STRAIGHT, 100, 96, PASS),  # encoders measure
        (STRAIGHT, 20, 23, PASS),
        (STRAIGHT, 100, 94, FAIL),
        (STRAIGHT, 20, 24, FAIL),
        (STRAIGHT, -100, -100, FAIL),
        (STRAIGHT, 0, 0, FAIL),
        (DRIVING, 100, 60, PASS),
        (DRIVING, 100, 100, PASS),  # no mixing law is given
        (DRIVING, 98, 100, PASS),
        (DRIVING.but(steering=200), 100, 100, FAIL),  # but so much of it must show
        (DRIVING.but(steering=200, speed=20), 10, 10, PASS),  # unless it is as slow as that
        (DRIVING.but(steering=200), 100, 99, PASS),
        (DRIVING, 100, -20, PASS),
        (DRIVING, 60, 100, FAIL),
        (DRIVING.but(steering=-40), 60, 100, PASS),
        (DRIVING.but(steering=-40), 100, 60, FAIL),
        (DRIVING.but(motion=Motion.BACKWARD), -100, -60, PASS),
        (DRIVING.but(motion=Motion.BACKWARD), -60, -100, FAIL),
        (DRIVING.but(motion=Motion.BACKWARD), 100, 60, FAIL),
        (TURNING, -100, 100, PASS),
        (TURNING, -100, 20, PASS),
        (TURNING, 100, -100, FAIL),
        (TURNING, 100, 100, FAIL),
        (RESTED, 0, 0, PASS),
        (RESTED, 0, 1, FAIL),
    ],
)
def test_wheels_are_judged_by_their_signs_and_by_which_is_faster(
    protocol: Protocol, state: State, left: int, right: int, verdict: Verdict
) -> None:
    model = model_of(protocol)

    axis = judge_state(model, ExpectedState(state), told(state, left=left, right=right))

    assert axis.verdict is verdict


@given(
    facets=st.sets(st.sampled_from(["moving", "motion", "speed", "steering", "led"])),
    state=st.sampled_from([DRIVING, RESTED, TURNING]),
)
def test_what_the_probe_does_not_tell_is_not_held_against_the_device(
    protocol: Protocol, facets: set[str], state: State
) -> None:
    look = told(state, **dict.fromkeys(facets))

    assert judge_state(model_of(protocol), ExpectedState(state), look).verdict is PASS


# -- whole runs -----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "only", "axis", "reading", "reason"),
    [
        ("swallows-missing-data", "wrong-length/Right/0", "answer", "R-example-right", "next byte"),
        ("restarts-by-itself", "wrong-length/Speed/*", "stop", "", "moved again by itself"),
        ("stops-late", "wrong-length/Speed/*", "stop", "R-stop-latency", "still moves"),
        ("R-power-on=another-speed", "valid/Stop", "state", "R-power-on", ""),
    ],
)
def test_a_run_names_the_axis_the_reading_and_the_reason(
    protocol: Protocol, name: str, only: str, axis: str, reading: str, reason: str
) -> None:
    report = conform(simulated(protocol, name), options=Options(only=(only,)))

    odd = [r.axes[axis] for r in report.results if axis in r.axes and r.axes[axis].verdict > PASS]
    assert [one for one in odd if (one.reading or "") == reading and reason in one.reason]


def saying_only_whether_it_moves(look: Look) -> Look:
    return CarLook(t=look.t, moving=look.moving)


def saying_nothing(look: Look) -> Look:
    return CarLook(look.t, None)


@pytest.mark.parametrize("show", [saying_only_whether_it_moves, saying_nothing, None])
def test_what_nobody_sees_is_inconclusive_and_the_answers_are_judged(
    protocol: Protocol, show: Callable[[Look], Look] | None
) -> None:
    robot = Simulator(protocol, Fault("x", "test", "", show=show))
    only = ("valid/LED/1", "valid/Forward", "valid/*/1", "unused-id/1?/1", "bad-data/LED/1*")

    report = conform(robot if show else Blind(robot), options=Options(only=only))

    assert report.exit == 3
    mine = [r for r in report.results if r.id.startswith(("valid", "unused", "bad"))]
    answers = {r.axes["answer"].verdict for r in mine if "answer" in r.axes}
    # A fault is not sent where nobody sees whether the robot moves before it.
    assert answers == ({PASS, INCONCLUSIVE} if show is saying_nothing else {PASS})
    settings = [r for r in mine if r.id.startswith("valid")]
    assert {r.verdict for r in settings} == {INCONCLUSIVE}
    assert all("not observable" in r.axes["state"].reason for r in settings)
    stops = {r.verdict for r in mine if r not in settings}
    assert stops == {PASS if show is saying_only_whether_it_moves else INCONCLUSIVE}


# -- verdicts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("verdicts", "code", "strict"),
    [
        ([], 0, 0),
        ([SKIPPED], 0, 0),
        ([PASS, SKIPPED], 0, 0),
        ([PASS, INFORMATIONAL], 0, 0),
        ([PASS, NON_STRICT], 0, 1),
        ([PASS, INCONCLUSIVE], 3, 3),
        ([INCONCLUSIVE, NON_STRICT], 3, 1),
        ([ERROR, INCONCLUSIVE], 2, 2),
        ([ERROR, NON_STRICT], 2, 1),
        ([FAIL, INCONCLUSIVE], 1, 1),
        ([FAIL, ERROR, INCONCLUSIVE], 1, 1),
    ],
)
def test_the_exit_code_follows_the_contract(
    verdicts: list[Verdict], code: int, strict: int
) -> None:
    for order in permutations(verdicts):
        assert exit_code(order) == code
        assert exit_code(order, strict=True) == strict


@given(st.lists(st.sampled_from(Verdict), min_size=1))
def test_the_worst_verdict_counts(verdicts: list[Verdict]) -> None:
    order = [SKIPPED, PASS, INFORMATIONAL, NON_STRICT, INCONCLUSIVE, FAIL, ERROR]

    assert worst(verdicts) is max(verdicts, key=order.index)
