"""Finds the anomalies of frames, answers and line events: kind, severity, and reason in words.

Severities follow the readings of the document. An error is what a conforming device never does, a
warning is what a host does wrong or what a reading leaves open, and info marks an uncertainty.
"""

from __future__ import annotations

from typing import NamedTuple

from bilprov.analyzer.decode.pairing import Held, Waiting
from bilprov.analyzer.decode.records import UNCERTAIN, Anomaly, DeviceRecord, Severity
from bilprov.captures.schemas import MS, Line
from bilprov.captures.text import printable
from bilprov.spec.codec import Judgement, spaced
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import agrees
from bilprov.spec.state import State

MID_FRAME = "out of step: the device answered in mid-frame"
UNCLEAR = "came before it was clear where frames begin"
SILENT_END = "its end is uncertain: only silence marks it"
LOST = "bytes were lost in mid-frame"
NO_FRAME = "no frame begins so"

# Line events that are anomalies by themselves; the others (open, close, modem) are only noted.
LINE_SEVERITY = {
    "gap": Severity.WARNING,
    "overrun": Severity.WARNING,
    "reconnected": Severity.INFO,
    "waited": Severity.INFO,
    "break": Severity.WARNING,
    "parity": Severity.WARNING,
    "framing": Severity.WARNING,
    "unplugged": Severity.ERROR,
}


class Cause(NamedTuple):
    """One cause of an anomaly of a device byte; an empty `kind` means that there is no anomaly."""

    kind: str
    severity: Severity
    reason: str


KINDS = (
    "faulty instruction",
    "truncated",
    "garbage",
    "disagreeing",
    "damaged answer",
    "unused code",
    "unsolicited",
    "unanswered",
    "slow",
    "early",
    "out of step",
    "lost bytes",
    *LINE_SEVERITY,
)
"""The kinds of all anomalies of a session but UNCERTAIN, which is never more than info."""

ALONE = Cause("", Severity.INFO, "")
OUT_OF_STEP = Cause("out of step", Severity.INFO, "answers a frame whose beginning was not seen")
EARLY = Cause("unsolicited", Severity.INFO, "no instruction was seen yet that it could answer")
NEAR_LOSS = Cause("unsolicited", Severity.INFO, "may answer an instruction around the lost bytes")
_SILENT_END = Cause(UNCERTAIN, Severity.INFO, SILENT_END)
UNSOLICITED = Cause("unsolicited", Severity.ERROR, "no instruction waits for an answer")


def answer_record(
    protocol: Protocol,
    held: Held,
    state: State,
    waiting: Waiting | None = None,
    *,
    skew: int = 0,
    why: Cause = ALONE,
) -> DeviceRecord:
    """The record of an answer to the instruction that waits for it.

    `skew` (ns) is how much earlier than its instruction two taps may timestamp an answer. Where no
    instruction is known, `why` is the cause.
    """
    reply, agree, latency = held.reply, None, None
    open_end = [_SILENT_END] if reply and reply.open_end else []
    if waiting:
        agree, found = _of_itself(protocol, held, waiting.judgement)
        found += open_end
        latency, late = held.t - waiting.end, protocol.timing.answer_deadline
        # How long a device takes to give up on a frame is its own choice (R-truncation-timeout).
        if latency > late * MS and not waiting.judgement.truncated:
            reason = f"answered after {latency / MS:.1f} ms, {late:g} ms is the deadline"
            found.append(Cause("slow", Severity.WARNING, reason))
        elif latency < 0:
            reason = f"stamped {-latency / MS:.1f} ms before the instruction was complete"
            severity = Severity.INFO if -latency <= skew else Severity.WARNING
            found.append(Cause("early", severity, reason))
    elif reply:
        damaged = Cause("damaged answer", Severity.ERROR, reply.reason)
        found = [why] if why.kind else [damaged] if reply.reason else []
        found += open_end
    else:
        found = [why] if why.kind else []
        if held.byte not in protocol.codes:
            agree = False
            found.append(_unused_code(protocol, held.byte))
    number = waiting.sequence if waiting else None
    return DeviceRecord(
        t=held.t,
        byte=held.byte,
        answer=reply.response if reply else protocol.codes.get(held.byte),
        answered=waiting.judgement if waiting else None,
        instruction=number,
        latency=latency,
        agrees=agree,
        state=state,
        faults=tuple(Anomaly(held.t, *one, number) for one in found),
        reply=reply,
    )


def _of_itself(protocol: Protocol, held: Held, asked: Judgement) -> tuple[bool, list[Cause]]:
    """Whether an answer is one that a conforming device may give, and what is odd about it.

    A disagreeing code is a warning where a reading allows it. An answer to an ID that a grammar of
    another layout than the car's lacks only informs: the device may have what the grammar has not.
    """
    reply = held.reply
    if reply and reply.reason:
        return False, [Cause("damaged answer", Severity.ERROR, reply.reason)]
    if agrees(protocol, asked, reply) if reply else held.byte == asked.response.code:
        return True, []
    rests_on, severity, said = "", Severity.ERROR, ""
    if reply:
        said = f"the device answers {reply.describe()}"
        if asked.outcome is Outcome.UNKNOWN_ID:
            rests_on, severity = " (or the grammar lacks it)", Severity.INFO
    elif held.byte not in protocol.codes:
        return False, [_unused_code(protocol, held.byte)]
    else:
        # Traffic without such an answer does not load the readings: they take milliseconds.
        from bilprov.spec.readings import other_choices

        said = f"the device says {protocol.codes[held.byte].name}"
        choices = {choice.code: choice.reading for choice in other_choices(protocol, asked)}
        reading = choices.get(held.byte) or asked.reading
        rests_on = f" ({reading})" if reading else ""
        severity = Severity.WARNING if held.byte in choices else severity
    because = f": {asked.reason}" if asked.reason else ", it is valid"
    reason = f"{said} to {asked.describe()}, expected is {asked.response.name}{because}{rests_on}"
    return False, [Cause("disagreeing", severity, reason)]


def unanswered(waiting: Waiting, now: int, others: int = 0) -> Anomaly:
    """The anomaly of an instruction that got no answer, found at `now` (ns).

    So many `others` that wait are why it is given up before its time.
    """
    judgement = waiting.judgement
    # R-truncated-known: a device may stop without an answer.
    severity = Severity.WARNING if judgement.truncated else Severity.ERROR
    reason = (
        f"no answer to instruction {waiting.sequence}, {judgement.describe()} "
        f"({spaced(judgement.frame)}), in {(now - waiting.end) / MS:.0f} ms"
        f"{f', and {others} others wait' if others else ''}"
    )
    return Anomaly(now, "unanswered", severity, reason, waiting.sequence)


def of_line(line: Line, lost: bool) -> tuple[Anomaly, ...]:
    """The anomaly of a line event, if it is one; `lost` is true if bytes are missing after it."""
    severity = LINE_SEVERITY.get(line.event)
    if severity is None:
        return ()
    where = f" on the {line.tap} line" if line.tap else ""
    reason = printable(line.detail) if line.detail else f"{line.event}{where}"
    return (Anomaly(line.t, "lost bytes" if lost else line.event, severity, reason),)


def _unused_code(protocol: Protocol, byte: int) -> Cause:
    used = ", ".join(str(code) for code in protocol.codes)
    return Cause("unused code", Severity.ERROR, f"{byte} is an unused response, used are {used}")
