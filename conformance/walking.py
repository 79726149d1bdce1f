"""Walks a walk: sends its bursts, holds every answer and every look against the model.

It ends at the first mismatch: what comes after one is no longer the walk that was planned.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from captures.schemas import Look
from conformance.asks import Heard, Script, listen, see, send
from conformance.choices import LOSING, POINTS
from conformance.chosen import as_chosen
from conformance.judging import (
    MOVING,
    MS,
    answer_words,
    code_words,
    contradiction,
    differences,
    look_words,
    state_words,
)
from conformance.model import Belief
from conformance.run import Run
from conformance.steps import Accepted, Class, Step
from conformance.verdicts import Axis, Verdict
from conformance.walks import Burst, Walk


@dataclass(frozen=True, slots=True)
class Mismatch:
    """Where a walk went wrong: the burst and the step in it, and the axis that says how."""

    burst: int
    step: Step
    name: str
    axis: Axis
    clause: str


def walk(run: Run, case: Walk) -> Script[Mismatch | None]:
    """Walk on a homed line. The case is left open: the next homing makes it final."""
    return (yield from _Walker(run, case).go())


_FEW = 4  # answers too many: more of them are no answers, but sent without being asked
_DWELL = 4 * MS  # between two looks at a robot that is left alone
_Early = list[tuple[int, tuple[tuple[int, int], ...]]]


class _Walker:
    def __init__(self, run: Run, case: Walk) -> None:
        self._run = run
        self._case = case
        self._axes = {"answer": Axis(Verdict.PASS, "each instruction answered once", "as expected")}
        self._looked = 0
        self._coarse = 0
        self._blind = False

    def go(self) -> Script[Mismatch | None]:
        run, case = self._run, self._case
        run.open(case, self._axes, Heard((), 0), 0)
        self._blind = not run.looks_freely or run.moves == set()
        run.belief = run.model.homed(run.model.found())
        found: Mismatch | None = None
        setup = (Burst((step,), looks=False) for step in case.setup)
        for index, burst in enumerate((*setup, *case.bursts), -len(case.setup)):
            if run.belief.rests:
                run.belief = replace(run.belief, rests=frozenset())
            found = yield from self._burst(index, burst)
            if found:
                run.axes[found.name] = found.axis
                break
        if not found and self._blind:
            run.axes["state"] = run.blind("as the model says after each burst")
        elif not found and self._looked and "state" not in run.axes:
            actual = f"{self._looked} looks as expected"
            run.axes["state"] = Axis(Verdict.PASS, "as the model says", actual)
        if self._coarse and not found:
            reason = f"{self._coarse} pauses came out too long for the time-out on this link"
            words = "pauses below the time-out"
            run.axes["answer"] = Axis(Verdict.INFORMATIONAL, words, reason, reason)
        return found

    # -- one burst ----------------------------------------------------------------------------

    def _burst(self, index: int, burst: Burst) -> Script[Mismatch | None]:
        run = self._run
        chosen = [as_chosen(run.protocol, run.profile.choices, step) for step in burst.steps]
        for part in self._parts(burst, chosen):
            found = yield from self._part(index, part)
            if found:
                return found
        return None

    def _parts(self, burst: Burst, chosen: list[Step]) -> Iterator[Burst]:
        """The burst in pieces where a device that loses or lags leaves open what it would do.

        One that loses what follows a fault until the line is idle may do so or not where the line
        pauses; one that stops late has not stopped yet when the next frame comes.
        """
        profile = self._run.profile
        apart = profile.stop_latency or (burst.pauses and profile.flushes)
        whole = replace(burst, steps=tuple(chosen))
        if not apart or len(chosen) == 1:
            yield whole if whole.steps != burst.steps else burst
            return
        steps: list[Step] = []
        for step in chosen:
            steps.append(step)
            if step.faulty or step.deed.stops or step is chosen[-1]:
                yield Burst(tuple(steps), looks=burst.looks, dwell=burst.dwell)
                steps = []

    def _part(self, index: int, burst: Burst) -> Script[Mismatch | None]:
        run, chosen = self._run, list(burst.steps)
        stray = yield from listen(None, 0)
        if stray.answers:
            run.hear(stray)
            reason = "came although nothing was asked"
            return self._answer(index, chosen[0], "no answer", stray.codes, reason, "R-unsolicited")
        sent, early, usable = yield from self._send(burst, chosen)
        if not usable:
            self._coarse += 1
            yield from self._forget()
            return None
        before, taken = self._take(chosen)
        found = self._in_time(index, chosen, early)
        if found:
            return found
        heard = tuple(entry for _, answers in early for entry in answers)
        found = yield from self._answers(index, taken, heard, sent)
        if found or self._blind or not burst.looks:
            return found
        found = yield from self._look(index, taken[-1], before)
        if not found and run.profile.stop_latency:
            run.hear((yield from listen(None, 2 * run.profile.stop_latency)))
        if not found and burst.dwell:
            found = yield from self._dwell(index, taken[-1], burst.dwell * MS)
        return found

    def _send(self, burst: Burst, steps: list[Step]) -> Script[tuple[int, _Early, bool]]:
        """Send it, with its pauses; tells when, what came in each, and if they were short enough.

        What came is given with how many bytes had gone.
        """
        run, data = self._run, b"".join(step.frame for step in steps)
        places = [p for p in burst.pauses if p < len(data)] if len(data) == len(burst.data) else []
        early: _Early = []
        usable, last = True, 0
        for start, end in zip([0, *places], [*places, len(data)], strict=True):
            if start:
                heard = yield from listen(None, self._pause)
                run.hear(heard)
                early.append((start, heard.answers))
                usable = usable and heard.now - last < run.timeout // 2
            last = yield from send(data[start:end])
        return last, early, usable

    @property
    def _pause(self) -> int:
        """How long (ns) a pause inside a frame lasts."""
        return min(self._run.timeout // 8, 4 * MS)

    def _in_time(self, index: int, steps: list[Step], early: _Early) -> Mismatch | None:
        """No frame was answered before its end, unless it was faulty from its header on."""
        run, point, came = self._run, "R-answer-point", 0
        for sent, answers in early:
            came += len(answers)
            whole, end = 0, 0
            for step in steps:
                end += len(step.frame)
                if end > sent:
                    break
                whole += 1
            inside = sent > end - len(step.frame)
            word = ""
            if came > whole:
                word = "at-header"
            elif inside and 2 * run.profile.slowest < self._pause and came == whole:
                word = "after-data"
            settled = step.kind in (Class.UNUSED_ID, Class.WRONG_LENGTH)
            if came > whole + 1 or (word == "at-header" and not (inside and settled)):
                reason = "answered a frame that may still be valid before its end"
                codes = tuple(code for _, code in answers)
                return self._answer(index, step, "no answer yet", codes, reason, point)
            if word and inside and settled:
                contradicts = run.profile.choices.settle(point, word, self._case.id)
                if contradicts:
                    return self._answer(index, step, "as before", (), contradicts, point)
        return None

    def _forget(self) -> Script[None]:
        """The device may have cut the frame: wait until it must have, and know nothing."""
        run = self._run
        run.hear((yield from listen(None, 2 * run.timeout + run.usual)))
        run.belief = replace(run.model.found(), loose=frozenset(("speed", "steering", "led")))

    def _take(self, steps: list[Step]) -> tuple[Belief, list[Step]]:
        """What the model makes of them: the belief before the last that counts, and which count."""
        run, before = self._run, self._run.belief
        taken: list[Step] = []
        for step in steps:
            taken.append(step)
            before, run.belief = run.belief, run.model.after(run.belief, step.deed)
            if self._flushes(step):
                break
        return before, taken

    def _flushes(self, step: Step) -> bool:
        """Whether the device throws away what is sent right behind this fault."""
        choices = self._run.profile.choices
        if not step.faulty or choices.others.isdisjoint(LOSING):
            return False
        return choices.is_other(_losing_point(self._run, step))

    # -- answers ------------------------------------------------------------------------------

    def _answers(
        self,
        index: int,
        taken: list[Step],
        early: tuple[tuple[int, int], ...],
        sent: int,
    ) -> Script[Mismatch | None]:
        run, last = self._run, taken[-1]
        silent = last.cut and run.profile.choices.word(last.point) == "silent"
        due = len(taken) - silent
        left = max(0, due - len(early))
        if last.cut:
            heard = yield from self._cut(left, sent)
        else:
            heard = yield from run.all_answers(left, run.patience)
            if len(heard.answers) < left:
                run.missing = True
        run.hear(heard)
        heard = Heard(early + heard.answers, heard.now)
        if any(step.faulty for step in taken) and run.profile.flushes:
            more = yield from listen(None, run.timeout + run.limits.settle)
            heard = Heard(heard.answers + more.answers, more.now)
            run.hear(more)
        for step, code in zip(taken, (*heard.codes, *[None] * len(taken)), strict=False):
            found = self._judge(index, step, code)
            if found:
                return found
        if len(heard.answers) > due:
            reason = f"{len(heard.answers)} answers came, {due} were due"
            wanted = answer_words(run.protocol, tuple(self._codes(s)[0] for s in taken[:due]))
            flood = "R-unsolicited" if len(heard.answers) > 2 * due + _FEW else ""
            return self._answer(index, last, wanted, heard.codes, reason, flood)
        return self._soon(index, taken, heard, sent)

    def _cut(self, due: int, sent: int) -> Script[Heard]:
        """What comes while a frame that was cut short is left alone."""
        run = self._run
        pause = run.timeout + run.timeout // 4 + run.limits.settle
        patience = pause + run.usual if due else pause
        heard = yield from run.all_answers(due, patience) if due else listen(None, patience)
        run.timeouts += run.timeout if heard.answers else 0
        if heard.now < sent + run.timeout // 2:
            # Answered at its header: what comes now would still be taken for its data.
            more = yield from listen(None, sent + pause - heard.now)
            heard = Heard(heard.answers + more.answers, more.now)
        return heard

    def _codes(self, step: Step) -> tuple[int, ...]:
        return step.accepted[0].codes

    def _judge(self, index: int, step: Step, code: int | None) -> Mismatch | None:
        run = self._run
        codes = () if code is None else (code,)
        match = next((a for a in step.accepted if a.codes == codes), None)
        expected = answer_words(run.protocol, self._codes(step))
        if match is None:
            if code is None:
                return self._answer(index, step, expected, codes, "no answer came")
            unused = "" if code in run.protocol.codes else ", a code that no device sends"
            reason = f"answered {code_words(run.protocol, code)} instead of {expected}{unused}"
            return self._answer(index, step, expected, codes, reason)
        if step.point:
            word = match.word or POINTS[step.point].default
            contradicts = run.profile.choices.settle(step.point, word, self._case.id)
            if contradicts:
                reading = POINTS[step.point].reading
                return self._answer(index, step, expected, codes, contradicts, reading)
        self._rests(match)
        return None

    def _rests(self, match: Accepted) -> None:
        if match.verdict > self._axes_answer.verdict:
            reason = f"another reading of {match.reading}"
            axis = Axis(match.verdict, "", "", reason, match.reading)
            self._run.axes["answer"] = axis

    @property
    def _axes_answer(self) -> Axis:
        return self._run.axes["answer"]

    def _soon(self, index: int, taken: list[Step], heard: Heard, sent: int) -> Mismatch | None:
        """How soon the answers came: each after its frame, or after the answer before it."""
        run, timing = self._run, self._run.protocol.timing
        if taken[-1].cut or not heard.answers:
            return None
        last = sent
        slowest = 0
        for t, _ in heard.answers:
            slowest, last = max(slowest, t - last), max(t, last)
        run.profile.slowest = max(run.profile.slowest, slowest)
        reading = "R-answer-deadline"
        if slowest > timing.answer_longest * MS:
            reason = f"an answer came after {slowest / MS:.0f} ms"
            return self._answer(index, taken[-1], "in time", heard.codes, reason, reading)
        if slowest > timing.answer_deadline * MS and self._axes_answer.verdict < Verdict.NON_STRICT:
            reason = f"slow: an answer came after {slowest / MS:.0f} ms"
            run.axes["answer"] = Axis(Verdict.NON_STRICT, "", "", reason, reading)
        return None

    def _answer(
        self,
        index: int,
        step: Step,
        expected: str,
        codes: tuple[int, ...],
        reason: str,
        reading: str = "",
    ) -> Mismatch:
        words = answer_words(self._run.protocol, codes)
        axis = Axis(Verdict.FAIL, expected, words, reason, reading or step.reading)
        clause = self._run.protocol.clauses.responses
        return Mismatch(index, step, "answer", axis, clause)

    # -- looks --------------------------------------------------------------------------------

    def _look(self, index: int, step: Step, before: Belief) -> Script[Mismatch | None]:
        run = self._run
        seen = yield from see()
        start = seen.asked
        found = differences(run.model, run.belief, seen.look)
        patience = max(run.limits.deadline, int(run.protocol.timing.stop_longest * MS))
        first = [facet for facet, _, _ in found]
        while found and seen.now - start < patience:
            heard = yield from listen(None, 2 * MS)
            if heard.answers:
                run.hear(heard)
                reason = "came although nothing was asked"
                return self._answer(index, step, "no answer", heard.codes, reason, "R-unsolicited")
            seen = yield from see()
            found = differences(run.model, run.belief, seen.look)
        self._looked += 1
        stops = run.belief.still and any(facet in MOVING for facet in first)
        if not found:
            late = seen.asked - start
            if stops and late > run.limits.grace:
                reason = f"stopped only {late / MS:.0f} ms after its answer"
                words = "stopped", look_words(seen.look)
                axis = Axis(Verdict.NON_STRICT, *words, reason, "R-stop-latency")
                run.axes["stop"] = axis
                run.profile.stop_latency = max(run.profile.stop_latency, late)
            self._rest_on(seen.look)
            return None
        run.waste(patience)
        facet, wanted, actual = found[0]
        reason = f"{facet} is {actual}, expected is {wanted}"
        reading, why = contradiction(run.model, before, step.deed, seen.look)
        words = state_words(run.belief.state), look_words(seen.look)
        axis = Axis(Verdict.FAIL, *words, why or reason, reading)
        name = "stop" if stops and seen.look.moving else "state"
        clauses = run.protocol.clauses
        safety = name == "stop" or step.faulty
        clause = clauses.safety if safety else clauses.instructions
        return Mismatch(index, step, name, axis, clause)

    def _dwell(self, index: int, step: Step, time: int) -> Script[Mismatch | None]:
        """Nothing is sent for `time` ns: nothing comes, and nothing changes by itself."""
        run = self._run
        until = (yield from listen(None, 0)).now + time
        now = 0
        while now < until:
            heard = yield from listen(None, min(_DWELL, time))
            now = heard.now
            if heard.answers:
                run.hear(heard)
                reason = "came although nothing was asked"
                return self._answer(index, step, "no answer", heard.codes, reason, "R-unsolicited")
            seen = yield from see()
            found = differences(run.model, run.belief, seen.look)
            asleep = run.profile.watchdog is not None and seen.look.moving is False
            if found and not asleep:
                facet, _, actual = found[0]
                moves = run.belief.still and seen.look.moving
                reason = "moved again by itself" if moves else f"{facet} became {actual} by itself"
                words = state_words(run.belief.state), look_words(seen.look)
                axis = Axis(Verdict.FAIL, *words, reason)
                clauses = run.protocol.clauses
                clause = clauses.safety if moves else clauses.instructions
                return Mismatch(index, step, "stop" if moves else "state", axis, clause)
        return None

    def _rest_on(self, look: Look) -> None:
        """Another choice that shaped what was rightly seen gives the walk its verdict."""
        run = self._run
        for point in run.belief.rests:
            verdict, reading = run.profile.choices.verdict(point), POINTS[point].reading
            axis = run.axes.get("state")
            if axis is None or verdict > axis.verdict:
                reason = f"{run.profile.choices.word(point)}: another reading of {reading}"
                words = state_words(run.belief.state), look_words(look)
                run.axes["state"] = Axis(verdict, *words, reason, reading)


def _losing_point(run: Run, step: Step) -> str:
    """The point that says whether what follows this fault is lost."""
    nobody = run.protocol.headers[step.frame[0]][0] not in run.protocol.by_id
    if step.kind is Class.WRONG_LENGTH and len(step.frame) > 1:
        return "R-drain-known"
    if step.kind is Class.UNUSED_ID or nobody:
        return "R-drain-unused" if len(step.frame) > 1 else "R-pipelining unused-id"
    return "R-pipelining bad-data" if len(step.frame) > 1 else "R-pipelining too-few"
