"""Discovers a device's choices by short experiments on each open point of the document.

An experiment is repeated until two findings agree; from then on the device is held to that
choice. Where another one comes twice it goes on until noise on the line cannot explain that, or
can. It is a case (`reading/...`) with the verdict that the readings give to the choice.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from bilprov.analyzer.client.operations import Procedure
from bilprov.captures.text import quantity
from bilprov.conformance.cases.case import Case, runner_case
from bilprov.conformance.oracle.profile import verdict_of
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.discovery.answers import Experiment, Finding, answer_experiments
from bilprov.conformance.runner.discovery.state import state_experiments
from bilprov.conformance.runner.homing import home
from bilprov.conformance.runner.power_on import first_frames_lost
from bilprov.conformance.runner.retry import case_bytes, is_no_chance
from bilprov.conformance.runner.run import Run
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import FLUSH_POINTS, POINTS

READING = "reading/"
"""What the id of an experiment's case begins with."""

_AGREE, _TRIES = 2, 6
_MOST = 12  # tries, where noise may be why findings differ


def reading_cases(protocol: Protocol) -> tuple[Case, ...]:
    """The experiments of every run, as cases, without those that only an option adds."""
    return tuple(
        _case(protocol, experiment)
        for experiment in _experiments(protocol)
        if not experiment.option
    )


def _experiments(protocol: Protocol) -> Iterator[Experiment]:
    every = (*answer_experiments(protocol), *state_experiments(protocol))
    # Without points are those on what the grammar has decided, or has no variable for.
    yield from (experiment for experiment in every if experiment.points)


def _case(protocol: Protocol, experiment: Experiment) -> Case:
    reading = POINTS[experiment.points[0]].reading
    clause = protocol.clauses.safety if experiment.safety else protocol.clauses.instructions
    ident = f"{READING}{experiment.name}"
    return runner_case(
        protocol, ident, clause, experiment.requirement, experiment.stimulus, reading
    )


def discover(run: Run) -> Procedure[None]:
    """Make every experiment that device, probe and options allow, and record the choices shown."""
    kept = False
    for experiment in _experiments(run.protocol):
        if experiment.option and experiment.option not in run.profile.choices.allowed:
            continue
        case = _case(run.protocol, experiment)
        if "pipelining" in run.profile.choices.allowed and experiment.points[0] in FLUSH_POINTS:
            continue
        run.begin(case.id)
        if experiment.sees and not run.config.observable:
            axis = run.config.not_observable("one choice of what the document leaves open")
            run.conclude(case, {"state": axis})
        elif experiment.sees and run.profile.moves == set():
            reason = "never seen moving in any kind of motion: is the motor power on?"
            run.conclude(case, {"state": Axis(Verdict.INCONCLUSIVE, "moving", "stopped", reason)})
        else:
            kept = (yield from _settle(run, experiment, case)) or kept
    # One that answers or gives up the data of its own instructions has a time-out.
    run.profile.keeps_waiting = kept and run.profile.choices.differs("R-truncated-known")
    yield from first_frames_lost(run)


