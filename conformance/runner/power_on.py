"""The first cases of a run, from power-on: a look before any byte, then the link check.

They tell a device, conforming or not, from a line that cannot be used at all: no answer, an echo.
The first frame is a setting and no Stop, which would hide a robot that moves at power-on.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from bilprov.analyzer.client.operations import (
    Procedure,
    Received,
    listen,
    observe,
    power_cycle,
    send,
)
from bilprov.analyzer.client.rest import stops
from bilprov.captures.text import quantity
from bilprov.conformance.cases.case import Case, case_of_the_run
from bilprov.conformance.cases.single_frames import at_rest, link_check, motion_first
from bilprov.conformance.oracle import judge
from bilprov.conformance.oracle.sight import NOT_OBSERVABLE
from bilprov.conformance.oracle.state_model import ExpectedState
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.runner.retry import FEW, Attempt, confirm
from bilprov.conformance.runner.run import Run, result_of
from bilprov.spec.codec import spaced
from bilprov.spec.readings import FLUSH_POINTS
from bilprov.spec.state import State

_STOPPED = "stopped"
_CALIBRATION = 20
_TRIES = 3  # bursts of stops sent ahead
_CHATTER = 2  # most answers to the first instruction: more are a banner
_FIRST_ANSWERS = 40  # of a real device: where none of them is a code, something else answers
_SHOWN = 8  # of these, in the sentence that says so


def first_bytes(run: Run) -> Procedure[str]:
    """Execute and report the first cases. Returns why the line cannot be used, "" if it can."""
    still = at_rest(run.protocol)
    run.begin(still.id)
    axes = {"state": (yield from _still(run, still.expected, "R-power-on"))}
    banner = yield from listen(None, 0)
    begun = banner.now
    if banner.answers:
        axes["answer"] = _banner(run, banner)
    outcomes, alive = [(still, axes, banner, banner.now)], False
    taken = run.profile.choices.allowed.get("led-id")
    for case in link_check(run.protocol, int(taken) if taken else None):
        run.begin(case.id)
        flushed = run.profile.flushes
        first = len(outcomes) == 1
        boot = run.timers.boot if first else 0
        heard, sent = yield from _exchange(run, case, boot)
        if first and not run.config.virtual and not set(heard.codes) <= set(run.protocol.codes):
            # The rest of a banner may come late.
            heard += yield from listen(None, run.timers.deadline)
        if first and _chatter(case, heard):
            # A board that was reset by opening its port sends a banner: send the instruction again.
            outcomes[0][1]["answer"] = _banner(run, heard)
            yield from listen(None, run.waiting.patience)  # the instruction's own answer, if slow
            heard, sent = yield from _exchange(run, case, boot)
        run.profile.measured(heard, sent)
        if first and heard.answers:
            run.profile.boot = heard.answers[0][0] - begun
        answer = _judged(run, case, heard, sent)
        # As long as no answer has come on this line, the next instruction tells more than a retry.
        alive = alive or bool(heard.answers)
        if alive:
            again = partial(_answered, run, case, fresh=first)
            confirmed = yield from _confirmed(run, case, _one(case, "answer", answer), again)
            answer = confirmed.axes["answer"]
        axes = {"answer": judge.lost(answer) if run.profile.flushes and not flushed else answer}
        if first:
            state = _one(case, "state", (yield from _still(run, case.expected, "")))
            axes |= (yield from _confirmed(run, case, state, partial(_stands, run, case))).axes
        outcomes.append((case, axes, heard, sent))
    exchanges = [(case.frame, heard) for case, _, heard, _ in outcomes[1:]]
    unusable = _line_fault(run, exchanges) or (yield from _other_device(run, exchanges))
    if not unusable:
        failed = any(a.verdict is Verdict.FAIL for _, axes, _, _ in outcomes for a in axes.values())
        if failed and not run.config.virtual:
            yield from _time_answers(run)  # the line may be why
        for case, axes, heard, sent in outcomes:
            run.conclude(case, axes, heard.answers, sent, certain=case is still)
        yield from _second_power_on(run)
    return unusable


def calibrate(run: Run) -> Procedure[None]:
    """Measure how long an answer takes on this line and how much that varies, by single stops."""
    times = yield from _time_answers(run)
    if times:
        times.sort()
        run.profile.round_trip = times[len(times) // 2]
        run.profile.jitter = times[-1] - times[0]
        yield from _ahead(run)


def _time_answers(run: Run) -> Procedure[list[int]]:
    """How long (ns) the answers to single stops take."""
    stop, times = bytes([run.protocol.pad_byte]), list[int]()
    for _ in range(_CALIBRATION):
        stray = yield from listen(None, 0)
        if stray.answers:
            run.strays.unexpected(stray.answers, "came although nothing was asked")
        sent = yield from send(stop)
        heard = yield from run.waiting.answers(1)
        run.answered(stop, heard, sent)
        run.strays.missing(not heard.answers)
        times += [t - sent for t, _ in heard.answers[:1]]
    return times


def _ahead(run: Run) -> Procedure[None]:
    """Check whether stops that are sent ahead of their answers are each answered.

    A device that loses them is homed one stop at a time from then on.
    """
    if "pipelining" in run.profile.choices.allowed:
        run.profile.one_by_one = True
        return
    due, short, paces = run.protocol.longest_frame, list[int](), list[int]()
    for _ in range(_TRIES):
        sent = yield from send(stops(run.protocol))
        heard = yield from run.waiting.all_answers(due)
        paces += [max(0, t - sent) // len(heard.answers) for t, _ in heard.answers[-1:]]
        if len(heard.answers) < due:
            short.append(len(heard.answers))
    run.profile.pace = min(paces, default=0)
    if len(short) < _TRIES:
        run.strays.missing(sum(due - count for count in short))
        return
    run.profile.one_by_one = True
    case = case_of_the_run(run.protocol, "line/pipelining", stops(run.protocol))
    words = f"{quantity(max(short), 'answer')} to {due} stops sent at once"
    reason = f"loses answers: {words}, in each of {_TRIES} tries"
    run.conclude(
        case, {"answer": Axis(Verdict.FAIL, f"{due} answers", words, reason, "R-pipelining")}
    )


def _confirmed(
    run: Run, case: Case, first: Attempt, again: Callable[[], Procedure[Attempt]]
) -> Procedure[CaseResult]:
    """The result of a first exchange, made `again` where it failed: flaky if it may be noise."""

    def attempt() -> Procedure[Attempt]:
        tried = yield from again()
        return first if tried.failed else tried  # it may fail in another way each time

    if not first.failed:
        return first.result
    return (yield from confirm(run, case, first, attempt, FEW)).judged(run, first.result)


def _answered(run: Run, case: Case, *, fresh: bool) -> Procedure[Attempt]:
    """Make an exchange again, for its answer.

    `fresh` if it was the first instruction after power-on: where the power can be switched, each
    try is one too.
    """
    if fresh and run.config.power:
        yield from power_cycle()
    heard, sent = yield from _exchange(run, case, 0)
    return _one(case, "answer", _judged(run, case, heard, sent))


def _stands(run: Run, case: Case) -> Procedure[Attempt]:
    """Make an exchange again, for what the robot does then."""
    yield from _exchange(run, case, 0)
    return _one(case, "state", (yield from _still(run, case.expected, "")))


def _one(case: Case, name: str, axis: Axis) -> Attempt:
    """The attempt at a single axis of a case."""
    return Attempt(result_of(case, {name: axis}))


def _judged(run: Run, case: Case, heard: Received, sent: int) -> Axis:
    """The answer axis of an exchange."""
    return judge.judge_answers(
        run.protocol, case.accepted, heard, sent, timed=True, timers=run.timers
    )


def first_frames_lost(run: Run) -> Procedure[None]:
    """Judge the loss of one of the first instructions by a device that later loses none.

    It may be noise, or a fault that shows only after power-on: another power-on decides, where the
    power can be switched.
    """
    choices = run.profile.choices
    if not run.profile.flushes or any(choices.differs(point) for point in FLUSH_POINTS):
        return
    run.profile.flushes = False
    case = case_of_the_run(run.protocol, "power-on/lost")
    verdict, reason = Verdict.INCONCLUSIVE, "one of the first instructions was lost, later none was"
    if run.config.power:
        yield from power_cycle()
        for number, link in enumerate(link_check(run.protocol)):
            yield from _exchange(run, link, 0 if number else run.timers.boot)
        if run.profile.flushes:
            verdict, reason = Verdict.FAIL, "loses one of the first instructions after power-on"
        run.profile.flushes = False
    else:
        reason += "; --power would distinguish noise from a fault"
    run.conclude(case, {"answer": Axis(verdict, "an answer to each", "one was missing", reason)})


def _banner(run: Run, heard: Received) -> Axis:
    words = judge.answer_words(run.protocol, heard.codes)
    reason = "bytes came before the first instruction was answered"
    return Axis(Verdict.INFORMATIONAL, "no answer", words, reason, "R-unsolicited")


def _second_power_on(run: Run) -> Procedure[None]:
    """Test the first frame after power-on again, now a motion; skipped without a power switch."""
    case = motion_first(run.protocol)
    if case is None:
        return
    if not run.config.power:
        reason = "the robot cannot be switched off and on; see --power"
        run.conclude(case, {"answer": Axis(Verdict.SKIPPED, "", "not run", reason)})
        return
    run.begin(case.id)
    again = partial(_from_power_on, run, case)
    run.publish((yield from _confirmed(run, case, (yield from again()), again)))


def _from_power_on(run: Run, case: Case) -> Procedure[Attempt]:
    """Power-cycle and make the case's exchange."""
    yield from power_cycle()
    if (run.profile.boot or 0) > run.timers.longest:
        # It needed several tries. If it was still booting, twice that time is enough.
        yield from listen(None, 2 * (run.profile.boot or 0))
        sent = yield from send(case.frame)
        heard = yield from run.waiting.all_answers(2)
    else:
        heard, sent = yield from _exchange(run, case, run.timers.boot)
    if _chatter(case, heard):
        yield from listen(None, run.waiting.usual)
        heard, sent = yield from _exchange(run, case, run.timers.boot)
    answer = _judged(run, case, heard, sent)
    state = yield from _still(run, case.expected, case.reading, may_move=True)
    return Attempt(result_of(case, {"answer": answer, "state": state}, heard.answers, sent))


