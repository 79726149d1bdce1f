"""Brings the line to a frame boundary and the robot to rest: before, between and after the cases.

As many stops as the longest frame has bytes do it from any state, whatever the device is owed.
"""

from __future__ import annotations

from dataclasses import replace

from conformance.cases.preamble import deed_of, frames_to
from conformance.cases.single_frames import special
from conformance.dut.operations import Script, Seen, listen, see, send
from conformance.oracle.judge import MS, look_words
from conformance.oracle.verdicts import Axis, Verdict
from conformance.runner.run import Ended, GaveUp, Run
from spec.motion import Motion, State

# So many times more answers than were due, so often, and the rest of a run would show no more.
_FLOOD, _FLOODS = 4, 3
_SLOW = 20 * MS  # for an answer
_TRIES = 3  # to see it move: an instruction may get lost on the line


def pad(run: Run) -> bytes:
    """What homes a line: the only byte that is harmless as header and as data, often enough."""
    return bytes([run.protocol.filler]) * run.protocol.longest_frame


def home(run: Run) -> Script[None]:
    """Home, and make the case before final; an answer too many is charged to it.

    Raises GaveUp when the device no longer answers.
    """
    due = run.protocol.longest_frame
    patience = run.usual
    pause = (run.profile.truncation_timeout or 0) + patience
    if run.missing:
        # What did not come in time may still come: it belongs to the case before, not the next.
        run.late((yield from listen(None, run.patience)))
        run.waste(run.patience)
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
            run.between.lost(lost)
            run.close()
            return
        lost += (count - len(got)) * between_frames
        # Owed data or flushed until idle: both are over after a pause.
        more = yield from listen(None, pause)
        if len(got) + len(more.answers) >= count:
            run.between.lost(lost)
            run.close()
            return
    # A device that loses what it is sent ahead still takes one instruction at a time. The first
    # of them may be swallowed as data that the device is still owed.
    in_time = tries = 0
    while tries < 2 * due and (tries < 4 or in_time):
        yield from send(pad(run)[:1])
        heard = yield from run.answers(1, pause)
        tries += 1
        in_time = in_time + 1 if heard.answers else 0
        if in_time == 2:
            run.between.lost(lost)
            run.close()
            return
    after = f"after {run.open_id}" if run.open_id else "before the first case"
    run.charge((), "the device stopped answering")
    raise GaveUp(f"the device stopped answering {after}")


def _as_they_come(run: Run, due: int, patience: int) -> Script[tuple[tuple[int, int], ...]]:
    """Up to `due` answers and what follows at once; a slow device may take its time for each."""
    got = yield from run.all_answers(due, patience)
    if len(got.answers) < due:
        run.waste(patience)
    more = yield from listen(None, run.limits.settle)
    return got.answers + more.answers


def _too_many(run: Run, extra: tuple[tuple[int, int], ...]) -> Script[None]:
    what = "1 more answer" if len(extra) == 1 else f"{len(extra)} more answers"
    flood = yield from listen(None, run.limits.silence)
    if len(flood.answers) > len(extra):
        reason = "the device sends without being asked"
        run.charge((extra + flood.answers)[:8], reason, "R-unsolicited")
    else:
        run.charge(extra, f"{what} came later than the case")
    if len(extra) + len(flood.answers) > _FLOOD * run.protocol.longest_frame:
        run.floods += 1
        if run.floods >= _FLOODS:
            raise GaveUp("the device sends without end and without being asked")


def leave(run: Run) -> Script[Ended | None]:
    """Home for the last time, confirmed by the probe where there is one.

    Returns what ended the run while it was leaving, None if nothing did.
    """
    seen: Seen | None = None
    try:
        for _ in range(3):
            yield from send(pad(run))
            yield from listen(run.protocol.longest_frame, run.usual)
            if not run.looks_freely:
                return None
            seen = yield from watch(run, moving=False, patience=run.limits.deadline)
            if not seen.look.moving:
                return None
            yield from listen(None, run.profile.truncation_timeout or run.limits.deadline)
    except Ended as ended:
        if not ended.line_works:
            return ended
        # Interrupted, or the probe lost, while leaving: what was asked for last was not done.
        try:
            yield from send(pad(run))
            yield from listen(run.protocol.longest_frame, run.usual)
        except Ended as again:
            return again
        return ended
    assert seen is not None
    clause, requirement = run.protocol.clauses.safety, "the run leaves the robot at rest"
    case = special(run.protocol, "leave/stopped", clause, requirement, pad(run))
    fault = Axis(Verdict.FAIL, "stopped", look_words(seen.look), "THE ROBOT STILL MOVES")
    run.end(case, {"stop": fault})
    return None


def set_up(run: Run, state: State) -> Script[str]:
    """Bring a homed robot to a state, one instruction at a time.

    Returns "" or what is wrong: an instruction that was not answered exactly once.
    """
    run.belief = run.model.homed(run.model.found())
    frames = [frame for frame in frames_to(run.protocol, state) if run.wire(frame)]
    answered = 0
    for frame in frames:
        sent = yield from send(run.wire(frame))
        run.belief = run.model.after(run.belief, deed_of(run.protocol, frame))
        heard = yield from run.answers(1)
        answered += len(heard.answers)
        run.profile.measured(heard, sent)
    run.belief = replace(run.belief, rests=frozenset())
    if answered == len(frames):
        return ""
    run.between.lost(len(frames) - answered)
    return f"{answered} answers to {len(frames)} instructions of the set-up"


def watch(run: Run, *, moving: bool, patience: int) -> Script[Seen]:
    """Look until the robot moves (or stands still), for at most `patience` ns.

    Link and probe are two lines: what is seen beside a fresh answer may be older than the answer.
    """
    seen = yield from see()
    start = seen.asked
    while seen.look.moving is (not moving) and seen.now - start < patience:
        yield from _pause(run, 2 * MS)
        seen = yield from see()
    if seen.look.moving is (not moving):
        run.waste(patience)
    return seen


def _pause(run: Run, pause: int) -> Script[None]:
    """Wait; what is heard meanwhile is the open case's, if there is one."""
    heard = yield from listen(None, pause)
    if heard.answers and run.open_id:
        run.hear(heard)
    elif heard.answers:
        run.charge(heard.answers, "came although nothing was sent")


def see_motions(run: Run) -> Script[None]:
    """In which kinds of motion the robot moves at all: without it no stop can be judged."""
    if not run.looks_freely:
        return
    moves: set[Motion] = set()
    _, fast = run.protocol.limits.get("speed", (0, 0))
    for spec in run.protocol.instructions:
        motion = spec.effect.motion
        if motion is None or motion is Motion.STOPPED or spec.fields:
            continue
        for _ in range(_TRIES):
            yield from set_up(run, State(motion=motion, speed=fast))
            seen = yield from watch(run, moving=True, patience=run.limits.deadline)
            yield from home(run)
            if seen.look.moving is not False:
                break
        if seen.look.moving:
            moves.add(motion)
    run.moves = moves