def _settle(run: Run, experiment: Experiment, case: Case) -> Procedure[bool]:
    """Make an experiment until two findings agree, and judge its case.

    Six times at most, twelve where noise may be why another finding came more than once. Returns
    whether the stops of the homing were taken for the data of a frame that had been cut short.
    """
    taken = 0
    shown: Counter[Finding] = Counter()
    once = 1 if experiment.long else _AGREE
    while (max(shown.values(), default=0) < once and sum(shown.values()) < _TRIES) or (
        sum(shown.values()) < _MOST and _may_be_noise(run, shown, case)
    ):
        found = yield from experiment.make(run)
        homed = yield from home(run)
        # A stop is answered OK, unless it was the data that a header had announced.
        ok = run.protocol.answers[Outcome.VALID].code
        taken += experiment.cut and not found.heard and homed.first not in (None, ok)
        _count(shown, found)
        if len(_told(shown)) > 1 or found.fault:
            once = _AGREE + 1  # findings differ, or a fault: one more, to rule out noise
    best, _ = shown.most_common(1)[0]
    axis = "state" if experiment.sees else "answer"
    coarse = next((found.coarse for found in shown if found.coarse), "")
    noise = _may_be_noise(run, shown, case)
    shown = _told(shown)
    if _second(shown) > 1 and not noise:
        kinds = " and ".join(sorted(found.actual for found in shown))
        reason = "shows more than one choice; a device keeps to one"
        verdict = Verdict.FAIL
        if experiment.timed and not run.config.virtual:
            coarse = coarse or "pauses near the time-out may come out longer at the device"
        if coarse:  # then it may have been noise
            verdict, reason = Verdict.INCONCLUSIVE, f"flaky: {coarse}"
        run.conclude(case, {axis: Axis(verdict, best.expected, kinds, reason, case.reading)})
        return taken >= _AGREE
    judged = _judged(run, best, case)
    # What only a single try has shown does not stay in the profile either.
    choices, profile = run.profile.choices, run.profile
    if "R-watchdog" in experiment.points and not choices.differs("R-watchdog"):
        profile.watchdog = None
    if "R-truncation-timeout" in experiment.points:
        profile.whole_frame = profile.whole_frame and choices.differs("R-truncation-timeout")
    faults = sum(times for found, times in shown.items() if found.fault)
    if judged.verdict is Verdict.FAIL and best.fault and faults <= _AGREE:
        tries = quantity(sum(shown.values()), "try", "tries")
        if not run.config.lossless:
            reason = f"flaky, {quantity(faults, 'time')} in {tries}: {best.fault}"
            judged = Axis(Verdict.INCONCLUSIVE, best.expected, best.actual, reason, case.reading)
    elif len(shown) > 1 and judged.verdict < Verdict.INCONCLUSIVE:
        other, times = shown.most_common(2)[1]
        tries = quantity(sum(shown.values()), "try", "tries")
        often = "once" if times == 1 else f"{times} times"
        reason = f"flaky: shown {often} in {tries}: {other.actual}"
        verdict = Verdict.INCONCLUSIVE
        if run.config.lossless:
            verdict = Verdict.FAIL
            reason = (
                f"{other.fault or 'a device keeps to one choice'}; shown once in {tries}, on a "
            )
            reason += f"line that loses nothing: {other.actual}"
        judged = Axis(verdict, best.expected, best.actual, reason, case.reading)
    run.conclude(case, {axis: judged}, best.heard)
    return taken >= _AGREE


def _count(shown: Counter[Finding], found: Finding) -> None:
    """Count a finding, together with one that differs only in what could not be told."""
    alike = next((known for known in shown if known.fits(found)), found)
    times = shown.pop(alike, 0)
    shown[max(alike, found, key=lambda finding: finding.told)] = times + 1


def _second(shown: Counter[Finding]) -> int:
    """How often the second most common finding was shown."""
    return shown.most_common(2)[1][1] if len(shown) > 1 else 0


def _may_be_noise(run: Run, shown: Counter[Finding], case: Case) -> bool:
    """Whether spoilt bytes may be why a second finding was shown more than once."""
    told = _told(shown)
    second, tries = _second(told), sum(told.values())
    if second < 2 or run.config.lossless or len(told) < len(shown):
        return False  # where the link was too slow for a try, that is said instead
    return not is_no_chance(run, case_bytes(case), second, tries)


def _told(shown: Counter[Finding]) -> Counter[Finding]:
    """The findings, without those for which the link was too slow to tell."""
    return Counter({found: times for found, times in shown.items() if not found.coarse})


def _judged(run: Run, best: Finding, case: Case) -> Axis:
    """The axis of a finding, with the worst verdict of its choices; records these choices."""
    if best.fault:
        return Axis(Verdict.FAIL, best.expected, best.actual, best.fault, case.reading)
    if best.coarse:
        verdict = Verdict.INFORMATIONAL
        return Axis(verdict, best.expected, best.actual, best.coarse, case.reading)
    worst = Axis(Verdict.PASS, best.expected, best.actual)
    for point, word in best.words:
        if word == "":
            run.profile.choices.hidden.add(point)
            if worst.verdict < Verdict.INCONCLUSIVE:
                reason = f"not observable: the probe does not report ({point})"
                worst = Axis(Verdict.INCONCLUSIVE, best.expected, best.actual, reason)
            continue
        reading = POINTS[point].reading
        verdict, reason = Verdict.FAIL, f"{reading}: {word}"
        if POINTS[point].choice(word) is not None:
            contradicts = run.profile.choices.record(point, word, case.id)
            if not contradicts:
                verdict = verdict_of(point, word)
            reason = contradicts or f"{word}: another reading of {reading}"
        if verdict > worst.verdict:
            worst = Axis(verdict, best.expected, best.actual, reason, reading)
    return worst
