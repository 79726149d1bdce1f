"""Checks the probe where a failure rests on it: whether it shows the robot as it is now.

A robot that starts and stops late is told from a probe that lags by what is common to both: a probe
that lags shows no change at once. It is made once in a run, before the first such failure counts.
"""

from __future__ import annotations

from bilprov.analyzer.client.operations import Procedure, listen, observe, send
from bilprov.analyzer.client.rest import stops
from bilprov.captures.schemas import MS
from bilprov.conformance.cases.case import in_motion
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.runner.homing import home, set_up
from bilprov.conformance.runner.run import Run
from bilprov.spec.by_effect import moving_to

_ROUNDS = 2
_FIRST, _FIRST_TIME = 60, 300 * MS  # looks at the beginning, and how long they may take
_QUIET = 300 * MS  # after a change, until the robot is looked at: whatever lags has come by then
_PATIENCE = 500 * MS  # for a change to be shown
_LAG = 50 * MS  # half of what a stop may take: then a good robot seems to stop late


def first_looks(run: Run) -> Procedure[None]:
    """Look at a homed robot often: it rests, so that a probe which guesses shows that it does."""
    sees = run.config.observability
    if sees.foreign and not sees.costly:
        for _ in range(min(_FIRST, _FIRST_TIME // max(1, run.config.look_time))):
            yield from observe()
        if run.looks.contradictory:
            run.distrust(run.looks.words)


def settle_failures(run: Run) -> Procedure[None]:
    """Check the probe if failures that rest on it are waiting for that, and publish them.

    Leaves the line homed.
    """
    if run.waiting_failures and not run.doubt:
        doubt = yield from _check(run)
        yield from home(run)
        if doubt:
            run.distrust(doubt)
    run.release()


def note_no_stop(run: Run) -> None:
    """Note where no fault of any class was seen to stop the robot: the probe may show commands."""
    stops = {
        result.id.partition("/")[0]: result.axes["stop"].verdict
        for result in run.results
        if "stop" in result.axes
    }
    seen_to_stop = stops.pop(FrameClass.VALID, None) is Verdict.PASS
    foreign = run.config.observability.foreign
    if foreign and seen_to_stop and len(stops) > 1 and {*stops.values()} == {Verdict.FAIL}:
        run.notices.append(
            "no kind of fault was seen to stop the robot, and a stop was: check that the probe "
            "shows what the wheels do, and not what was commanded"
        )


def _check(run: Run) -> Procedure[str]:
    """Why the probe cannot be believed, "" if nothing speaks against it."""
    protocol = run.protocol
    states = [in_motion(protocol, motion) for motion in sorted(run.profile.moves or ())]
    starts = [frame for frame in (moving_to(protocol, state) for state in states) if frame][:2]
    lags: list[int] = []
    fresh: list[bool] = []
    for start in starts * _ROUNDS:
        for wait in (0, _QUIET):
            yield from home(run)
            yield from set_up(run, in_motion(protocol, None))
            for frame, moving in ((start, True), (stops(run.protocol)[:1], False)):
                yield from listen(None, _QUIET)
                late = yield from _shown_after(run, run.wire(frame), wait, moving=moving)
                if late is not None and wait:
                    fresh.append(not late)
                elif late is not None:
                    lags.append(late)
    if lags and min(lags) > _LAG:
        return (
            f"the probe shows what the robot does {min(lags) / MS:.0f} ms late, or the robot "
            "starts and stops that late"
        )
    if fresh and not any(fresh):
        return "the probe shows what the robot did at the observation before"
    return ""


def _shown_after(run: Run, frame: bytes, wait: int, *, moving: bool) -> Procedure[int | None]:
    """How long (ns) after a frame, and `wait` ns, the probe first shows it moving, or not.

    0 where the first look shows it, None where none does.
    """
    yield from send(frame)
    answers = 0
    if wait:
        answers = len((yield from listen(None, wait)).answers)
    seen = yield from observe()
    begun, first = seen.asked, seen.look.moving is moving
    while seen.look.moving is not moving and seen.now - begun < _PATIENCE:
        answers += len((yield from listen(None, 2 * MS)).answers)
        seen = yield from observe()
    if not answers:
        yield from run.waiting.answers(1)
    if seen.look.moving is not moving:
        return None
    return 0 if first else seen.asked - begun
