"""The first look at a device's own choices: short probes for each point the document leaves open.

Each probe is made twice and must show the same; what it showed is what the device is held to from
then on. A probe is a case (`reading/...`), with the verdict that the readings give to the choice.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from conformance.cases.single_frames import Case, special
from conformance.dut.operations import Script
from conformance.oracle.choices import LOSING, POINTS
from conformance.oracle.verdicts import Axis, Verdict
from conformance.runner.discovery.answers import DEFAULT, answer_probes
from conformance.runner.discovery.experiment import Probe, Shown
from conformance.runner.discovery.state import state_probes
from conformance.runner.homing import home
from conformance.runner.power_on import first_frames_lost
from conformance.runner.run import Run
from spec.protocol import Protocol

_AGREE, _TRIES = 2, 6


def reading_cases(protocol: Protocol) -> tuple[Case, ...]:
    """The probes that every run makes, as cases; those that an option asks for come with it."""
    return tuple(_case(protocol, probe) for probe in _probes(protocol) if not probe.option)


def _probes(protocol: Protocol) -> Iterator[Probe]:
    yield from answer_probes(protocol)
    yield from state_probes(protocol)


def _case(protocol: Protocol, probe: Probe) -> Case:
    reading = POINTS[probe.points[0]].reading
    clause = protocol.clauses.safety if probe.safety else protocol.clauses.instructions
    ident = f"reading/{probe.name}"
    return special(protocol, ident, clause, probe.requirement, probe.stimulus, reading)


def discover(run: Run) -> Script[None]:
    """Make every probe that this device and its probe allow, and settle what it showed."""
    for probe in _probes(run.protocol):
        if probe.option and probe.option not in run.profile.choices.allowed:
            continue
        case = _case(run.protocol, probe)
        if "pipelining" in run.profile.choices.allowed and probe.points[0] in LOSING:
            continue
        run.begin(case.id)
        if probe.sees and not run.looks_freely:
            run.end(case, {"state": run.blind("one choice of what the document leaves open")})
            continue
        if probe.sees and run.moves is not None and not run.moves:
            reason = "never seen moving in any kind of motion: is the motor power on?"
            run.end(case, {"state": Axis(Verdict.INCONCLUSIVE, "moving", "stopped", reason)})
            continue
        yield from _settle(run, probe, case)
    yield from first_frames_lost(run)


def _settle(run: Run, probe: Probe, case: Case) -> Script[None]:
    """Make a probe until it has shown the same twice, at most six times."""
    shown: Counter[Shown] = Counter()
    once = 1 if probe.long else _AGREE
    while max(shown.values(), default=0) < once and sum(shown.values()) < _TRIES:
        found = yield from probe.make(run)
        yield from home(run)
        shown[found] += 1
        if len(_told(shown)) > 1 or found.fault:
            once = _AGREE + 1  # not the same, or a fault: once more than the line's noise explains
    best, _ = shown.most_common(1)[0]
    axis = "state" if probe.sees else "answer"
    coarse = next((found.coarse for found in shown if found.coarse), "")
    shown = _told(shown)
    if len(shown) > 1 and shown.most_common(2)[1][1] > 1:
        kinds = " and ".join(sorted(found.actual for found in shown))
        reason = "shows more than one choice; a device keeps to one"
        verdict = Verdict.FAIL
        if coarse:  # then it may have been the line
            verdict, reason = Verdict.INCONCLUSIVE, f"flaky: {coarse}"
        run.end(case, {axis: Axis(verdict, best.expected, kinds, reason, case.reading)})
        return
    judged = _judged(run, best, case)
    # What one try alone has shown does not stay in the profile either.
    choices, profile = run.profile.choices, run.profile
    if "R-watchdog" in probe.points and not choices.is_other("R-watchdog"):
        profile.watchdog = None
    if "R-truncation-timeout" in probe.points:
        profile.whole_frame = profile.whole_frame and choices.is_other("R-truncation-timeout")
    faults = sum(times for found, times in shown.items() if found.fault)
    if judged.verdict is Verdict.FAIL and best.fault and faults <= _AGREE:
        reason = f"flaky, {faults} times in {sum(shown.values())} tries: {best.fault}"
        judged = Axis(Verdict.INCONCLUSIVE, best.expected, best.actual, reason, case.reading)
    elif len(shown) > 1 and judged.verdict < Verdict.INCONCLUSIVE:
        other = shown.most_common(2)[1][0]
        reason = f"flaky: shown once in {sum(shown.values())} tries: {other.actual}"
        judged = Axis(Verdict.INCONCLUSIVE, best.expected, best.actual, reason, case.reading)
    run.end(case, {axis: judged}, best.heard)


def _told(shown: Counter[Shown]) -> Counter[Shown]:
    """The tries that told something: not those for which the line was too coarse."""
    return Counter({found: times for found, times in shown.items() if not found.coarse})


def _judged(run: Run, best: Shown, case: Case) -> Axis:
    """The worst of what was shown, and settles it."""
    if best.fault:
        return Axis(Verdict.FAIL, best.expected, best.actual, best.fault, case.reading)
    if best.coarse:
        verdict = Verdict.INFORMATIONAL
        return Axis(verdict, best.expected, best.actual, best.coarse, case.reading)
    worst = Axis(Verdict.PASS, best.expected, best.actual)
    for point, word in best.words:
        word = POINTS[point].default if word == DEFAULT else word
        choice = POINTS[point].choice(word)
        if word == "":
            if worst.verdict < Verdict.INCONCLUSIVE:
                reason = f"not observable: the probe does not tell ({point})"
                worst = Axis(Verdict.INCONCLUSIVE, best.expected, best.actual, reason)
            continue
        reading = POINTS[point].reading
        if choice is None:
            reason = f"{reading}: {word}"
            return Axis(Verdict.FAIL, best.expected, best.actual, reason, reading)
        contradicts = run.profile.choices.settle(point, word, case.id)
        if contradicts:
            return Axis(Verdict.FAIL, best.expected, best.actual, contradicts, reading)
        if choice.verdict > worst.verdict:
            reason = f"{word}: another reading of {reading}"
            worst = Axis(choice.verdict, best.expected, best.actual, reason, reading)
    return worst
