"""Holds the answers to a walk's burst against the model: which came, how many, and how soon."""

from __future__ import annotations

from conformance.cases.sequence import Mismatch
from conformance.cases.steps import Accepted, Class, Step
from conformance.dut.operations import Heard, Script, listen
from conformance.oracle.choices import LOSING, POINTS
from conformance.oracle.judge import MS, answer_words, code_words
from conformance.oracle.verdicts import Axis, Verdict
from conformance.runner.run import Run

Early = list[tuple[int, tuple[tuple[int, int], ...]]]
"""What came in each pause inside a burst, with how many of its bytes had gone."""

_FEW = 4  # answers too many: more of them are no answers, but sent without being asked


def unasked(run: Run, step: Step, heard: Heard) -> Mismatch:
    """Something came although nothing was asked."""
    run.hear(heard)
    return _wrong(
        run, step, "no answer", heard.codes, "came although nothing was asked", "R-unsolicited"
    )


def answered_early(run: Run, steps: list[Step], early: Early, pause: int) -> Mismatch | None:
    """No frame was answered before its end, unless it was faulty from its header on.

    `pause` is how long (ns) each pause inside the burst lasted.
    """
    point, came = "R-answer-point", 0
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
        settled = step.kind in (Class.UNUSED_ID, Class.WRONG_LENGTH)
        if came > whole + 1 or (word == "at-header" and not (inside and settled)):
            reason = "answered a frame that may still be valid before its end"
            codes = tuple(code for _, code in answers)
            return _wrong(run, step, "no answer yet", codes, reason, point)
        if word and inside and settled:
            contradicts = run.profile.choices.settle(point, word, run.open_id)
            if contradicts:
                return _wrong(run, step, "as before", (), contradicts, point)
    return None


def judge_burst(run: Run, taken: list[Step], early: Early, sent: int) -> Script[Mismatch | None]:
    """Listen for what is due to the steps that count, and judge it; they had gone at `sent`."""
    last, before = taken[-1], tuple(entry for _, answers in early for entry in answers)
    silent = last.cut and run.profile.choices.word(last.point) == "silent"
    due = len(taken) - silent
    left = max(0, due - len(before))
    if last.cut:
        heard = yield from _left_alone(run, left, sent)
    else:
        heard = yield from run.all_answers(left, run.patience)
        if len(heard.answers) < left:
            run.missing = True
    run.hear(heard)
    heard = Heard(before + heard.answers, heard.now)
    if any(step.faulty for step in taken) and run.profile.flushes:
        more = yield from listen(None, run.timeout + run.limits.settle)
        heard = Heard(heard.answers + more.answers, more.now)
        run.hear(more)
    for step, code in zip(taken, (*heard.codes, *[None] * len(taken)), strict=False):
        found = _judge(run, step, code)
        if found:
            return found
    if len(heard.answers) > due:
        reason = f"{len(heard.answers)} answers came, {due} were due"
        wanted = answer_words(
            run.protocol, tuple(step.accepted[0].codes[0] for step in taken[:due])
        )
        flood = "R-unsolicited" if len(heard.answers) > 2 * due + _FEW else ""
        return _wrong(run, last, wanted, heard.codes, reason, flood)
    return _soon(run, taken, heard, sent)


def _left_alone(run: Run, due: int, sent: int) -> Script[Heard]:
    """What comes while a frame that was cut short is left alone."""
    pause = run.timeout + run.timeout // 4 + run.limits.settle
    patience = pause + run.usual if due else pause
    heard = yield from run.all_answers(due, patience) if due else listen(None, patience)
    run.timeouts += run.timeout if heard.answers else 0
    if heard.now < sent + run.timeout // 2:
        # Answered at its header: what comes now would still be taken for its data.
        more = yield from listen(None, sent + pause - heard.now)
        heard = Heard(heard.answers + more.answers, more.now)
    return heard


def _judge(run: Run, step: Step, code: int | None) -> Mismatch | None:
    codes = () if code is None else (code,)
    match = next((a for a in step.accepted if a.codes == codes), None)
    expected = answer_words(run.protocol, step.accepted[0].codes)
    if match is None:
        if code is None:
            return _wrong(run, step, expected, codes, "no answer came")
        unused = "" if code in run.protocol.codes else ", a code that no device sends"
        reason = f"answered {code_words(run.protocol, code)} instead of {expected}{unused}"
        return _wrong(run, step, expected, codes, reason)
    if step.point:
        word = match.word or POINTS[step.point].default
        contradicts = run.profile.choices.settle(step.point, word, run.open_id)
        if contradicts:
            reading = POINTS[step.point].reading
            return _wrong(run, step, expected, codes, contradicts, reading)
    _rests(run, match)
    return None


def _rests(run: Run, match: Accepted) -> None:
    if match.verdict > run.axes["answer"].verdict:
        reason = f"another reading of {match.reading}"
        axis = Axis(match.verdict, "", "", reason, match.reading)
        run.axes["answer"] = axis


def _soon(run: Run, taken: list[Step], heard: Heard, sent: int) -> Mismatch | None:
    """How soon the answers came: each after its frame, or after the answer before it."""
    timing = run.protocol.timing
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
        return _wrong(run, taken[-1], "in time", heard.codes, reason, reading)
    if slowest > timing.answer_deadline * MS and run.axes["answer"].verdict < Verdict.NON_STRICT:
        reason = f"slow: an answer came after {slowest / MS:.0f} ms"
        run.axes["answer"] = Axis(Verdict.NON_STRICT, "", "", reason, reading)
    return None


def _wrong(
    run: Run, step: Step, expected: str, codes: tuple[int, ...], reason: str, reading: str = ""
) -> Mismatch:
    words = answer_words(run.protocol, codes)
    axis = Axis(Verdict.FAIL, expected, words, reason, reading or step.reading)
    return Mismatch(step, "answer", axis, run.protocol.clauses.responses)


def flushes(run: Run, step: Step) -> bool:
    """Whether the device throws away what is sent right behind this fault."""
    choices = run.profile.choices
    if not step.faulty or choices.others.isdisjoint(LOSING):
        return False
    return choices.is_other(_losing_point(run, step))


def _losing_point(run: Run, step: Step) -> str:
    """The point that says whether what follows this fault is lost."""
    nobody = run.protocol.headers[step.frame[0]][0] not in run.protocol.by_id
    if step.kind is Class.WRONG_LENGTH and len(step.frame) > 1:
        return "R-drain-known"
    if step.kind is Class.UNUSED_ID or nobody:
        return "R-drain-unused" if len(step.frame) > 1 else "R-pipelining unused-id"
    return "R-pipelining bad-data" if len(step.frame) > 1 else "R-pipelining too-few"
