"""Explains the failures of a run: its causes in words, as the report gives them, worst first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from bilprov.analyzer.client.operations import Procedure, followed, listen, power_cycle
from bilprov.captures.text import quantity
from bilprov.conformance.causes.exchanges import (
    ANSWER,
    MOTION,
    TRUNCATED,
    Deviation,
    Exchanges,
    Timing,
)
from bilprov.conformance.causes.features import Literal, Rule, features, matches
from bilprov.conformance.causes.relations import RESUMES, Effect
from bilprov.conformance.causes.reproduction import Finder, Line, shorter_lines, shown_by, shown_in
from bilprov.conformance.causes.trace import Trace
from bilprov.conformance.oracle.judge import code_words, deviation
from bilprov.conformance.oracle.verdicts import CaseResult, Cause, Verdict, WireEvent
from bilprov.conformance.runner.homing import home_after
from bilprov.conformance.runner.listeners.listener import WireLog
from bilprov.conformance.runner.run import Run
from bilprov.conformance.runner.waiting import GaveUp
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.conformance.causes.causes import Cause as Found


_TRIED = 5
"""Causes that are tried again."""
_AGAIN = {None: "not tried again", True: "tried again: the same", False: "tried again: not seen"}
_WHILE = 10_000_000_000
"""For how long (ns) causes are tried again."""


@dataclass(slots=True)
class Explanation:
    """A cause, lines to try, and whether the first shows it (None where it was not tried).

    `deviation` is the one that it then showed.
    """

    found: Found
    lines: list[Line]
    shown: bool | None = None
    deviation: Deviation | None = None
    log: tuple[WireEvent, ...] = ()


class Explainer:
    """Explains a run's failures from its trace; `byte_time` is a byte's time on the line (ns)."""

    def __init__(self, run: Run, trace: Trace, byte_time: int) -> None:
        self.run = run
        self._trace = trace
        self._byte_time = byte_time
        self.exchanges: Exchanges | None = None

    @property
    def timing(self) -> Timing:
        """The times of the line."""
        return Timing(self.run.waiting.timeout, self._byte_time, self.run.timers.longest)

    def try_again(self) -> Procedure[None]:
        """Try the line of each of the first causes again, and then longer ones that may show them.

        From one that does, what it does not need is taken while there is time.
        The device was just switched on where that can be done, and else homed. One that cannot be
        homed any more is not tried.
        """
        begun = self._trace.now
        for explanation, line in self._lines():
            if line.unhomed and not self.run.config.power:
                continue
            if self._trace.now - begun > _WHILE:
                return
            try:
                shown = yield from self._shows(explanation, line)
            except GaveUp:
                return
            explanation.shown = shown or bool(explanation.shown)

    def _lines(self) -> Iterator[tuple[Explanation, Line]]:
        """The lines to try: the first ones, longer ones until one shows, then shorter ones.

        That a device moves on is no deviation of a frame: the motion before it is not taken away.
        """
        tried = self.explanations[:_TRIED]
        yield from ((explanation, explanation.lines[0]) for explanation in tried)
        for explanation in tried:
            for line in explanation.lines[1:]:
                if not explanation.shown:
                    yield explanation, line
        for explanation in tried:
            if explanation.shown and not explanation.found.moves_on:
                yield from ((explanation, line) for line in shorter_lines(explanation.lines))

    def _shows(self, explanation: Explanation, line: Line) -> Procedure[bool]:
        """Switch the device on or bring it to rest, and send the line; return whether it shows.

        A line that does becomes that of the explanation.
        """
        run, trace, log, found = self.run, Trace(), WireLog(), explanation.found
        if run.config.power:
            yield from followed(self._switch_on(), trace)
        if not line.unhomed:
            yield from followed(self._home(), trace)
        trace.begin("")
        sent = shown_by(line, self.timing, found.watched, looks=run.config.observable)
        log.begin("")
        yield from followed(sent, trace, log)
        yield from self._home()
        seen = Exchanges(run.model, trace.events, self.timing)
        shown = shown_in(found, line, seen, explanation.deviation)
        if shown is not None:
            explanation.lines[:], explanation.deviation = [shown.line], shown.deviation
            explanation.log = log.of("")
        return shown is not None

    def _switch_on(self) -> Procedure[None]:
        """Switch the device off and on, and wait until it has booted."""
        yield from power_cycle()
        yield from listen(None, 2 * (self.run.profile.boot or 0) + self.run.timers.settle)

    def _home(self) -> Procedure[None]:
        """Home the device; what it sends late is no result of the run any more.

        One that does not answer may still move: it is switched off where that can be done.
        """
        homed = yield from home_after(self.run, None)
        if isinstance(homed.stopped, GaveUp) and self.run.config.power:
            yield from self._switch_on()
        elif homed.stopped:
            raise homed.stopped

    def causes(self) -> tuple[Cause, ...]:
        """Return the causes of the run's failures, those that keep the device moving first."""
        failed = {r.id: r.clause for r in self.run.results if r.verdict is Verdict.FAIL}
        judged = sum(r.verdict is not Verdict.SKIPPED for r in self.run.results)
        return tuple(self._cause(one, failed, judged) for one in self.explanations)

    @cached_property
    def explanations(self) -> list[Explanation]:
        """The causes as they were found, the worst first, each with its line."""
        run = self.run
        failed = {r.id for r in run.results if r.verdict is Verdict.FAIL}
        if not failed:
            return []
        from bilprov.conformance.causes.causes import fewest_causes  # it needs numpy

        rebuilt = partial(Exchanges, run.model, self._trace.events, self.timing)
        self.exchanges = rebuilt()
        found = fewest_causes(features(run.protocol), self.exchanges, failed, rebuilt)
        _mark_moving(found, run.results)
        found.sort(key=lambda cause: (_rank(cause), -len(cause.cases)))
        finder = Finder(run.model, self.timing)
        return [Explanation(cause, finder.lines(cause)) for cause in found]

    def _cause(self, explanation: Explanation, failed: dict[str, str], judged: int) -> Cause:
        found, shown = explanation.found, explanation.shown
        taken = found.cases
        cases = tuple(ident for ident in failed if ident in taken)
        right = {
            e.case for effect in found.effects for e in effect.against if matches(found.rule, e)
        }
        others = len(right - taken)
        when, what = condition(found.rule), deviations(self.run.protocol, found.effects)
        if found.moves_on and not any(effect.keeps_moving for effect in found.effects):
            what += f" and {_NO_STOP}"
        clauses, safety = [failed[ident] for ident in cases], self.run.protocol.clauses.safety
        met = len(cases) + others
        sure = f"{len(cases):,} of {quantity(met, 'case')}, and none of {judged - met:,} others"
        return Cause(
            sentence=f"{what} after {when} ({sure}; {_AGAIN[shown]})",
            when=when,
            axis=("stop", "state", "answer", "state")[_rank(found)],
            clause=safety if _rank(found) == 0 else Counter(clauses).most_common(1)[0][0],
            cases=cases,
            others=others,
            send=explanation.lines[0].words,
            tried=shown is not None,
            log=explanation.log,
            shown=_shown(self.run.protocol, explanation.deviation),
        )


