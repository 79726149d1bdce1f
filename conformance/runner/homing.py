"""Homing: brings the line to a frame boundary and the robot to rest, around every test case.

As many stops as the longest frame has bytes do it from any state, however many data bytes the
device still waits for. Also: preambles, watching for a motion, and the motions a robot shows.
"""

from __future__ import annotations

from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.cases.case import runner_case
from bilprov.conformance.cases.preamble import frame_effect_of, frames_to
from bilprov.conformance.dut.operations import Ended, Observation, Procedure, listen, observe, send
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.oracle.wording import look_words
from bilprov.conformance.runner.run import GaveUp, RunState
from bilprov.spec.motion import Motion, State

# A flood has this many times more answers than were due; after so many the run is given up.
_FLOOD, _FLOODS = 4, 3
_SLOW = 20 * MS  # for an answer
_TRIES = 3  # to see it move: an instruction may get lost on the line


def pad(run: RunState) -> bytes:
    """The bytes that home a line: pad bytes, harmless as header and as data, for a whole frame."""
    return bytes([run.protocol.pad_byte]) * run.protocol.longest_frame


def home(run: RunState) -> Procedure[None]:
    """Home the line and make the open case final; superfluous answers count against that case.

    Raises GaveUp when the device no longer answers.
    """
    due = run.protocol.longest_frame
    patience = run.usual
    pause = (run.profile.truncation_timeout or 0) + patience
    if run.answer_pending:
        # A missing answer may still come: it belongs to the open case, not to the next.
        run.late_answer((yield from listen(None, run.patience)))
        run.add_waiting(run.patience)
    # A slow device that answered as it should is at a boundary: one stop is as good as many.
    slow = run.profile.slowest > _SLOW and run.in_step
    between_frames = run.in_step or not run.open_id
    lost = 0
    at_once = (1, due, due) if slow else (due, due)
    for count in () if run.profile.one_by_one else at_once:
        yield from send(pad(run)[:count])
        got = yield from _as_they_come(run, count, patience)
        if len(got) > count:
            yield from _too_many(run, got[: len(got) - count])
        if len(got) >= count:
            run.stray_answers.missing(lost)
            run.close()
            return
        lost += (count - len(got)) * between_frames
        # It waited for data, or discards bytes until the line is idle: a pause ends both.
        more = yield from listen(None, pause)
        if len(got) + len(more.answers) >= count:
            run.stray_answers.missing(lost)
            run.close()
            return
    # A device that loses instructions sent ahead still takes one at a time. It may take the first
    # of them for data that it still waits for.
    in_time = tries = 0
    while tries < 2 * due and (tries < 4 or in_time):
        yield from send(pad(run)[:1])
        heard = yield from run.answers(1, pause)
        tries += 1
        in_time = in_time + 1 if heard.answers else 0
        if in_time == 2:
            run.stray_answers.missing(lost)
            run.close()
            return
    after = f"after {run.open_id}" if run.open_id else "before the first case"
    run.attribute_to_case((), "the device stopped answering")
    raise GaveUp(f"the device stopped answering {after}")


def _as_they_come(run: RunState, due: int, patience: int) -> Procedure[tuple[tuple[int, int], ...]]:
    """Listen for `due` answers, each for `patience` ns, and for what follows them at once."""
    got = yield from run.all_answers(due, patience)
    if len(got.answers) < due:
        run.add_waiting(patience)
    more = yield from listen(None, run.timers.settle)
    return got.answers + more.answers


def _too_many(run: RunState, extra: tuple[tuple[int, int], ...]) -> Procedure[None]:
    what = "1 more answer" if len(extra) == 1 else f"{len(extra)} more answers"
    flood = yield from listen(None, run.timers.silence)
    if len(flood.answers) > len(extra):
        reason = "the device sends without being asked"
        run.attribute_to_case((extra + flood.answers)[:8], reason, "R-unsolicited")
    else:
        run.attribute_to_case(extra, f"{what} came later than the case")
    if len(extra) + len(flood.answers) > _FLOOD * run.protocol.longest_frame:
        run.floods += 1
        if run.floods >= _FLOODS:
            raise GaveUp("the device sends without end and without being asked")


