"""Executes a sequence: sends its bursts, compares each answer and observation with the model.

It is observed after a burst and while it is left alone. It ends at the first mismatch: after one
the expected state is not known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from bilprov.analyzer.client.operations import Procedure, Received, listen, observe, send
from bilprov.captures.schemas import MS, Look
from bilprov.captures.text import quantity
from bilprov.conformance.cases.adaptation import adapt_to_device
from bilprov.conformance.cases.sequence import Burst, SequenceCase
from bilprov.conformance.cases.steps import FrameClass, Step
from bilprov.conformance.oracle import judge
from bilprov.conformance.oracle.sight import NOT_OBSERVABLE, facets_set, untold
from bilprov.conformance.oracle.state_model import ExpectedState
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.run import Run, Trial
from bilprov.spec.readings import FLUSH_POINTS, POINTS

# -- the answers to a burst: which came, how many, and how soon -----------------------------------


Early = list[tuple[int, tuple[tuple[int, int], ...]]]
"""For each pause inside a burst: how many of its bytes had been sent, and the answers in it."""

_FEW = 4  # so many more than twice the answers due are a flood (R-unsolicited)


def unasked(trial: Trial, step: Step, heard: Received) -> Mismatch:
    """The mismatch of answers that came although no instruction was sent."""
    trial.hear(heard)
    reason = "came although nothing was asked"
    return _wrong(trial.run, step, "no answer", heard.codes, reason, "R-unsolicited")


def answered_early(trial: Trial, steps: list[Step], early: Early, pause: int) -> Mismatch | None:
    """The mismatch where a frame was answered before its end, None if no answer came too early.

    A frame that is faulty from its header on may be answered there (R-answer-point). `pause` is how
    long (ns) each pause inside the burst lasted.
    """
    run, point, came = trial.run, "R-answer-point", 0
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
        elif inside and 2 * run.profile.slowest < pause and came == whole:
            word = "after-data"
        settled = step.kind in (FrameClass.UNUSED_ID, FrameClass.WRONG_LENGTH)
        if came > whole + 1 or (word == "at-header" and not (inside and settled)):
            reason = "answered a frame that may still be valid before its end"
            codes = tuple(code for _, code in answers)
            return _wrong(run, step, "no answer yet", codes, reason, point)
        if word and inside and settled:
            contradicts = run.profile.choices.record(point, word, trial.case.id)
            if contradicts:
                return _wrong(run, step, "as before", (), contradicts, point)
    return None


def judge_burst(
    trial: Trial, taken: list[Step], early: Early, sent: int, watched: int
) -> Procedure[Mismatch | None]:
    """Receive and judge the answers to the steps `taken`; their last byte went at `sent` (ns).

    For `watched` ns of the time-out of a truncated frame the robot was watched already.
    """
    run, last = trial.run, taken[-1]
    before = tuple(entry for _, answers in early for entry in answers)
    silent = last.truncated and run.profile.choices.word(last.point) == "silent"
    due = len(taken) - silent
    left = max(0, due - len(before))
    if last.truncated:
        # Nothing is sent during its time-out.
        pause = max(0, run.waiting.silence - watched)
        answers = run.waiting.all_answers(left, pause + run.waiting.usual)
        heard = yield from answers if left else listen(None, pause)
        heard = yield from run.waiting.left_alone(heard, sent, watched, silent=silent)
    else:
        heard = yield from run.waiting.all_answers(left, run.waiting.patience)
        if len(heard.answers) < left:
            run.waiting.answer_pending = True
    trial.hear(heard)
    heard = Received(before + heard.answers, heard.now)
    if run.profile.flushes and any(step.faulty for step in taken):
        more = yield from listen(None, run.waiting.idle)
        trial.hear(more)
        heard += more
    # Whether an answer came so late that line or device stood still for most of a time-out.
    held_up = False
    if heard.answers and not run.config.virtual:
        waited = run.waiting.timeout if last.truncated else 0
        late = heard.answers[-1][0] - sent - waited - (run.profile.round_trip or 0)
        held_up = 2 * late > run.waiting.timeout
    for step, code in zip(taken, (*heard.codes, *[None] * len(taken)), strict=False):
        found = _judge(trial, step, code)
        if found:
            return replace(found, held_up=held_up)
    if len(heard.answers) > due:
        came = quantity(len(heard.answers), "answer")
        reason = f"{came} came, {due} {'were' if due > 1 else 'was'} due"
        wanted = judge.answer_words(
            run.protocol, tuple(step.accepted[0].codes[0] for step in taken[:due])
        )
        flood = "R-unsolicited" if len(heard.answers) > 2 * due + _FEW else ""
        return replace(_wrong(run, last, wanted, heard.codes, reason, flood), held_up=held_up)
    return _soon(trial, taken, heard, sent)


def _judge(trial: Trial, step: Step, code: int | None) -> Mismatch | None:
    run = trial.run
    codes = () if code is None else (code,)
    match = judge.matching(step.accepted, codes)
    if match is None:
        expected = judge.answer_words(run.protocol, step.accepted[0].codes)
        if code is None:
            return _wrong(run, step, expected, codes, "no answer came")
        unused = "" if code in run.protocol.codes else ", a code that no device sends"
        reason = f"answered {judge.code_words(run.protocol, code)} instead of {expected}{unused}"
        return _wrong(run, step, expected, codes, reason)
    if step.point:
        word = match.word or POINTS[step.point].default
        contradicts = run.profile.choices.record(step.point, word, trial.case.id)
        if contradicts:
            reading = POINTS[step.point].reading
            expected = judge.answer_words(run.protocol, step.accepted[0].codes)
            return _wrong(run, step, expected, codes, contradicts, reading)
    if match.verdict > trial.axes["answer"].verdict:
        reason = f"another reading of {match.reading}"
        trial.axes["answer"] = Axis(match.verdict, "", "", reason, match.reading)
    return None


def _soon(trial: Trial, taken: list[Step], heard: Received, sent: int) -> Mismatch | None:
    """Judge how soon each answer came, after its frame or after the answer before it."""
    if taken[-1].truncated or not heard.answers:
        return None
    run, last, slowest = trial.run, sent, 0
    for t, _ in heard.answers:
        slowest, last = max(slowest, t - last), max(t, last)
    proving = isinstance(trial.case, SequenceCase) and trial.case.proving
    timed_out = 3 * run.waiting.timeout < 4 * slowest < 8 * run.waiting.timeout
    if proving and timed_out and 2 * run.profile.all_but_two < run.waiting.timeout:
        # The frame was not over for the device: silence would have ended a longer one just so.
        # Answers usually come so soon that one after the time-out is told from them.
        reason = f"answered only after {slowest / MS:.0f} ms, as a truncated frame is"
        return _wrong(run, taken[-1], "at once", heard.codes, reason)
    run.profile.delayed(slowest)
    reading = "R-answer-deadline"
    if slowest > run.timers.longest:
        reason = f"an answer came after {slowest / MS:.0f} ms"
        return _wrong(run, taken[-1], "in time", heard.codes, reason, reading)
    if slowest > run.timers.deadline and trial.axes["answer"].verdict < Verdict.NON_STRICT:
        reason = f"slow: an answer came after {slowest / MS:.0f} ms"
        trial.axes["answer"] = Axis(Verdict.NON_STRICT, "", "", reason, reading)
    return None


def _wrong(
    run: Run, step: Step, expected: str, codes: tuple[int, ...], reason: str, reading: str = ""
) -> Mismatch:
    words = judge.answer_words(run.protocol, codes)
    axis = Axis(Verdict.FAIL, expected, words, reason, reading or step.reading)
    return Mismatch(step, "answer", axis, run.protocol.clauses.responses)


def flushes(run: Run, step: Step) -> bool:
    """Whether the device discards what is sent right behind this fault."""
    choices = run.profile.choices
    if not step.faulty or choices.others.isdisjoint(FLUSH_POINTS):
        return False
    nobody = run.protocol.headers[step.frame[0]][0] not in run.protocol.by_id
    if step.kind is FrameClass.WRONG_LENGTH and len(step.frame) > 1:
        return choices.differs("R-drain-known")
    if step.kind is FrameClass.UNUSED_ID or nobody:
        return choices.differs(
            "R-drain-unused" if len(step.frame) > 1 else "R-pipelining unused-id"
        )
    bad = len(step.frame) > 1
    return choices.differs("R-pipelining bad-data" if bad else "R-pipelining too-few")


@dataclass(frozen=True, slots=True)
class Mismatch:
    """Where a sequence failed: the step, the axis with its name, and the clause that it breaks.

    `burst` is the burst's index, below 0 in the preamble. `held_up` if an answer came late, which
    may have torn a frame apart.
    """

    step: Step
    name: str
    axis: Axis
    clause: str
    burst: int = 0
    held_up: bool = False


def run_sequence(trial: Trial, case: SequenceCase) -> Procedure[Mismatch | None]:
    """Execute a sequence on a homed line; return its first mismatch, None if there is none."""
    return (yield from _SequenceRun(trial, case).go())


class _SequenceRun:
    def __init__(self, trial: Trial, case: SequenceCase) -> None:
        self._trial = trial
        self._run = trial.run
        self._case = case
        self._axes = {"answer": Axis(Verdict.PASS, "each instruction answered once", "as expected")}
        self._looks = self._whole = 0
        self._coarse = 0
        self._blind = False

    def go(self) -> Procedure[Mismatch | None]:
        run, trial, case = self._run, self._trial, self._case
        trial.begin(case, self._axes, Received((), 0), 0)
        self._blind = not run.config.observable or run.profile.moves == set()
        trial.expected = run.model.homed(run.model.found())
        found: Mismatch | None = None
        setup = (Burst((step,), looks=False) for step in case.setup)
        for index, burst in enumerate((*setup, *case.bursts), -len(case.setup)):
            if trial.expected.rests_on:
                trial.expected = replace(trial.expected, rests_on=frozenset())
            found = yield from self._burst(burst)
            if found:
                found = replace(found, burst=index)
                trial.axes[found.name] = found.axis
                break
        if not found and self._blind:
            trial.axes["state"] = run.config.not_observable(
                "as the model predicts after each burst"
            )
        elif not found and self._looks:
            self._seen()
        if self._coarse and not found:
            reason = f"{self._coarse} pauses came out too long for the time-out on this link"
            words = "pauses below the time-out"
            trial.axes["answer"] = Axis(Verdict.INFORMATIONAL, words, reason, reason)
        return found

    def _seen(self) -> None:
        """Judge the state axis of a sequence in whose looks nothing was wrong."""
        run, axes, case = self._run, self._trial.axes, self._case
        actual = f"{quantity(self._whole, 'observation')} as expected"
        axes.setdefault("state", Axis(Verdict.PASS, "as the model predicts", actual))
        # After a fault the stop is looked for, after an instruction what it has set.
        looked_at = (b for b in case.bursts if b.looks and not b.steps[-1].faulty)
        effects = (step.frame_effect for burst in looked_at for step in burst.steps)
        blind = untold(
            run.protocol, case.facets or facets_set(run.protocol, effects), run.sight.shown
        )
        if blind:
            reason = f"{NOT_OBSERVABLE}: {blind}"
            self._trial.worsen("state", Verdict.INCONCLUSIVE, actual, reason)

    # -- one burst ----------------------------------------------------------------------------

    def _burst(self, burst: Burst) -> Procedure[Mismatch | None]:
        run = self._run
        chosen = [adapt_to_device(run.protocol, run.profile.choices, step) for step in burst.steps]
        for part in self._parts(burst, chosen):
            found = yield from self._part(part)
            if found:
                return found
        return None

    def _parts(self, burst: Burst, chosen: list[Step]) -> Iterator[Burst]:
        """Split a burst where a device that loses frames or lags may react in more than one way.

        One that takes no instruction ahead gets each by itself, on the way to what is observed.
        One that discards what follows a fault until the line is idle may or may not do so at a
        pause; one that stops late has not stopped yet when the next frame comes. A slow one may
        stop by itself while its answers are waited for, in a longer silence than was tried.
        """
        profile = self._run.profile
        alone = "pipelining" in profile.choices.allowed
        apart = profile.stop_latency or (burst.pauses and profile.flushes)
        tried = profile.watchdog or self._run.timers.idle
        most = max(1, tried // (2 * profile.pace)) if profile.pace else len(chosen)
        if len(chosen) == 1 or not (alone or apart or len(chosen) > most):
            same = tuple(chosen) == burst.steps
            yield burst if same else replace(burst, steps=tuple(chosen))
            return
        steps: list[Step] = []
        for left, step in zip(reversed(range(len(chosen))), chosen, strict=True):
            steps.append(step)
            ends = alone or (apart and self._stops(step))
            if not left:
                yield Burst(tuple(steps), looks=burst.looks, idle_ms=burst.idle_ms)
            elif ends or len(steps) >= most:
                yield Burst(tuple(steps), looks=burst.looks)
                steps = []

    def _part(self, burst: Burst) -> Procedure[Mismatch | None]:
        run, trial, chosen = self._run, self._trial, list(burst.steps)
        stray = yield from listen(None, 0)
        if stray.answers:
            return unasked(trial, chosen[0], stray)
        sent, early, usable = yield from self._send(burst, chosen)
        if not usable:
            self._coarse += 1
            yield from self._forget()
            return None
        before, taken = self._take(chosen)
        found = answered_early(trial, chosen, early, run.waiting.pause)
        if found:
            return found
        watched = 0
        if taken[-1].truncated and burst.looks and not self._blind:
            heard, found = yield from watch_time_out(trial, taken[-1], before, sent)
            if found:
                return found
            early.append((len(burst.data), heard.answers))
            watched = max(0, heard.now - sent)
        found = yield from judge_burst(trial, taken, early, sent, watched)
        looks = burst.looks and not self._blind
        if not found and looks:
            missed = run.sight.missed
            found = yield from look_after(trial, taken[-1], before)
            self._looks += 1
            self._whole += not found and run.sight.missed == missed
        stops = self._stops(taken[-1])
        if not found and run.profile.stop_latency and (looks or stops):
            trial.hear((yield from listen(None, 2 * run.profile.stop_latency)))
        if not found and burst.idle_ms:
            found = yield from watch_idle(trial, taken[-1], burst.idle_ms * MS, looks=looks)
        return found

    def _stops(self, step: Step) -> bool:
        """Whether a step is a fault, or an instruction that stops."""
        protocol = self._run.protocol
        return step.faulty or protocol.stops(step.frame_effect.effect or protocol.on_fault)

    def _send(self, burst: Burst, steps: list[Step]) -> Procedure[tuple[int, Early, bool]]:
        """Send a burst with its pauses.

        Returns when its last byte was sent (ns), the answers in each pause with the number of bytes
        sent before it, and whether the pauses were short enough for the time-out.
        """
        run, trial, data = self._run, self._trial, b"".join(step.frame for step in steps)
        places = [p for p in burst.pauses if p < len(data)] if len(data) == len(burst.data) else []
        early: Early = []
        usable, last = True, 0
        for start, end in zip([0, *places], [*places, len(data)], strict=True):
            if start:
                heard = yield from listen(None, run.waiting.pause)
                trial.hear(heard)
                early.append((start, heard.answers))
                usable = usable and heard.now - last < run.waiting.timeout // 2
            last = yield from send(data[start:end])
        return last, early, usable

    def _forget(self) -> Procedure[None]:
        """Wait until a frame the device may have truncated is over; then the state is unknown."""
        run, trial = self._run, self._trial
        trial.hear((yield from listen(None, 2 * run.waiting.timeout + run.waiting.usual)))
        trial.expected = run.model.found()

    def _take(self, steps: list[Step]) -> tuple[ExpectedState, list[Step]]:
        """Apply the steps to the model, up to one after which the device discards the rest.

        Returns the expected state before the last step applied, and the steps applied.
        """
        run, trial, model = self._run, self._trial, self._run.model
        before, taken = trial.expected, list[Step]()
        for step in steps:
            taken.append(step)
            before, trial.expected = (
                trial.expected,
                model.after(trial.expected, step.frame_effect),
            )
            if flushes(run, step):
                break
        return before, taken


_IDLE_MS = 4 * MS  # between two looks while the line is idle


def look_after(trial: Trial, step: Step, before: ExpectedState) -> Procedure[Mismatch | None]:
    """Observe until the state fits, for as long as a stop may take; return a mismatch, or None.

    `before` is the expected state before the step.
    """
    run = trial.run
    seen = yield from observe()
    start = seen.asked
    found = judge.differences(run.model, trial.expected, seen.look)
    patience = max(run.timers.deadline, int(run.protocol.timing.stop_longest * MS))
    first = [facet for facet, _, _ in found]
    while found and seen.now - start < patience:
        heard = yield from listen(None, 2 * MS)
        if heard.answers:
            return unasked(trial, step, heard)
        seen = yield from observe()
        found = judge.differences(run.model, trial.expected, seen.look)
    stops = trial.expected.still and any(f in judge.facets_of_motion(run.protocol) for f in first)
    if not found:
        late = seen.asked - start
        if stops and late > run.timers.grace:
            reason = f"stopped only {late / MS:.0f} ms after its answer"
            words = "stopped", judge.look_words(seen.look)
            axis = Axis(Verdict.NON_STRICT, *words, reason, "R-stop-latency")
            trial.axes["stop"] = axis
            run.profile.stop_latency = max(run.profile.stop_latency, late)
        _rest_on(trial, seen.look)
        return None
    run.waiting.in_vain(patience)
    facet, wanted, actual = found[0]
    reason = f"{facet} is {actual}, expected {wanted}"
    reading, why = judge.contradiction(run.model, before, step.frame_effect, seen.look)
    words = judge.state_words(trial.expected.state), judge.look_words(seen.look)
    axis = Axis(Verdict.FAIL, *words, why or reason, reading)
    name = "stop" if stops and seen.look.moving else "state"
    clauses = run.protocol.clauses
    # An instruction that is to stop it and does not breaks what the table says of it.
    effect = step.frame_effect.effect
    told = effect is not None and effect.sets(run.protocol.car.by)
    safety = step.faulty or (name == "stop" and not told)
    clause = clauses.safety if safety else clauses.instructions
    return Mismatch(step, name, axis, clause)


def watch_idle(
    trial: Trial, step: Step, time: int, *, looks: bool = True
) -> Procedure[Mismatch | None]:
    """Send nothing for `time` ns and check that no answer comes, and that the state stays.

    The state is checked where the robot can be seen (`looks`).
    """
    run = trial.run
    until = (yield from listen(None, 0)).now + time
    now = 0
    while now < until:
        heard = yield from listen(None, min(_IDLE_MS, time))
        now = heard.now
        if heard.answers:
            return unasked(trial, step, heard)
        if not looks:
            continue
        seen = yield from observe()
        found = judge.differences(run.model, trial.expected, seen.look)
        sleeps = run.profile.watchdog is not None or run.profile.choices.unknown("R-watchdog")
        asleep = sleeps and seen.look.moving is False
        if found and not asleep:
            return _by_itself(trial, step, trial.expected, found[0], seen.look)
    return None


def watch_time_out(
    trial: Trial, step: Step, before: ExpectedState, sent: int
) -> Procedure[tuple[Received, Mismatch | None]]:
    """Look at a robot that stood before a truncated frame, half-way through its time-out.

    What the frame before may do by itself shows there. Returns what was heard (at time 0 where it
    moved before, and is not looked at), and the mismatch where it moves. `before` is the expected
    state before the truncated frame, which had gone at `sent` (ns). Bytes may be on a slow line for
    as long as the slowest answer took: so long it may still move.
    """
    run, half = trial.run, trial.run.waiting.timeout // 2
    if not before.still or run.profile.stop_latency > half:
        return Received((), 0), None
    heard = yield from listen(None, half)
    trial.hear(heard)
    seen = yield from observe()
    arrived = 0 if run.config.virtual else sent + run.profile.slowest
    while seen.look.moving and seen.now < arrived:
        more = yield from listen(None, 2 * MS)
        trial.hear(more)
        heard += more
        seen = yield from observe()
    if seen.look.moving:
        found = ("moving", False, True)
        return heard, _by_itself(trial, step, before, found, seen.look)
    return heard, None


def _by_itself(
    trial: Trial, step: Step, expected: ExpectedState, found: tuple[str, object, object], look: Look
) -> Mismatch:
    """The mismatch of a state that changed although nothing was sent."""
    facet, _, actual = found
    moves = expected.still and look.moving
    reason = "moved again by itself" if moves else f"{facet} became {actual} by itself"
    words = judge.state_words(expected.state), judge.look_words(look)
    axis = Axis(Verdict.FAIL, *words, reason)
    clauses = trial.run.protocol.clauses
    clause = clauses.safety if moves else clauses.instructions
    return Mismatch(step, "stop" if moves else "state", axis, clause)


def _rest_on(trial: Trial, look: Look) -> None:
    """Give the state axis the verdict of each other choice on which the matching state rests."""
    run = trial.run
    for point in sorted(trial.expected.rests_on):
        verdict, reading = run.profile.choices.verdict(point), POINTS[point].reading
        axis = trial.axes.get("state")
        if axis is None or verdict > axis.verdict:
            reason = f"{run.profile.choices.word(point)}: another reading of {reading}"
            words = judge.state_words(trial.expected.state), judge.look_words(look)
            trial.axes["state"] = Axis(verdict, *words, reason, reading)