def _shown(protocol: Protocol, seen: Deviation | None) -> str:
    """Return what deviated in words: `steering is 1, expected -255`."""
    if seen is None:
        return ""
    if seen.facet != ANSWER:
        return deviation(seen.facet, seen.expected, seen.seen)
    due = f"expected {_code(protocol, seen.expected)}"
    if seen.how == "late":
        return f"the answer came after {seen.seen} ms"
    if seen.how == "extra":
        return f"{seen.seen}, {due} once"
    return f"answered {_code(protocol, seen.seen)}, {due}"


def _rank(found: Found) -> int:
    """How bad a cause is: it keeps moving, a wrong motion, a wrong answer, the rest."""
    facets = {effect.relation.facet for effect in found.effects}
    if found.moves_on or any(effect.keeps_moving for effect in found.effects):
        return 0
    return 1 if MOTION in facets else 2 if ANSWER in facets else 3


def _mark_moving(found: Sequence[Found], results: Iterable[CaseResult]) -> None:
    """Mark the causes with a wrong answer behind which the device has not stopped.

    What the device does there is no deviation of its own: the frame may be another to it. It is
    seen in the cases that no cause explains which is known to keep the device moving.
    """
    stops = {result.id: result.axes.get("stop") for result in results}
    moving = {ident for ident, axis in stops.items() if axis and axis.verdict is Verdict.FAIL}
    named = [cause.cases for cause in found if any(e.keeps_moving for e in cause.effects)]
    left = moving.difference(*named)
    for cause in found:
        answers = any(effect.relation.facet == ANSWER for effect in cause.effects)
        cause.moves_on = answers and not left.isdisjoint(cause.cases)