def _chatter(case: Case, heard: Received) -> bool:
    """Whether a booting board sent a banner instead of an answer.

    Its banner may have begun before the first byte reached it; what follows a right answer is none.
    """
    answered = heard.codes[:1] in [accepted.codes for accepted in case.accepted]
    return len(heard.answers) > _CHATTER and not answered


def _exchange(run: Run, case: Case, boot: int) -> Procedure[tuple[Received, int]]:
    """Send the stimulus and receive all answers; for `boot` ns a silent board gets it again."""
    sent = yield from send(case.frame)
    heard = yield from run.waiting.answers(1)
    waited = run.timers.longest
    if not heard.answers and not boot:
        heard = yield from listen(None, max(run.waiting.idle, run.waiting.patience))
        if not heard.answers:
            # It may discard what follows a fault until the line was idle (R-drain-known).
            sent = yield from send(case.frame)
            heard = yield from run.waiting.answers(1)
            run.profile.flushes = run.profile.flushes or bool(heard.answers)
    while not heard.answers and waited < boot:
        sent = yield from send(case.frame)
        heard = yield from run.waiting.answers(1)
        waited += run.timers.longest
    heard += yield from listen(None, run.timers.silence)
    return heard, sent


def _line_fault(run: Run, exchanges: list[tuple[bytes, Received]]) -> str:
    if not any(heard.answers for _, heard in exchanges):
        return (
            f"nobody answered in {run.timers.boot / 1e9:.0f} s: check power, wiring (TX to RX, "
            "common ground), the port and --baud"
        )
    if all(heard.codes[: len(frame)] == tuple(frame) for frame, heard in exchanges):
        return (
            "the line is an echo, every byte came back unchanged: a loop-back plug, TX and RX "
            "wired together, or an adapter that hears itself (--echo)"
        )
    return ""