def leave(run: RunState) -> Procedure[Ended | None]:
    """Home the robot at the run's end, confirmed by the probe where there is one.

    Returns what ended the run during this, None if nothing did.
    """
    seen: Observation | None = None
    try:
        for _ in range(3):
            yield from send(pad(run))
            yield from listen(run.protocol.longest_frame, run.usual)
            if not run.observable:
                return None
            seen = yield from watch(run, moving=False, patience=run.timers.deadline)
            if not seen.look.moving:
                return None
            yield from listen(None, run.profile.truncation_timeout or run.timers.deadline)
    except Ended as ended:
        if not ended.line_works:
            return ended
        # Interrupted, or the probe lost: the last operation was not done.
        try:
            yield from send(pad(run))
            yield from listen(run.protocol.longest_frame, run.usual)
        except Ended as again:
            return again
        return ended
    assert seen is not None
    clause, requirement = run.protocol.clauses.safety, "the run leaves the robot at rest"
    case = runner_case(run.protocol, "leave/stopped", clause, requirement, pad(run))
    fault = Axis(Verdict.FAIL, "stopped", look_words(seen.look), "THE ROBOT STILL MOVES")
    run.end(case, {"stop": fault})
    return None


def set_up(run: RunState, state: State) -> Procedure[str]:
    """Bring a homed robot to a state (the preamble), one instruction at a time.

    Returns "", or what is wrong where the answers are not as many as the instructions.
    """
    run.expected_state = run.model.homed(run.model.found())
    frames = [frame for frame in frames_to(run.protocol, state) if run.wire(frame)]
    answered = 0
    for frame in frames:
        sent = yield from send(run.wire(frame))
        run.expected_state = run.model.after(
            run.expected_state, frame_effect_of(run.protocol, frame)
        )
        heard = yield from run.answers(1)
        answered += len(heard.answers)
        run.profile.measured(heard, sent)
    run.expected_state = replace(run.expected_state, rests_on=frozenset())
    if answered == len(frames):
        return ""
    run.stray_answers.missing(len(frames) - answered)
    return f"{answered} answers to {len(frames)} instructions of the set-up"


def watch(run: RunState, *, moving: bool, patience: int) -> Procedure[Observation]:
    """Observe until the robot moves (or stands still), for at most `patience` ns.

    Link and probe are two lines: an observation right after an answer may be older than it.
    """
    seen = yield from observe()
    start = seen.asked
    while seen.look.moving is (not moving) and seen.now - start < patience:
        yield from _pause(run, 2 * MS)
        seen = yield from observe()
    if seen.look.moving is (not moving):
        run.add_waiting(patience)
    return seen


def _pause(run: RunState, pause: int) -> Procedure[None]:
    """Wait `pause` ns; answers received meanwhile go to the open case, else they are stray."""
    heard = yield from listen(None, pause)
    if heard.answers and run.open_id:
        run.hear(heard)
    elif heard.answers:
        run.attribute_to_case(heard.answers, "came although nothing was sent")


def see_motions(run: RunState) -> Procedure[None]:
    """Find out in which kinds of motion the robot is seen moving; no stop can be judged without."""
    if not run.observable:
        return
    moves: set[Motion] = set()
    _, fast = run.protocol.limits.get("speed", (0, 0))
    for spec in run.protocol.instructions:
        motion = spec.effect.motion
        if motion is None or motion is Motion.STOPPED or spec.fields:
            continue
        for _ in range(_TRIES):
            yield from set_up(run, State(motion=motion, speed=fast))
            seen = yield from watch(run, moving=True, patience=run.timers.deadline)
            yield from home(run)
            if seen.look.moving is not False:
                break
        if seen.look.moving:
            moves.add(motion)
    run.moves = moves