_CODES = 4
"""Pairs of answers that are named; of more it is said what they have in common."""
_NO_STOP, _LATE_STOP = "does not stop", "stops late"


def condition(rule: Rule) -> str:
    """Return a rule in words: `LED with rgb 8 to 255, while it moves`."""
    subjects = [literal for literal in rule if literal.feature.subject]
    names = [_literal(literal) for literal in subjects] or ["any frame"]
    others = list(_ranges([literal for literal in rule if not literal.feature.subject]))
    return ", ".join([" that is ".join(names), *others]).replace("_", " ")


def _ranges(literals: Sequence[Literal]) -> Iterator[str]:
    """The literals in words, where two ends of a range are one."""
    ends = {(literal.feature.name, literal.operator): literal for literal in literals}
    for literal in literals:
        name, operator = literal.feature.name, literal.operator
        low, high = ends.get((name, "from")), ends.get((name, "to"))
        if operator == "to" and low:
            continue
        if operator == "from" and high:
            yield literal.feature.words.format(f"{literal.value} to {high.value}")
        else:
            yield _literal(literal)


_BESIDE = {"from": " or more", "to": " or less"}
"""What follows a value under an operator."""
_BITS = {"bit": "set", "no bit": "clear"}
_PLURALS = ("frames", "bytes", "faults")


def _literal(literal: Literal) -> str:
    value: Any = literal.value
    words, operator = literal.feature.words, literal.operator
    if operator == "every":
        return f"at one in {value[0]} of the {literal.feature.name} since power-on"
    if operator in _BITS:
        return words.replace(" ", f" bit {value} of ", 1).format(_BITS[operator])
    if operator == "is" and value == 1:
        plural = next((plural for plural in _PLURALS if plural in words), "")
        words = words.replace(plural, plural[:-1], 1)
    kinds = value if operator == "in" else (value,)
    value = " or ".join("a truncated frame" if kind == TRUNCATED else str(kind) for kind in kinds)
    return words.format(f"{value}{_BESIDE.get(operator, '')}")


def deviations(protocol: Protocol, effects: Sequence[Effect]) -> str:
    """Return what goes wrong in words: `does not stop and steering is off by -256`."""
    worst_first = sorted(effects, key=lambda effect: not effect.keeps_moving)
    words = dict.fromkeys(_effect(protocol, effect) for effect in worst_first)
    if {_NO_STOP, _LATE_STOP} <= words.keys():  # how late decides what an observation shows
        words = {"stops late or not at all": None} | words
        del words[_NO_STOP], words[_LATE_STOP]
    of_one: dict[str, list[str]] = {}
    for word in words:
        subject, verb, value = word.partition(" is ")
        of_one.setdefault(f"{subject}{verb}", []).append(value)
    return " and ".join(head + " or ".join(values) for head, values in of_one.items())


def _effect(protocol: Protocol, effect: Effect) -> str:
    relation = effect.relation
    late = {"changed": " after a while", "late": " late"}.get(relation.how, "")
    if relation.facet == ANSWER:
        return _answer(protocol, effect)
    if relation.facet == MOTION:
        expected = {bag.deviation.expected for bag in effect.bags}
        if relation.how == "late":
            return _LATE_STOP if expected == {effect.bags[0].still} else "moves late"
        if effect.keeps_moving and relation.words == RESUMES and effect.comes_back:
            return "moves again as before the fault"
        if effect.keeps_moving:
            return "moves again by itself" if late else _NO_STOP
        seen = {str(bag.deviation.seen) for bag in effect.bags}
        stays = relation.words.startswith("stays") and len(seen) > 1
        motion = "keeps its motion" if stays else relation.words
        motion = f"is {seen.pop()}" if len(seen) == 1 else motion
        return motion.replace("_", " ") + late
    if relation.how == "late":
        return f"{relation.facet} changes late"
    return f"{relation.facet} {relation.words}{late}"


def _answer(protocol: Protocol, effect: Effect) -> str:
    pairs = sorted({bag.deviation[2:] for bag in effect.bags}, key=str)
    if effect.relation.how != "other" or len(pairs) > _CODES:
        return effect.relation.words
    words = (f"{_code(protocol, seen)} instead of {_code(protocol, due)}" for due, seen in pairs)
    return f"answers {', '.join(words)}"


def _code(protocol: Protocol, code: int | str | None) -> str:
    return code_words(protocol, code) if isinstance(code, int) else "nothing"