def _other_device(run: Run, exchanges: list[tuple[bytes, Received]]) -> Procedure[str]:
    """Why what answers is no device of this protocol, "" if it may be one.

    It is none where not one of its first answers is a code of the grammar: then harmless stops are
    sent until there are enough answers to tell.
    """
    if run.config.virtual:
        return ""
    codes = tuple(code for _, heard in exchanges for code in heard.codes)
    while not any(code in run.protocol.codes for code in codes[:_FIRST_ANSWERS]):
        if len(codes) >= _FIRST_ANSWERS:
            break
        yield from send(stops(run.protocol))
        heard = yield from run.waiting.all_answers(run.protocol.longest_frame)
        if not heard.answers:
            break
        codes += heard.codes
    else:
        return ""
    first = bytes(codes[:_FIRST_ANSWERS])
    begin = f"{spaced(first[:_SHOWN])} {first[:_SHOWN].decode('latin-1')!a}"
    none = (
        f"none of the first {len(first)} answers is a" if len(first) > 1 else "its answer is not a"
    )
    return (
        f"{none} code of the grammar ({begin}): text, another baud rate or another device; check "
        "the port and --baud, or listen with bilprov ports PORT"
    )


def _still(run: Run, expected: State, reading: str, *, may_move: bool = False) -> Procedure[Axis]:
    """Check that the robot stands still; the other observed facets are compared with `expected`.

    `may_move` if a motion was set: then the robot moves only if it has a speed from power-on.
    """
    if not run.config.observable:
        return run.config.not_observable(_STOPPED)
    seen = yield from observe()
    start = seen.asked
    # After the first byte only what it set is compared: the rest is as the robot was found.
    car = run.protocol.car
    as_found = () if reading else (*run.protocol.lights, car.steering)
    expected_state = ExpectedState(expected)
    axis = judge.judge_state(run.model, expected_state, seen.look, as_found)
    while axis.verdict is Verdict.FAIL and seen.now - start < run.timers.deadline and not reading:
        # The probe is another line: it may be behind the answer.
        yield from listen(None, run.timers.silence)
        seen = yield from observe()
        axis = judge.judge_state(run.model, expected_state, seen.look, as_found)
    words = judge.look_words(seen.look)
    if seen.look.moving is None:
        return Axis(Verdict.INCONCLUSIVE, _STOPPED, words, NOT_OBSERVABLE, reading)
    if seen.look.moving and may_move:
        reason = "has a speed from power-on"
        return Axis(Verdict.INFORMATIONAL, _STOPPED, words, reason, reading)
    if seen.look.moving:
        reason = "moves although no instruction has set a motion"
        return Axis(Verdict.FAIL, _STOPPED, words, reason, reading)
    if axis.verdict is Verdict.FAIL and reading:
        # The document does not say what speed or light a robot starts with.
        return Axis(Verdict.INFORMATIONAL, axis.expected, axis.actual, axis.reason, reading)
    return axis
