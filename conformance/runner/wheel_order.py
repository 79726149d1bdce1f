"""Executes a case on the wheels' order: sets each value in motion and looks until it has settled.

It is skipped where the probe does not tell graded speeds.
"""

from __future__ import annotations

from typing import Any

from bilprov.analyzer.client.operations import Procedure, Received, listen, observe, send
from bilprov.captures.schemas import MS, Look
from bilprov.conformance.cases.case import RESOLUTION, OrderCase
from bilprov.conformance.oracle.judge import answer_words
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.oracle.wheel_order import Speeds, judge_order, sizes, spread, tolerance
from bilprov.conformance.runner.homing import set_up, watch
from bilprov.conformance.runner.run import Trial
from bilprov.spec.codec import judge

_NO_SPEEDS = "the probe reports no wheel speeds"
_LOOKS = 3  # at each setting
_PAUSE = 2 * MS  # between looks that differ
_PATIENCE = 100 * MS  # for a setting to settle


def run_wheel_order(trial: Trial, case: OrderCase) -> Procedure[None]:
    """Execute the case on a homed line."""
    run, expected = trial.run, f"each of {len(case.settings)} settings taken"
    car, why = run.protocol.car, ""
    motion = car.drive(case.setup).motion
    if not run.config.observable:
        why = f"not observable ({run.config.observability.why})"
    else:
        yield from set_up(run, case.setup)
        seen = yield from watch(run, moving=True, trial=trial)
        if None in _speeds(seen.look):
            why = _NO_SPEEDS
        elif not (seen.look.moving or motion in (run.profile.moves or ())):
            why = "never seen moving in this motion"
    trial.begin(case, {"answer": Axis(Verdict.PASS, expected, expected)}, Received((), 0), 0)
    looks: dict[int, list[Speeds]] = {}
    for value, frame in () if why else case.settings:
        wrong = yield from _refusal(trial, case, frame)
        if wrong:
            reason = f"{case.variable} {value} was answered {wrong}"
            trial.worsen("answer", Verdict.FAIL, wrong, reason)
            return
        looks[value] = yield from _settled(trial, looks)
        why = why or ("" if looks[value] else _NO_SPEEDS)
    run.profile.graded = run.profile.graded or len(sizes(looks)) > 1
    if not (why or run.profile.graded):
        why = "the wheels show a single speed: the probe reports no graded speeds"
    if why:
        trial.axes = {"answer": Axis(Verdict.SKIPPED, case.requirement, "not run", why)}
        return
    steers = case.variable == car.steering
    verdict, words, reason = judge_order(case.variable, car.turn(motion), looks, steers=steers)
    reading = RESOLUTION if reason else ""
    trial.axes["state"] = Axis(verdict, case.requirement, words, reason, reading)


def _refusal(trial: Trial, case: OrderCase, frame: bytes) -> Procedure[str]:
    """Send a setting; returns "" if it was taken, else the answers that came, in words.

    Where a speed counts from the next motion on, or the robot stops by itself, the motion is sent
    after the speed, or before a steering that it might reset.
    """
    run, choices = trial.run, trial.run.profile.choices
    again = choices.differs("R-speed-moving") or run.profile.watchdog is not None
    mover = (case.mover,) if again else ()
    steers = case.variable == run.protocol.car.steering
    for data in (*mover, frame) if steers else (frame, *mover):
        yield from send(run.wire(data))
        heard = yield from run.waiting.answers(1)
        trial.hear(heard)
        if heard.codes != (judge(run.protocol, data).response.code,):
            return answer_words(run.protocol, heard.codes)
    return ""


def _settled(trial: Trial, before: dict[int, list[Speeds]]) -> Procedure[list[Speeds]]:
    """Looks that agree, or the last when the time is up; none where the probe shows no speeds."""
    for waited in range(0, _PATIENCE + _PAUSE, _PAUSE):
        if waited:
            trial.hear((yield from listen(None, _PAUSE)))
        looks = []
        for _ in range(_LOOKS):
            looks.append(_speeds((yield from observe()).look))
        if any(None in speeds for speeds in looks):
            return []
        if spread(looks) <= tolerance(max(sizes({**before, -1: looks}), default=0)):
            break
    return looks


def _speeds(look: Look) -> Any:
    """The wheels' speeds (left, right), None for one that the probe does not tell."""
    return look.left, look.right
