"""Homing: brings the line to a frame boundary and the robot to rest, around every test case.

As many stops as the longest frame has bytes do it from any state, however many data bytes the
device still waits for. Also: preambles, watching for a motion, and the motions a robot shows.

Most cases need a robot that is seen moving, not a fast one. The lowest of a few speeds at which
every kind of motion is seen is found once, and twice that speed is used for most faults, so that a
motor that has become warm, or a battery that has become weak, still turns the wheels. Where the
wheels do not turn at it later, the case is made again at the speed that it names itself, and all
after it keep theirs: no verdict rests on a motor's dead zone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from bilprov.analyzer.client.operations import (
    Ended,
    Observation,
    Procedure,
    Reconnected,
    listen,
    observe,
    send,
)
from bilprov.analyzer.client.rest import stops
from bilprov.captures.schemas import MS, Look
from bilprov.captures.text import quantity
from bilprov.conformance.cases.case import Case, case_of_the_run, in_motion
from bilprov.conformance.cases.steps import FrameClass, step_of
from bilprov.conformance.oracle.judge import look_words
from bilprov.conformance.oracle.sight import NOT_OBSERVABLE
from bilprov.conformance.oracle.state_model import ExpectedState
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.run import Homed, Late, Run, Trial
from bilprov.conformance.runner.waiting import GaveUp
from bilprov.spec.by_effect import frames_to, movers, setting
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

# A flood has this many times more answers than were due; after so many the run is given up.
_FLOOD, _FLOODS = 4, 3
_SLOW = 20 * MS  # for an answer
_TRIES = 3  # to see it move: an instruction may get lost on the line


def home(run: Run) -> Procedure[Homed]:
    """Home the line outside any case: what comes late is stray.

    Returns what that has shown. Raises GaveUp when the device no longer answers.
    """
    homed = yield from home_after(run, None)
    for late in homed.late:
        if late.answers:
            run.strays.unexpected(late.answers, late.reason)
        else:
            run.strays.silent(late.reason)
    if homed.stopped:
        raise homed.stopped
    return homed


def home_again(run: Run) -> Procedure[None]:
    """Home a device whose port was lost: it may have been switched off, and may still boot.

    What it sends until it has answered a stop, such as a banner, is no answer to anything. Raises
    GaveUp when it no longer answers.
    """
    run.waiting.answered()
    for _ in range(-(-run.timers.boot // run.timers.longest)):
        yield from send(stops(run.protocol)[:1])
        heard = yield from listen(1, run.timers.longest)
        if heard.answers:
            break
    for _ in range(_TRIES):
        heard = yield from listen(None, run.waiting.usual)
        if not heard.answers:
            break
    yield from home(run)


def home_after(run: Run, trial: Trial | None) -> Procedure[Homed]:
    """Home the line after an attempt; returns what came late, and what stopped it.

    It changes nothing about the trial.
    """
    late: list[Late] = []
    try:
        first = yield from _home(run, trial, late)
    except (Ended, GaveUp) as stopped:
        return Homed(tuple(late), stopped)
    return Homed(tuple(late), first=first)


def _home(run: Run, trial: Trial | None, late: list[Late]) -> Procedure[int | None]:
    """Home the line, and add what comes late; returns the first answer to stops sent together."""
    waiting, due = run.waiting, run.protocol.longest_frame
    patience = waiting.usual
    pause = max(run.profile.truncation_timeout or 0, run.profile.flushes_for or 0) + patience
    if waiting.answer_pending:
        # A missing answer may still come: it belongs to the case, not to the next.
        heard = yield from listen(None, waiting.patience)
        if heard.answers:
            late.append(Late(heard.answers, "the answer came later than the longest time allowed"))
        waiting.waited_for_pending(came=bool(heard.answers or (trial and trial.heard)))
        waiting.in_vain(waiting.patience)
    in_step = trial is not None and trial.in_step and not late
    # A device that answered as it should is at a boundary: a stop is as good as many. Another one
    # is for the line, which may have made a motion of the first; a slow device gets no other. After
    # a sequence there are many, and time for an answer that comes late.
    slow = run.profile.slowest > _SLOW
    single = trial is not None and isinstance(trial.case, Case)
    few = 1 if slow else 2 if single else due
    at_once = (few, due, due) if in_step and few < due else (due, due)
    settle = 0 if trial is not None and trial.settled else waiting.settle
    between_frames = in_step or trial is None
    lost = owed = 0
    first: int | None = None
    for count in () if run.profile.one_by_one else at_once:
        yield from send(stops(run.protocol)[:count])
        due_answers = yield from waiting.all_answers(count, patience)
        if len(due_answers.answers) < count:
            waiting.in_vain(patience)
        got = due_answers.answers + (yield from listen(None, settle)).answers
        first = next((code for _, code in got), None) if first is None else first
        # What is owed to the stops before is late, and neither lost nor unasked.
        belated = min(owed, max(0, len(got) - count))
        owed, lost = owed - belated, max(0, lost - belated)
        if len(got) > count + belated:
            yield from _too_many(run, got[: len(got) - count - belated], late)
        if len(got) >= count:
            run.strays.missing(lost)
            return first
        # It waited for data, or discards bytes until the line is idle: a pause ends both.
        more = yield from listen(None, pause)
        short = max(0, count - len(got) - len(more.answers))
        owed, lost = owed + short, lost + short * between_frames
        if not short:
            run.strays.missing(lost)
            return first
    # A device that loses instructions sent ahead still takes one at a time. It may take the first
    # of them for data that it still waits for, or discard them until the line is idle for longer.
    in_time = tries = 0
    while tries < 2 * due and (tries < 4 or in_time):
        yield from send(stops(run.protocol)[:1])
        longer = tries > 1 and not in_time
        heard = yield from waiting.answers(1, max(pause, run.timers.longest * longer))
        tries += 1
        in_time = in_time + 1 if heard.answers else 0
        if in_time == 2:
            run.strays.missing(lost)
            return first
    late.append(Late((), "the device stopped answering"))
    after = f"after {trial.case.id}" if trial else "before the first case"
    raise GaveUp(f"the device stopped answering {after}")


def _too_many(run: Run, extra: tuple[tuple[int, int], ...], late: list[Late]) -> Procedure[None]:
    """Add answers that no stop asked for to `late`. Raises GaveUp after several floods."""
    what = "1 more answer" if len(extra) == 1 else f"{len(extra)} more answers"
    flood = yield from listen(None, run.timers.silence)
    if len(flood.answers) > len(extra):
        reason = "the device sends without being asked"
        late.append(Late((extra + flood.answers)[:8], reason, "R-unsolicited"))
    else:
        late.append(Late(extra, f"{what} came later than the case"))
    if len(extra) + len(flood.answers) > _FLOOD * run.protocol.longest_frame:
        run.counters.floods += 1
        if run.counters.floods >= _FLOODS:
            raise GaveUp("the device sends without end and without being asked")


def leave(run: Run) -> Procedure[Ended | None]:
    """Home the robot at the run's end, confirmed by the probe where there is one.

    At a port that was lost during this and is there again it is homed as one that may have booted.
    Returns what ended the run during this, None if nothing did.
    """
    while isinstance(stopped := (yield from _leave(run)), Reconnected):
        try:
            yield from home_again(run)
        except Reconnected:
            continue
        except Ended as ended:
            return ended
        except GaveUp as silent:
            return Ended(str(silent), error=True, line_works=True)
    return stopped


def _leave(run: Run) -> Procedure[Ended | None]:
    seen: Observation | None = None
    case = case_of_the_run(run.protocol, "leave/stopped", stops(run.protocol))
    last = Trial(run, case)  # the stops are answered while the robot is watched too
    try:
        for _ in range(3):
            yield from send(stops(run.protocol))
            yield from listen(run.protocol.longest_frame, run.waiting.usual)
            if not run.config.observable:
                return None
            seen = yield from watch(run, moving=False, trial=last)
            if seen.look.moving is False:
                return None
            yield from listen(None, run.profile.truncation_timeout or run.timers.deadline)
    except Ended as ended:
        if not ended.line_works or isinstance(ended, Reconnected):
            return ended
        # Interrupted, or the probe lost: the last operation was not done.
        try:
            yield from send(stops(run.protocol))
            yield from listen(run.protocol.longest_frame, run.waiting.usual)
        except Ended as again:
            return again
        return ended
    assert seen is not None
    verdict, reason = Verdict.FAIL, "THE ROBOT STILL MOVES"
    if seen.look.moving is None:
        verdict, reason = Verdict.INCONCLUSIVE, f"{NOT_OBSERVABLE}: it may still move"
    run.conclude(
        case, {"stop": Axis(verdict, "stopped", look_words(seen.look), reason)}, certain=True
    )
    return None


class SetUp(NamedTuple):
    """What a preamble led to: what is missing, "" if nothing, and the state the robot must have.

    `frames` are those that were sent; `look` is the last look before the stimulus, if there is one.
    """

    missing: str
    expected: ExpectedState
    frames: tuple[bytes, ...]
    look: Look | None = None


def set_up(run: Run, state: State) -> Procedure[SetUp]:
    """Bring a homed robot to a state (the preamble), one instruction at a time.

    Something is missing where the answers are not as many as the instructions.
    """
    expected = run.model.homed(run.model.found())
    frames = tuple(frame for frame in frames_to(run.protocol, state) if run.wire(frame))
    sent_frames = tuple(map(run.wire, frames))
    answered = 0
    for frame in frames:
        sent = yield from send(run.wire(frame))
        expected = run.model.after(expected, step_of(run.protocol, frame).frame_effect)
        heard = yield from run.waiting.answers(1)
        answered += len(heard.answers)
        run.answered(run.wire(frame), heard, sent)
    expected = replace(expected, rests_on=frozenset())
    if answered == len(frames):
        return SetUp("", expected, sent_frames)
    run.strays.missing(max(0, len(frames) - answered))  # more answers than frames are a flood
    answers, asked = quantity(answered, "answer"), quantity(len(frames), "instruction")
    return SetUp(f"{answers} to {asked} of the set-up", expected, sent_frames)


def watch(
    run: Run, *, moving: bool, patience: int | None = None, trial: Trial | None = None
) -> Procedure[Observation]:
    """Observe until the robot is seen moving (or standing), for at most `patience` ns.

    Without `patience` it is observed until an answer would be due.

    Link and probe are two lines: an observation right after an answer may be older than it.
    Answers that come meanwhile belong to the trial; without one they are stray.
    """
    patience = run.timers.deadline if patience is None else patience
    seen = yield from observe()
    start = seen.asked
    while seen.look.moving is not moving and seen.now - start < patience:
        heard = yield from listen(None, 2 * MS)
        if trial:
            trial.hear(heard)
        elif heard.answers:
            run.strays.unexpected(heard.answers, "came although nothing was sent")
        seen = yield from observe()
    if seen.look.moving is (not moving):
        run.waiting.in_vain(patience)
    return seen


def see_motions(run: Run) -> Procedure[None]:
    """Find out in which kinds of motion the robot is seen moving; no stop can be judged without."""
    if not run.config.observable:
        return
    moves: set[str] = set()
    told: list[frozenset[str]] = []
    for spec in movers(run.protocol):
        motion = run.protocol.car.motion(spec.effect)
        assert motion is not None
        for _ in range(_TRIES):
            yield from set_up(run, in_motion(run.protocol, motion))
            seen = yield from watch(run, moving=True)
            yield from home(run)
            if seen.look.moving is not False:
                break
        variables = run.protocol.variables
        told.append(frozenset(n for n in variables if getattr(seen.look, n) is not None))
        if seen.look.moving:
            moves.add(motion)
    run.profile.moves = moves
    run.profile.facets = frozenset.intersection(*told) if told else frozenset()


_PARTS = (16, 8, 4)  # of the greatest speed; twice the last is the slowest that a case names
_MARGIN = 2


def speeds(protocol: Protocol) -> Iterator[int]:
    """The speeds that are tried, from the lowest on; none where no instruction sets a speed."""
    _, fast = protocol.speeds
    for part in _PARTS:
        speed, name = fast // part, protocol.car.speed
        if speed and all(setting(protocol, name, n) for n in (speed, _MARGIN * speed)):
            yield speed


def find_speed(run: Run) -> Procedure[None]:
    """Find the preamble speed, for a homed robot whose motions are known; leaves the line homed."""
    if not run.config.observable:
        return
    motions = sorted(run.profile.moves or ())
    for speed in speeds(run.protocol) if motions else ():
        for motion in motions:
            if not (yield from _moves_at(run, in_motion(run.protocol, motion, speed))):
                break
        else:
            run.profile.preamble_speed = _MARGIN * speed
            return


def _moves_at(run: Run, state: State) -> Procedure[bool | None]:
    """Whether a homed robot moves in a state; None where it was not seen, or perhaps not told."""
    ready = yield from set_up(run, state)
    seen = yield from watch(run, moving=True)
    yield from home(run)
    return None if ready.missing and not seen.look.moving else seen.look.moving


def was_too_slow(run: Run, case: Case) -> Procedure[bool]:
    """Whether the robot moves at the speed of a failed case and not at that of its preamble.

    The preamble speed is then given up: the case has to be made again. Leaves the line homed.
    """
    slower = preamble_of(run, case)
    if slower == case.setup or (yield from _moves_at(run, slower)) is not False:
        return False
    if not (yield from _moves_at(run, case.setup)):
        return False
    run.profile.preamble_speed = None
    return True


def set_up_slowly(run: Run, state: State) -> Procedure[SetUp]:
    """Bring a homed robot to a state, at the preamble speed where it is seen moving at that."""
    slow, car = run.profile.preamble_speed, run.protocol.car
    if slow is not None and slow < car.drive(state).speed:
        ready = yield from set_up(run, state.but(**{car.speed: slow}))
        seen = yield from watch(run, moving=True)
        if seen.look.moving is not False:
            return ready
        run.profile.preamble_speed = None
        yield from home(run)
    return (yield from set_up(run, state))


def preamble_of(run: Run, case: Case) -> State:
    """The state in which a case begins with this robot: as it names it, or slower.

    Slower are the cases in which a fault must stop the robot. The first of each class of fault in
    each kind of motion keeps its speed, since a fast robot is harder to stop; so does a case of a
    valid frame, after which the wheels must be seen to turn at their speeds.
    """
    slow = run.profile.preamble_speed
    slows = case.faulty and case.stop and not case.thorough and case.kind is not FrameClass.VALID
    car = run.protocol.car
    motion, speed, _ = car.drive(case.setup)
    if slow is None or not slows or motion not in (run.profile.moves or ()):
        return case.setup
    return case.setup.but(**{car.speed: min(slow, speed)})
