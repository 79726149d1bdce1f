"""The causes of a run's failures: what they name and take in, and the line that shows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import pytest

from bilprov.analyzer.client.operations import (
    Listen,
    Observation,
    Procedure,
    Received,
    Send,
    drive,
    followed,
    listen,
    send,
)
from bilprov.analyzer.client.rest import home_once
from bilprov.captures.schemas import MS, look_class
from bilprov.conformance.api import Options, conform
from bilprov.conformance.causes.causes import TIERS, Cause, find_causes
from bilprov.conformance.causes.exchanges import (
    ANSWER,
    ASTRAY,
    MOTION,
    WHEELS,
    Bag,
    Deviation,
    Exchange,
    Exchanges,
    Known,
    Timing,
)
from bilprov.conformance.causes.features import Feature, Literal, features, matches
from bilprov.conformance.causes.learner import Learner, Table
from bilprov.conformance.causes.relations import Effect, Relation, relations, resuming
from bilprov.conformance.causes.reproduction import Finder, shown_by, shown_in
from bilprov.conformance.causes.trace import Done, Mark, Trace
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator
from bilprov.conformance.dut.target import VirtualLink
from bilprov.conformance.mutation.catalogue import find_fault
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.mutation.score import _names, both, explained
from bilprov.conformance.oracle.profile import Choices
from bilprov.conformance.oracle.state_model import Model
from bilprov.conformance.report.run_report import Report
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State
from tests.support.faults import EIGHT_BITS

SMOKE = Options(level="smoke")

# A fault, the worst axis, what its one cause says goes wrong, and when.
NAMED = [
    ("ok-to-unknown-id", "answer", "answers 00 OK instead of 01 BAD_HEADER", "unknown ID"),
    ("always-0", "answer", "00 OK instead of 04 TOO_FEW_DATA", "a faulty frame"),
    ("codes-reversed", "answer", "02 BAD_DATA instead of 03 TOO_MANY_DATA", "a faulty frame"),
    ("double-answer", "answer", "answers more than once", "any frame"),
    ("no-stop-on-bad-data", "stop", "does not stop", "bad data"),
    ("restarts-by-itself", "stop", "moves again by itself", "a faulty frame"),
    ("stops-late", "stop", "stops late or not at all", "a faulty frame"),
    ("stays-dead-after-two-faults", "state", "is stopped",
     "a valid frame, with two faults in a row since the last Stop"),
    ("rotateleft-does-nothing", "state", "is stopped", "RotateLeft"),
    ("speed-bit-0-lost", "state", "speed lacks bit 0", "Speed"),
    ("led-7-ignored", "state", "led stays as it was", "LED, with rgb 7"),
    ("random:96", "state", "led has bit 0 inverted", "LED"),
    ("speed-is-signed", "state", "speed is 256 minus the value", "Speed, with speed 131 or more"),
    ("every-16th-fault-missed", "stop", "does not stop", "at one in 16 of the faults"),
    ("every-10th-frame-unanswered", "answer", "gives no answer",
     "any frame, at one in 10 of the frames"),
    ("frame-after-truncation-lost", "answer", "gives no answer",
     "a valid frame, sent after a truncated frame"),
    ("sent-ahead-fault-does-not-stop", "stop", "does not stop", "a faulty frame, sent ahead"),
    ("no-stop-on-unknown-id", "stop", "does not stop", "unknown ID"),
    ("mixture:R-fault-state=speed-zeroed:by-motion", "state", "speed stays as it was",
     "a faulty frame, while motion is backward or rotate left or stopped"),
    ("mixture:R-fault-state=steering-kept:by-motion", "state", "steering is 0",
     "a faulty frame, while motion is backward or rotate left or stopped"),
    ("mixture:R-stop-steering=kept:by-frame", "state", "steering is 0",
     "Stop, at one in 2 of the Stop frames"),
    ("mixture:R-drain-known=flushed-after-wrong-lengths:by-motion", "answer", "gives no answer",
     "with the frame before it sent while motion is forward or rotate right"),
    ("no-stop-on-unknown-id-while-forward", "stop", "does not stop",
     "unknown ID, while motion is forward"),
    ("no-stop-once-it-has-rotated", "stop", "does not stop",
     "a faulty frame, with a rotation since the last Stop"),
    ("no-stop-at-the-fault-after-a-truncation", "stop", "does not stop",
     "with the last fault also the last truncated frame"),
    ("answers-fault-again-after-15-ms", "answer", "answers more than once", "a faulty frame"),
    ("runs-on-after-fault-in-a-burst", "stop", "moves again as before the fault",
     "a frame that leaves its motion, sent ahead"),
    ("restarts-on-led-after-a-fault", "stop", "moves again as before the fault", "LED"),
    ("runs-data-of-too-long", "answer", "takes its data bytes for frames", "too many data bytes"),
    ("random:84.88", "state", "is turning a wheel wrongly", "steering 248 or more to either side"),
    ("mixture:R-rotate-steering=reset-and-drives-straight:by-frame", "state",
     "steering stays as it was", "at one in 2 of the moving frames"),
]  # fmt: skip


def exchanges_of(protocol: Protocol, events: list[Any], *known: Known) -> Exchanges:
    return Exchanges(Model(protocol, Choices()), events, Timing(50 * MS, 86_806, 250 * MS), *known)


def sent(at: int, frame: str, code: int = 0) -> list[Done]:
    """A frame in hex sent at a time in ms, and its answer."""
    answer = Received(((at * MS + MS, code),), at * MS + MS)
    return [Done(Send(bytes.fromhex(frame)), at * MS), Done(None, answer)]


def report_of(protocol: Protocol, fault: Fault) -> Report:
    return conform(Simulator(protocol, fault), grammar=protocol, options=SMOKE)


@pytest.mark.sample(2)
@pytest.mark.slow
@pytest.mark.parametrize(("name", "axis", "what", "when"), NAMED, ids=[row[0] for row in NAMED])
def test_one_cause_names_what_goes_wrong_and_when(
    protocol: Protocol, name: str, axis: str, what: str, when: str
) -> None:
    report = report_of(protocol, find_fault(protocol, name))
    [cause] = report.causes
    assert cause.axis == axis
    assert what in cause.sentence
    assert cause.when.startswith(when) or when in cause.when
    failed = {result.id for result in report.results if result.verdict.label == "fail"}
    assert set(cause.cases) <= failed
    assert report.unexplained == len(failed - set(cause.cases)) <= 1
    assert cause.tried


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "only", "told"),
    [
        ("no-stop-on-too-many-while-rotate-right", ("combined/waited/*",),
         "does not stop and steering stays as it was after too many data bytes"),
        ("mixture:R-led-state=off:by-motion", ("combined/*", "valid/*"),
         "led stays as it was after a frame that stops it"),
    ],
)  # fmt: skip
def test_what_a_cause_brings_about_is_no_other_cause(
    protocol: Protocol, name: str, only: tuple[str, ...], told: str
) -> None:
    device = Simulator(protocol, find_fault(protocol, name))
    report = conform(device, options=Options(level="standard", only=only))
    [cause] = report.causes
    assert cause.sentence.startswith(told)
    assert cause.others == report.unexplained == 0


@pytest.mark.slow
def test_a_wrong_answer_behind_which_it_does_not_stop_keeps_it_moving(protocol: Protocol) -> None:
    bank = fault_bank(protocol)
    accepted, stopped = bank["accepts-id-9"], bank["speed-stops-it"]
    causes = report_of(protocol, both(accepted, stopped)).causes
    assert [cause.axis for cause in causes] == ["stop", "state"]
    assert "answers 00 OK instead of 01 BAD_HEADER and does not stop" in causes[0].sentence
    assert causes[0].send[-2:] == ("20", "90")
    assert report_of(protocol, bank["always-0"]).causes[0].axis == "answer"


def test_answers_that_others_overtake_are_late_and_no_other_cause(protocol: Protocol) -> None:
    [cause] = report_of(protocol, find_fault(protocol, "answers-too-late")).causes
    assert cause.sentence.startswith("answers late after a faulty frame (")


def test_each_frame_more_than_a_device_has_room_for_is_one_cause(protocol: Protocol) -> None:
    [cause] = report_of(protocol, find_fault(protocol, "queue-of-2-frames")).causes
    assert cause.when == "any frame, with 2 or more frames before it not answered yet"


def test_frames_behind_those_whose_data_are_taken_for_frames_have_that_cause(
    protocol: Protocol,
) -> None:
    report = report_of(protocol, find_fault(protocol, "runs-data-of-id-12"))
    [cause] = report.causes
    assert cause.when == "unknown ID, with ID 12"
    assert report.unexplained <= 1


def test_what_a_device_has_no_room_for_is_counted_in_bytes(protocol: Protocol) -> None:
    [cause] = report_of(protocol, find_fault(protocol, "buffer-of-16-bytes")).causes
    assert cause.when.startswith("any frame, with 18 or more bytes sent in one go")


def test_a_value_that_comes_one_frame_late_is_one_cause(protocol: Protocol) -> None:
    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        state, due = reaction.state, late.pop("led", None)
        if state.led != event.before.led:
            late["led"] = state.led
        return replace(reaction, state=state.but(led=event.before.led if due is None else due))

    late: dict[str, int] = {}
    [cause] = report_of(protocol, Fault("led-late", "", "", react=react)).causes
    assert cause.sentence.startswith("led stays as it was after LED, until the next frame (")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["answers-too-late", "double-answer-to-faults"])
def test_an_answer_with_the_right_code_hides_no_missing_stop(protocol: Protocol, name: str) -> None:
    fault = both(find_fault(protocol, name), find_fault(protocol, "no-stop-on-bad-data"))
    first, second = report_of(protocol, fault).causes
    assert (first.axis, first.when) == ("stop", "bad data")
    assert (second.axis, second.when) == ("answer", "a faulty frame")


def test_causes_follow_the_grammar(horn: Protocol) -> None:
    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        refused = horn.answers[Outcome.BAD_DATA].code
        loud = event.judgement.name == "Horn" and event.judgement.frame[1:] == b"\x03"
        return replace(reaction, answers=((0, refused),)) if loud else reaction

    fault = replace(fault_bank(horn)["always-0"], react=react)
    [cause] = report_of(horn, fault).causes
    assert cause.when == "Horn, with sound 3"
    assert cause.send == ("91 03",)


def ends_in_ff(event: Event, after: State) -> State:
    wrong = not event.judgement.valid and event.judgement.frame[1:].endswith(b"\xff")
    return event.before if wrong else after


def ignores_led(event: Event, after: State) -> State:
    valid = event.judgement.valid and event.judgement.name == "LED"
    return event.before if valid and event.before.motion != Motion.STOPPED else after


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("made", "told", "when"),
    [
        (ends_in_ff, "does not stop and steering stays as it was",
         "a faulty frame, with last data byte 255"),
        (ignores_led, "led stays as it was", "LED, while a motion is set"),
    ],
)  # fmt: skip
def test_causes_know_the_last_data_byte_and_a_motion_that_speed_0_hides(
    protocol: Protocol, made: Callable[[Event, State], State], told: str, when: str
) -> None:
    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        return replace(reaction, state=made(event, reaction.state))

    fault = replace(fault_bank(protocol)["always-0"], react=react)
    options = Options(level="standard", only=("combined/pipelined/00*", "sequence/tour/0*"))
    [cause] = conform(Simulator(protocol, fault), grammar=protocol, options=options).causes
    assert cause.sentence.startswith(told)
    assert cause.when.startswith(when)


@pytest.mark.slow
def test_a_few_deviations_beside_many_of_the_same_kind_have_a_cause_of_their_own(
    protocol: Protocol,
) -> None:
    many, few = (find_fault(protocol, n) for n in ("stop-keeps-one-wheel", "right-128-ignored"))
    options = Options(level="standard", only=("sequence/data/Right*", "bad-data/*"))
    report = conform(Simulator(protocol, both(many, few)), grammar=protocol, options=options)
    whens = [cause.when for cause in report.causes]
    assert (whens, report.unexplained) == (["a faulty frame", "Right, with strength 128"], 0)


def test_a_range_ends_where_what_is_certain_ends() -> None:
    """Other numbers are many, so that no evenly spaced threshold stands there."""
    number = Feature("number", lambda one: cast("Any", one).value, "{}")
    certain: list[Any] = [SimpleNamespace(value=-value) for value in range(4, 256)]
    others: list[Any] = [SimpleNamespace(value=value) for value in range(256)]
    bags = [(one,) for one in certain] + [(certain[0], other) for other in others]
    rule = Learner(Table([number], [*certain, *others]), 9, bags, others).one_rule(1.0)
    assert rule == (Literal(number, "to", -4),)


def test_a_setting_kept_in_a_signed_byte_is_named_as_that(protocol: Protocol) -> None:
    report = report_of(protocol, EIGHT_BITS)
    [cause] = report.causes
    assert cause.sentence.startswith("steering is that of a signed number of 8 bits")
    assert len(cause.cases) == report.counts["fail"] > 10
    assert cause.send == ("41 ff",)


def test_what_was_seen_before_a_frame_is_no_evidence_for_it(protocol: Protocol) -> None:
    look = look_class(protocol.state_type)

    def seen(at: int, *, moving: bool) -> Done:
        return Done(None, Observation(at * MS, at * MS, look(at * MS, moving)))

    events: list[Done | Mark] = [
        Mark("moves", over=False),
        *sent(10, "11 ff"),
        *sent(20, "20"),
        seen(300, moving=True),
        Mark("moves", over=True),
        Mark("stops", over=False),
        seen(1000, moving=True),
        *sent(1010, "00"),
        seen(1300, moving=False),
        Mark("stops", over=True),
    ]
    found = exchanges_of(protocol, events)
    assert found.bags == []
    assert [bool(one.settled) for one in found.all] == [False, True, True]


def seen_after(protocol: Protocol, burst: str, **told: Any) -> Exchanges:
    """The exchanges of a burst of four frames in hex, each answered 00, and one look after them."""
    events: list[Done | Mark] = [
        Done(Send(bytes.fromhex(burst)), 10 * MS),
        Done(None, Received(((12 * MS, 0),) * 4, 20 * MS)),
        Done(
            None, Observation(300 * MS, 300 * MS, look_class(protocol.state_type)(300 * MS, **told))
        ),
    ]
    return exchanges_of(protocol, events)


def test_a_look_shows_the_wheels_of_frames_that_turn_them_alike(protocol: Protocol) -> None:
    found = seen_after(protocol, "11 ff 20 41 ff 41 00", moving=True).all
    assert [MOTION in one.right for one in found] == [False, True, True, True]
    assert [WHEELS in one.right for one in found] == [False, True, False, True]
    astray = Relation(MOTION, "changed", "", seen=ASTRAY)
    assert [astray.shows(one, 0) for one in found] == [False, True, False, True]


def test_what_was_so_before_a_burst_is_no_evidence_for_its_last_frame(protocol: Protocol) -> None:
    last = seen_after(protocol, "11 ff 20 00 20", moving=True).all[-1]
    assert MOTION not in last.right
    assert last.settles(MOTION)


def test_a_frame_that_sets_nothing_new_hides_no_deviation_of_the_frame_before(
    protocol: Protocol,
) -> None:
    [bag] = seen_after(protocol, "51 ba 00 00 81 03", moving=False, steering=-186).bags
    assert [exchange.kind for exchange in bag.exchanges] == ["Stop", "Stop", "LED"]


def test_nor_does_one_that_was_sent_later_if_nobody_looked(protocol: Protocol) -> None:
    look = look_class(protocol.state_type)(60 * MS, moving=True)
    events = [*sent(10, "11 ff"), *sent(20, "70"), *sent(30, "00"), *sent(40, "00")]
    found = exchanges_of(protocol, [*events, Done(None, Observation(60 * MS, 60 * MS, look))])
    [bag] = found.bags
    assert [exchange.kind for exchange in bag.exchanges] == ["Stop", "Stop"]


def test_what_was_set_since_the_last_look_is_assumed(protocol: Protocol) -> None:
    look = look_class(protocol.state_type)
    first = [*sent(10, "81 03"), Done(None, Observation(20 * MS, 20 * MS, look(20 * MS, led=3)))]
    events = [*first, *sent(30, "81 04"), *sent(40, "81 05")]
    events.append(Done(None, Observation(60 * MS, 60 * MS, look(60 * MS, led=5))))
    found = exchanges_of(protocol, events).all
    assert [one.assumed for one in found] == [set(), set(), {"led"}]
    effect = Effect(Relation("led", "wrong", "is 7"), [], found)
    assert effect.where_seen().against == found[:2]


def test_a_rule_is_found_where_the_frame_that_it_is_about_came_behind_others(
    protocol: Protocol,
) -> None:
    alone = [sent(100 * n, frame) for n, frame in enumerate(["20", "30", "60", "70", "81 03"], 1)]
    right = exchanges_of(protocol, [event for one in alone for event in one]).all
    bursts = [seen_after(protocol, f"{frame} 81 03").all for frame in ("20", "30", "60", "70")]
    groups = [*bursts, exchanges_of(protocol, sent(10, "00")).all]
    table = Table(features(protocol), [*right, *(e for group in groups for e in group)])
    rules = Learner(table, TIERS[-2], groups, right).rules(2)
    assert all(any(matches(rule, e) for rule in rules for e in group) for group in groups)


@pytest.mark.parametrize(("pause", "certain"), [(30, True), (49, False)])
def test_a_frame_that_may_have_been_cut_is_no_evidence(
    protocol: Protocol, pause: int, *, certain: bool
) -> None:
    events = [
        Done(Send(b"\x11"), 0),
        Done(Send(b"\xff"), pause * MS),
        Done(None, Received(((pause * MS + MS, 0),), pause * MS + MS)),
    ]
    [exchange] = exchanges_of(protocol, events).all
    assert exchange.right == ({ANSWER} if certain else set())


@pytest.mark.parametrize(("late", "certain"), [(1, True), (3, False)])
def test_an_answer_may_still_come_where_answers_are_often_late(
    protocol: Protocol, late: int, *, certain: bool
) -> None:
    events: list[Done | Mark] = []
    now = 0

    def sent(delay: int | None) -> None:
        nonlocal now
        answers = () if delay is None else (((now + delay) * MS, 0),)
        heard = Done(None, Received(answers, (now + 300) * MS))
        events.extend([Mark("case", over=False), Done(Send(b"\x00"), now * MS), heard])
        now += 400

    for delay in (*[290] * late, None, 1):
        sent(delay)
    found = exchanges_of(protocol, events)
    assert [one.deviations[ANSWER].how for one in found.all[:late]] == ["late"] * late
    assert (ANSWER in found.all[-1].right) == certain


@pytest.mark.parametrize(("delay", "code", "cut"), [(30, 4, True), (30, 0, False), (20, 4, False)])
def test_the_answer_to_a_frame_cut_short_may_come_before_its_time_out_was_noted(
    protocol: Protocol, delay: int, code: int, *, cut: bool
) -> None:
    events = [
        Done(Send(b"\x11"), 0),
        Done(None, Received(((delay * MS, code),), 35 * MS)),
        Done(Send(b"\x20"), 36 * MS),
        Done(None, Received(((37 * MS, 0),), 40 * MS)),
    ]
    found = exchanges_of(protocol, events)
    assert [one.kind for one in found.all] == (["truncated", "Forward"] if cut else ["Speed"])
    assert all(one.right == {ANSWER} for one in found.all if cut)


class Recorded:
    """The trace of a run against a faulty device, and the causes found in it."""

    def __init__(self, protocol: Protocol, fault: Fault) -> None:
        trace = Trace()
        report = conform(Simulator(protocol, fault), options=SMOKE, listener=trace)
        timing = protocol.timing
        self.timing = Timing(
            int(timing.truncation_timeout * MS), 86_806, int(timing.answer_longest * MS)
        )
        self.exchanges = Exchanges(Model(protocol, Choices()), trace.events, self.timing)
        failed = {result.id for result in report.results if result.verdict.label == "fail"}
        self.causes: list[Cause] = find_causes(
            features(protocol), self.exchanges.all, self.exchanges.bags, failed
        )


def test_a_flood_does_not_fill_the_memory_of_a_trace() -> None:
    trace = Trace()
    trace.done(Listen(None, 1), Received(((0, 0),) * 8192, 5))
    assert trace.events == [Done(Listen(None, 1), Received(((0, 0),) * 1024, 5))]
    assert trace.now == 5


def test_a_deviation_that_nothing_predicts_is_just_wrong() -> None:
    bag = Bag(Deviation(MOTION, "wrong", "stopped", "forward"), ())
    [(relation, explained_by_it)] = relations([bag])
    assert relation.words == "is wrong"
    assert explained_by_it == [bag]


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", ["no-stop-once-it-has-rotated", "speed-ignored-after-left"])
def test_a_cause_takes_in_nothing_that_contradicts_it(protocol: Protocol, name: str) -> None:
    recorded = Recorded(protocol, fault_bank(protocol)[name])
    assert recorded.causes
    for cause in recorded.causes:
        against = [e for effect in cause.effects for e in effect.against]
        assert against
        assert not [e for e in against if matches(cause.rule, e)]


def test_what_keeps_it_moving_joins_only_what_the_same_frames_cause(protocol: Protocol) -> None:
    bank = fault_bank(protocol)
    one = both(bank["left-is-signed"], bank["no-stop-on-bad-data"])
    other = both(bank["ok-to-unknown-id"], bank["led-7-ignored"])
    causes = report_of(protocol, both(one, other)).causes

    found = ["bad data", "unknown ID", "LED, with rgb 7", "Left"]
    assert [cause.when for cause in causes] == found


def test_a_rare_deviation_that_the_rule_of_another_leaves_out_is_a_cause(
    protocol: Protocol,
) -> None:
    bank = fault_bank(protocol)
    rare, frequent = bank["forward-ignored-after-speed"], bank["led-sticks-after-255-frames"]
    report = report_of(protocol, both(frequent, rare))
    assert [cause.when.partition(",")[0] for cause in report.causes] == ["Forward", "LED"]


def test_the_rule_of_a_deviation_takes_in_the_rare_frames_that_show_it(protocol: Protocol) -> None:
    frames = enumerate(["00"] * 1600 + ["81 ff"] * 20)
    events = [event for number, frame in frames for event in sent(10 * number, frame, 1)]
    found = exchanges_of(protocol, events)
    [cause] = find_causes(features(protocol), found.all, found.bags, [""])
    assert not [bag for bag in found.bags if not matches(cause.rule, bag.exchanges[0])]


def test_what_keeps_it_moving_is_told_apart_from_another_motion(protocol: Protocol) -> None:
    bank = fault_bank(protocol)
    swapped = bank["rotateright-rotateleft-swapped"]
    causes = report_of(protocol, both(swapped, bank["no-stop-on-bad-data"])).causes
    assert [cause.axis for cause in causes] == ["stop", "state"]
    assert causes[0].when == "bad data"
    assert "instead of stopped" not in causes[1].sentence


def test_what_a_device_is_known_to_make_of_a_frame_holds_for_the_next(protocol: Protocol) -> None:
    frames = enumerate(["11 50", "30", "20", "81 ff"])
    events = [event for number, frame in frames for event in sent(10 * number, frame)]
    rebuilt = partial(exchanges_of, protocol, events)

    def ignored(exchange: Exchange) -> dict[str, int | str | None]:
        return {MOTION: "backward"} if exchange.kind == "Forward" else {}

    def unknown(exchange: Exchange) -> dict[str, int | str | None]:
        return {MOTION: None} if exchange.kind == "Forward" else {}

    before = [e.all[-1].before for e in (rebuilt(), rebuilt(ignored), rebuilt(unknown))]
    assert [one.state.motion for one in before[:2]] == ["forward", "backward"]
    assert ["motion" in one.unknown for one in before] == [False, False, True]


def test_what_is_so_only_for_a_while_is_not_known_of_the_next_frame(protocol: Protocol) -> None:
    [exchange] = exchanges_of(protocol, sent(10, "20")).all
    made = []
    for how in ("wrong", "changed", "late"):
        relation = Relation(MOTION, how, "is backward", lambda e: "backward")
        made.append(Cause((), [Effect(relation, [], [])]).made(exchange))
    assert made == [{MOTION: "backward"}, {MOTION: None}, {MOTION: None}]


@pytest.mark.parametrize(
    ("behind", "back"),
    [(["8103"], "forward"), (["1180", "8103"], "forward"), (["00", "8103"], "stopped"),
     (["30", "8103"], "backward")],
)  # fmt: skip
def test_what_comes_back_was_there_before_the_last_fault(
    protocol: Protocol, behind: list[str], back: str
) -> None:
    codes = {"81ff": 2}
    frames = enumerate(["11ff", "20", "81ff", *behind])
    events = [event for n, frame in frames for event in sent(10 * n, frame, codes.get(frame, 0))]
    relation = resuming(MOTION, "wrong", later=True)
    assert relation.predict is not None
    assert relation.predict(exchanges_of(protocol, events).all[-1]) == back


def test_a_fault_that_acts_at_headers_is_compared_there(protocol: Protocol) -> None:
    found = exchanges_of(protocol, sent(10, "2100", 3))
    cause = Cause((), [Effect(Relation(ANSWER, "other", ""), [], [])])
    assert _names(cause, found, {found.all[0].start: (protocol.power_on, True)}, None)


def test_that_it_answers_no_more_is_a_cause_beside_others(protocol: Protocol) -> None:
    bank = fault_bank(protocol)
    report = report_of(protocol, both(bank["right-bit-4-lost"], bank["sticks-after-50-faults"]))
    assert [cause.axis for cause in report.causes] == ["answer", "state"]
    assert report.unexplained == 0


def test_a_failure_behind_a_frame_that_was_not_observed_is_no_other_cause(
    protocol: Protocol,
) -> None:
    report = report_of(protocol, find_fault(protocol, "stop-takes-its-time"))
    [cause] = report.causes
    assert cause.when == "Stop"
    assert report.unexplained <= 1


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", ["stops-late", "restarts-by-itself"])
def test_a_fault_acts_where_something_changes_by_it(protocol: Protocol, name: str) -> None:
    found = explained(protocol, [name], "smoke", 1)
    assert (found.causes, found.named, found.of) == (1, 1, 1)


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "every-100th-fault-missed",
        "no-stop-after-100-faults",
        "sticks-after-50-faults",
    ],
)
def test_what_a_cause_counts_is_in_its_line(protocol: Protocol, name: str) -> None:
    found = explained(protocol, [name], "smoke", 1)
    assert (found.causes, found.named, found.shown) == (1, 1, True)


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("first-frame-answered-twice", ("--unhomed", "20")),
        ("second-frame-unanswered", ("--unhomed", "11 7f", "90")),
        ("mixture:R-drain-known=flushed:after-12", ("40",) * 14),
        ("mixture:R-drive-steering=straight:by-id", ("41 ff", "30")),
        ("led-latches", ("--unhomed", "81 07", "81 03")),
    ],
)
def test_its_line_shows_what_depends_on_more_than_a_rule_says(
    protocol: Protocol, name: str, line: tuple[str, ...]
) -> None:
    [cause] = report_of(protocol, find_fault(protocol, name)).causes
    assert cause.send == line
    assert "tried again: the same" in cause.sentence


@pytest.mark.slow
def test_what_is_wrong_at_every_nth_shows_whenever_its_line_begins(protocol: Protocol) -> None:
    fault = fault_bank(protocol)["every-7th-fault-missed"]
    recorded = Recorded(protocol, fault)
    [cause] = recorded.causes
    finder = Finder(Model(protocol, Choices()), recorded.timing)
    line = next(line for line in finder.lines(cause) if line.period)
    faulty = line.chunks[-1].data
    lengths = set()
    for earlier in range(7):
        device, trace = Simulator(protocol, fault), Trace()

        def attempt(trace: Trace = trace, earlier: int = earlier) -> Procedure[None]:
            for _ in range(earlier):
                yield from send(faulty)
                yield from listen(1, MS)
            yield from home_once(protocol)
            yield from followed(shown_by(line, recorded.timing, looks=True), trace)

        drive(attempt(), VirtualLink(device, recorded.timing.byte_time))
        shown = shown_in(cause, line, exchanges_of(protocol, trace.events))
        assert shown is not None
        lengths.add(shown.line.frames)
    assert min(lengths) < max(lengths) <= line.frames


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value", "together"),
    [
        ("split", "sent in one piece", False),
        ("sent ahead", "not sent ahead", False),
        ("gap", 16, True),
    ],
)
def test_only_frames_that_depend_on_their_times_are_sent_together(
    protocol: Protocol, name: str, value: str | int, *, together: bool
) -> None:
    recorded = Recorded(protocol, fault_bank(protocol)["no-stop-on-bad-data"])
    [cause] = recorded.causes
    by_name = {feature.name: feature for feature in features(protocol)}
    cause.rule += (Literal(by_name[name], "to" if together else "is", value),)
    model = Model(protocol, Choices())
    line = Finder(model, recorded.timing).lines(cause)[0]
    assert line.together == together


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", ["no-stop-on-bad-data", "speed-bit-0-lost", "double-answer"])
def test_its_line_shows_it_on_a_fresh_device_and_not_on_a_right_one(
    protocol: Protocol, name: str
) -> None:
    fault = fault_bank(protocol)[name]
    recorded = Recorded(protocol, fault)
    cause = recorded.causes[0]
    line = Finder(Model(protocol, Choices()), recorded.timing).lines(cause)[0]

    def shown_on(device: Simulator) -> bool:
        trace = Trace()

        def attempt() -> Procedure[None]:
            yield from home_once(protocol)
            yield from followed(shown_by(line, recorded.timing, looks=True), trace)

        drive(attempt(), VirtualLink(device, recorded.timing.byte_time))
        exchanges = Exchanges(Model(protocol, Choices()), trace.events, recorded.timing)
        return shown_in(cause, line, exchanges) is not None

    assert shown_on(Simulator(protocol, fault))
    assert not shown_on(Simulator(protocol))
    assert line.frames <= 3
