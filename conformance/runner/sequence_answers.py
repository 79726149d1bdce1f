"""Judges the answers to a burst of a sequence: which came, how many, and how soon."""

from __future__ import annotations

from dataclasses import dataclass, replace

from bilprov.analyzer.client.operations import Procedure, Received, listen
from bilprov.captures.schemas import MS
from bilprov.captures.text import quantity
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.cases.steps import FrameClass, Step
from bilprov.conformance.oracle.judge import answer_words, code_words, matching
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.run import Run
from bilprov.conformance.runner.trial import Trial
from bilprov.spec.readings import FLUSH_POINTS, POINTS

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
        heard = Received(heard.answers + more.answers, more.now)
        trial.hear(more)
    held_up = _held_up(run, taken, heard, sent)
    for step, code in zip(taken, (*heard.codes, *[None] * len(taken)), strict=False):
        found = _judge(trial, step, code)
        if found:
            return replace(found, held_up=held_up)
    if len(heard.answers) > due:
        came = quantity(len(heard.answers), "answer")
        reason = f"{came} came, {due} {'were' if due > 1 else 'was'} due"
        wanted = answer_words(
            run.protocol, tuple(step.accepted[0].codes[0] for step in taken[:due])
        )
        flood = "R-unsolicited" if len(heard.answers) > 2 * due + _FEW else ""
        return replace(_wrong(run, last, wanted, heard.codes, reason, flood), held_up=held_up)
    return _soon(trial, taken, heard, sent)


def _held_up(run: Run, taken: list[Step], heard: Received, sent: int) -> bool:
    """Whether an answer came so late that line or device stood still for most of a time-out."""
    if run.config.virtual or not heard.answers:
        return False
    waited = run.waiting.timeout if taken[-1].truncated else 0
    late = heard.answers[-1][0] - sent - waited - (run.profile.round_trip or 0)
    return 2 * late > run.waiting.timeout


def _judge(trial: Trial, step: Step, code: int | None) -> Mismatch | None:
    run = trial.run
    codes = () if code is None else (code,)
    match = matching(step.accepted, codes)
    if match is None:
        expected = answer_words(run.protocol, step.accepted[0].codes)
        if code is None:
            return _wrong(run, step, expected, codes, "no answer came")
        unused = "" if code in run.protocol.codes else ", a code that no device sends"
        reason = f"answered {code_words(run.protocol, code)} instead of {expected}{unused}"
        return _wrong(run, step, expected, codes, reason)
    if step.point:
        word = match.word or POINTS[step.point].default
        contradicts = run.profile.choices.record(step.point, word, trial.case.id)
        if contradicts:
            reading = POINTS[step.point].reading
            expected = answer_words(run.protocol, step.accepted[0].codes)
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
    if proving and timed_out and run.profile.tells_time_out(run.waiting.timeout):
        # The frame was not over for the device: silence would have ended a longer one just so.
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
    words = answer_words(run.protocol, codes)
    axis = Axis(Verdict.FAIL, expected, words, reason, reading or step.reading)
    return Mismatch(step, "answer", axis, run.protocol.clauses.responses)


def flushes(run: Run, step: Step) -> bool:
    """Whether the device discards what is sent right behind this fault."""
    choices = run.profile.choices
    if not step.faulty or choices.others.isdisjoint(FLUSH_POINTS):
        return False
    return choices.differs(_losing_point(run, step))


def _losing_point(run: Run, step: Step) -> str:
    """The open point that decides whether what follows this fault is lost."""
    nobody = run.protocol.headers[step.frame[0]][0] not in run.protocol.by_id
    if step.kind is FrameClass.WRONG_LENGTH and len(step.frame) > 1:
        return "R-drain-known"
    if step.kind is FrameClass.UNUSED_ID or nobody:
        return "R-drain-unused" if len(step.frame) > 1 else "R-pipelining unused-id"
    return "R-pipelining bad-data" if len(step.frame) > 1 else "R-pipelining too-few"


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
